"""The texture benchmark: colours of textured meshes in closed form, image errors, and a small shape end to end."""

import json
import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import trimesh
from evolutions import fails
from mplicits.datasets import TexturedMesh, look_at, srgb_to_linear
from mplicits.pipelines.render.rasterise import mesh_view
from mplicits.pipelines.render.trace import Seen
from mplicits.pipelines.training.settings import FitConfig, TextureConfig

from benchmarks.cli import main
from benchmarks.cli import shapes as bench_shapes
from benchmarks.shapes import texture as bench_texture_fits
from benchmarks.shapes.compare import Drawing, draw, image_error, psnr
from benchmarks.shapes.texture import PAPER_MSE, TextureBench, TextureRow


def test_a_square_seen_from_the_front_is_its_image():
    image = np.random.default_rng(0).random((8, 8, 3))
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    square = TexturedMesh(corners, triangles, (corners[triangles][..., :2] + 1) / 2, image.astype(np.float32))
    fov = 2 * math.degrees(math.atan(1 / 3))  # the square just fills the picture
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=fov, width=8, height=8)
    seen = mesh_view(square, camera)
    assert seen.pixel.tolist() == list(range(64))
    np.testing.assert_allclose(seen.color.numpy().reshape(8, 8, 3), image, atol=1e-6)
    np.testing.assert_allclose(seen.normal.numpy(), np.tile([0.0, 0.0, 1.0], (64, 1)), atol=1e-6)
    directions = camera.rays()[1].reshape(-1, 3)
    torch.testing.assert_close(seen.direction, directions)
    torch.testing.assert_close(seen.depth, -3 / directions[:, 2])


def seen_at(pixels: list[int], size: tuple[int, int]) -> Seen:
    rows = torch.zeros(len(pixels), 3)
    return Seen(size, torch.tensor(pixels), rows[:, 0], rows, rows, rows)


def test_drawings_are_averaged_in_linear_light():
    drawing = draw(seen_at([0, 1, 2, 3, 6, 7], (4, 2)), torch.tensor([[0.0] * 3, [1.0] * 3] * 3), samples=2)
    # Left: black, white and two of the background; right: two of each.
    assert drawing.coverage.tolist() == [[0.5, 1.0]]
    quarters = srgb_to_linear(drawing.rgb.astype(np.float64))
    np.testing.assert_allclose(quarters, [[[0.75] * 3, [0.5] * 3]], atol=1e-6)
    with pytest.raises(ValueError, match="samples=3"):
        draw(seen_at([0], (4, 2)), torch.zeros(1, 3), samples=3)


def test_errors_of_images():
    rng = np.random.default_rng(0)
    rgb = rng.uniform(0.3, 0.6, (4, 5, 3)).astype(np.float32)
    coverage = np.zeros((4, 5), np.float32)
    coverage[1:3, 1:4] = 1
    same = image_error([(Drawing(rgb, coverage), Drawing(rgb, coverage))])
    assert (same.everywhere, same.either, same.both, same.pixels_either, same.pixels_both) == (0, 0, 0, 6, 6)
    assert psnr(same.both) == 120
    # A quarter more inside, and half on one pixel that only the second image sees a part of.
    other, wider = rgb.copy(), coverage.copy()
    other[1:3, 1:4] += 0.25
    other[0, 0] += 0.5
    wider[0, 0] = 0.3
    error = image_error([(Drawing(rgb, coverage), Drawing(other, wider))])
    total = 6 * 0.0625 + 0.25
    assert (error.both, error.either, error.everywhere) == pytest.approx((0.0625, total / 7, total / 20))
    assert (error.pixels_either, error.pixels_both) == (7, 6)
    assert psnr(0.01) == pytest.approx(20)
    # Two cameras: every pixel counts the same.
    pair = (Drawing(rgb, coverage), Drawing(other, wider))
    assert image_error([pair, (Drawing(rgb, coverage), Drawing(rgb, coverage))]).both == pytest.approx(0.0625 / 2)
    nothing = np.zeros_like(coverage)
    assert math.isnan(image_error([(Drawing(rgb, nothing), Drawing(rgb, nothing))]).both)


COARSE = FitConfig(
    widths=(24,), depths=(1,), omegas=(8.0,), steps=(150,), learning_rates=(1e-2,), batch=1024, samples=8000
)
FINE = {"widths": (24, 24), "depths": (1, 1), "omegas": (8.0, 10.0), "steps": (150, 30), "learning_rates": (1e-2, 1e-3)}
FULL = replace(COARSE, **FINE)
SMALL = TextureConfig(
    width=32, depth=2, omega=12.0, steps=150, learning_rate=4e-3, batch=1024, band_batch=256, samples=8000
)


def of(*meshes: Path, **options: object) -> TextureBench:
    given = {"texture": SMALL, "coarse": COARSE, "device": "cpu", "views": 2, "size": 48, "resolution": 48}
    return TextureBench(meshes=meshes, **(given | options))


@pytest.fixture(autouse=True, scope="module")
def _few_points():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_texture_fits, "FIT_POINTS", 3000)
        yield


def write_ball(folder: Path, *, image: np.ndarray | None = None) -> Path:
    """spot.obj: a ball of radius 7 about (5, 0, -1), painted along z with a smooth image."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    if image is None:
        y, x = np.mgrid[0:64, 0:64] / 63
        image = np.stack((x, y, 0.5 + 0.4 * np.sin(9 * x)), axis=2)
    iio.imwrite(folder / "ball.png", (image * 255).astype(np.uint8))
    (folder / "ball.mtl").write_text("newmtl paint\nmap_Kd ball.png\n")
    lines = ["mtllib ball.mtl", "usemtl paint"]
    lines += ["v {} {} {}".format(*(7 * v + [5.0, 0.0, -1.0])) for v in ball.vertices]
    lines += [f"vt {0.5 + 0.45 * v[0]} {0.5 + 0.45 * v[1]}" for v in ball.vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in ball.faces]
    path = folder / "spot.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[TextureRow]]:
    folder = tmp_path_factory.mktemp("ball")
    path, out = write_ball(folder), folder / "out"
    return path, out, of(path, full=FULL).rows(out)


def test_rows_errors_and_sheet(bench):
    _, out, rows = bench
    assert [(row.surface, row.texture) for row in rows] == [
        ("(24,1) traced", "(24,1)"),
        ("(24,1)▷(24,1) traced", "(24,1)▷(24,1)"),
        ("(24,1) mesh", "(24,1)"),
        ("(24,1) traced", "(24,1)▷(24,1)"),
    ]
    for row in rows:
        assert row.paper == PAPER_MSE["spot"]
        assert row.error.both < 1e-3
        assert row.error.either < 5e-3
        assert 0.4 * 2 * 48**2 < row.error.pixels_both < row.error.pixels_either < 0.8 * 2 * 48**2
        assert row.error.everywhere == pytest.approx(row.error.either * row.error.pixels_either / (2 * 48**2))
        assert min(row.fit_seconds, row.texture_seconds) > 0
    # The mesh of a surface shows what its trace does.
    assert rows[2].error.both == pytest.approx(rows[0].error.both, rel=0.1)
    sheet = iio.imread(out / "spot.png")
    assert sheet.shape == (2 * (48 + 40), 5 * (48 + 12), 3)


def test_what_is_there_is_used_and_what_is_not_is_trained(bench, tmp_path):
    path, out, rows = bench
    runs = sorted((out / "runs").iterdir())
    assert len(runs) == 2
    files = [run / name for run in runs for name in ("field.safetensors", "texture.safetensors")]
    before = [file.stat().st_mtime_ns for file in files]
    assert of(path, full=FULL).rows(out) == rows
    other = of(path, full=FULL, size=24).rows(out)
    assert [row.texture_seconds for row in other] == [row.texture_seconds for row in rows]
    assert [file.stat().st_mtime_ns for file in files] == before
    # A texture that was interrupted is trained again, its fit is not.
    coarse = next(run for run in runs if len(json.loads((run / "run.json").read_text())["stages"]) == 1)
    record = json.loads((coarse / "run.json").read_text())
    record["texture"]["finished"] = False
    (coarse / "run.json").write_text(json.dumps(record))
    of(path, size=32).rows(out)
    changed = [file for file, then in zip(files, before, strict=True) if file.stat().st_mtime_ns != then]
    assert changed == [coarse / "texture.safetensors"]
    # Other settings, or an image of another mesh beside the same OBJ file, are other fits.
    part = of(path).jobs()[0]
    assert of(path).settings(part) != of(path, coarse=FULL).settings(part)
    painted = write_ball(tmp_path, image=np.full((4, 4, 3), 0.5))
    assert painted.read_bytes() == path.read_bytes()
    assert of(painted).jobs()[0].options != part.options


def test_the_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench_shapes, "COARSE", COARSE)
    figures = tmp_path / "figures.json"
    command = f"texture {write_ball(tmp_path)} -o {tmp_path / 'out'} --json {figures} --coarse-width 16"
    command += " --coarse-omega 6 --coarse-steps 60 --width 16 --depth 1 --steps 20 --samples 2000 --batch 512"
    command += " --views 1 --size 32 --resolution 32"
    assert main(command.split()) == 0
    assert "spot (16,1) mesh" in capsys.readouterr().out
    rows = json.loads(figures.read_text())["records"][0]["outputs"]
    assert [row["surface"] for row in rows] == ["(16,1) traced", "(16,1) mesh"]
    assert rows[0]["error"]["either"] < 0.2
    (tmp_path / "spot.obj").unlink()
    assert "spot.obj: no such file" in fails(capsys, command, main)
