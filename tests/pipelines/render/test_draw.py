"""Pictures of fields and meshes: exact depths, normals and silhouettes, and the command that draws them."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from evolutions import fails
from fields import FIELDS
from mplicits.datasets import PointCloud, look_at, orbit, write_cloud_ply
from mplicits.datasets.cameras import Camera
from mplicits.neural_fields import InputError, MultiscaleSDF, Similarity, Siren, Sphere, Torus, save_field
from mplicits.neural_fields.meshing.extract import extract_mesh
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render import trace
from mplicits.pipelines.render.draw import RenderOptions, choose_frame, open_subject, reference_distance, render_run
from mplicits.pipelines.render.legend import with_color_bar
from mplicits.pipelines.render.rasterise import mesh_view
from mplicits.pipelines.render.shade import SHADINGS
from mplicits.pipelines.render.trace import pixel_size, trace_view
from torch.nn.functional import normalize

CENTER = (0.1, 0.05, -0.1)
SCALE = 7.0
SIMILARITY = Similarity((1000.0, -5.0, 20.0), SCALE)
INSET = 0.01  # by so much is level 1 smaller in value
REACH = math.acos(0.2) / 2  # of the blob along the axes


@pytest.fixture(scope="module")
def blob(cosine_blob) -> MultiscaleSDF:
    """`cosine_blob` and, within 0.05 of its surface, 0.01 more: a field known exactly."""
    residual = Siren(4, 1, omega=1.0)
    with torch.no_grad():
        residual.output.weight.zero_()
        residual.output.bias.fill_(INSET)
    return MultiscaleSDF(cosine_blob(CENTER), [residual], [0.05])


@pytest.fixture(scope="module")
def shapes(tmp_path_factory, blob) -> Path:
    """A run, its finest level as meshes and clouds, and a run without a surface."""
    folder = tmp_path_factory.mktemp("shapes")
    mesh = extract_mesh(blob, resolution=64)
    points = SIMILARITY.to_input(mesh.vertices)
    metadata = {"run": {"cloud": str(folder / "cloud.ply")}}
    save_field(folder / "blob.safetensors", blob, similarity=SIMILARITY, metadata=metadata)
    save_field(folder / "unit.safetensors", blob)
    save_field(folder / "lost.safetensors", blob, metadata={"run": {"cloud": "absent.ply"}})
    save_field(folder / "time.safetensors", Siren(8, 1, in_dim=4))
    colors = np.tile(np.float32((0.2, 0.6, 0.4)), (len(points), 1))
    write_mesh(folder / "mesh.ply", replace(mesh, colors=colors), SIMILARITY)
    write_mesh(folder / "plain.obj", mesh, SIMILARITY)
    write_cloud_ply(folder / "cloud.ply", PointCloud(points, mesh.normals))
    np.savetxt(folder / "bare.xyz", points)
    np.savetxt(folder / "dot.xyz", np.ones((3, 3)))
    save_field(folder / "nothing.safetensors", Sphere(center=(9.0, 0.0, 0.0)))
    (folder / "broken.json").write_text("{")
    camera = orbit(points, azimuth=50, elevation=30, fov=20, width=40, height=30)
    write_transforms(folder / "transforms.json", {"images/a.png": camera, "images/b.png": camera.resized(48, 36)})
    return folder


def write_transforms(path: Path, cameras: dict[str, Camera]) -> None:
    """Cameras as nerfstudio writes them: y and z of the camera turned round, pixels counted from the corner."""
    frames = [
        {
            "file_path": name,
            "transform_matrix": (camera.world_from_camera * torch.tensor([1.0, -1, -1, 1])).tolist(),
            "fl_x": float(camera.intrinsics[0, 0]),
            "fl_y": float(camera.intrinsics[1, 1]),
            "cx": float(camera.intrinsics[0, 2]) + 0.5,
            "cy": float(camera.intrinsics[1, 2]) + 0.5,
            "w": camera.width,
            "h": camera.height,
        }
        for name, camera in cameras.items()
    ]
    path.write_text(json.dumps({"frames": frames}))


@pytest.fixture
def draw(shapes, tmp_path) -> Callable[..., np.ndarray]:
    """The picture that the command draws, small unless it is told otherwise."""

    def run(source: str, flags: str, name: str = "a.png") -> np.ndarray:
        size = "" if "--size" in flags or "--cameras" in flags else "--size 24"
        assert main(f"render {shapes / source} -o {tmp_path / name} {size} {flags}".split()) == 0
        return iio.imread(tmp_path / name).astype(float)

    return run


def blob_gradient(positions: torch.Tensor) -> torch.Tensor:
    return torch.sin(2 * (positions - torch.tensor(CENTER))) / 2


VIEWS = {
    "whole": look_at((1.5, 0.8, 2.5), (0.1, 0.0, -0.1), width=61, height=47),
    "off-centre": look_at((-2.5, 0.3, 0.2), (0.1, 0.5, -0.1), fov=40, width=50, height=64),
    "rim": look_at((0.1, 0.0, 3.0), (0.1, 0.6, -0.1), fov=1.5, width=60, height=60),
    "close": look_at((0.1, 0.0, 0.6), (0.1, 0.3, -0.1), fov=90, width=40, height=40),
    "inside": look_at((0.2, 0.1, -0.3), (1.0, 0.0, 0.0), fov=100, width=40, height=30),
}


@pytest.mark.parametrize("view", VIEWS)
def test_a_sphere_is_seen_where_it_is(view):
    camera, center, radius = VIEWS[view], torch.tensor((0.1, 0.0, -0.1)), 0.6
    seen = trace_view(Sphere(radius=radius, center=tuple(center.tolist())), camera)
    eye, directions = (each.reshape(-1, 3) for each in camera.rays(dtype=torch.float64))
    offset = center.double() - eye
    along = (directions * offset).sum(1)
    distance = (offset - along[:, None] * directions).norm(dim=1)
    half = (radius**2 - distance.square()).clamp(min=0).sqrt()
    depth = torch.where(offset.norm() < radius, along + half, along - half)

    hit = torch.zeros(len(depth), dtype=torch.bool)
    hit[seen.pixel] = True
    # A chord shorter than the resolution may be overlooked, and float32 knows the radius to its last digit only.
    unsure = (distance - radius).abs() < pixel_size(camera) ** 2 / (8 * radius) + 1e-6
    assert unsure.float().mean() < 0.01
    assert torch.equal(hit[~unsure], (distance < radius)[~unsure])
    assert hit.float().mean() > 0.1
    steep = half[seen.pixel] > 0.05
    found = (seen.depth - depth[seen.pixel]).abs()
    assert float(found[steep].max()) < 1e-5
    assert float(found.max()) < 0.02 * pixel_size(camera) + 1e-6
    assert torch.allclose(seen.position, (eye + depth[:, None] * directions)[seen.pixel].float(), atol=5e-4)
    assert torch.allclose(seen.normal, (seen.position - center) / radius, atol=1e-3)
    assert torch.allclose(seen.direction, directions[seen.pixel].float(), atol=1e-6)
    assert bool((seen.pixel.diff() > 0).all())


@pytest.mark.parametrize("name", [name for name, make in FIELDS.items() if make().in_dim == 3])
def test_every_field_can_be_seen(name):
    field = FIELDS[name]()
    camera = look_at((0.9, 0.7, 2.8), (0.0, 0.0, 0.0), width=32, height=32)
    seen = trace_view(field, camera)
    assert len(seen.pixel) > 5
    with torch.inference_mode():
        reach = 0.25 * pixel_size(camera) * seen.direction
        before, behind = (field.value(seen.position + side * reach) > 0 for side in (-1, 1))
        gradient = field.jet(seen.position).gradient
    assert float((before != behind).float().mean()) > 0.93  # but for rays that graze the surface
    same = (normalize(gradient, dim=1) - seen.normal).norm(dim=1) < 0.05
    # Not at edges, to either side of which a Newton step may lead; the untrained levels' gates are all edge.
    assert name in ("multiscale", "slice-at") or float(same.float().mean()) > 0.95
    assert torch.allclose(seen.normal.norm(dim=1), torch.ones(len(seen.pixel)), atol=1e-5)


def test_normal_mapping_takes_the_gradient_of_a_finer_level_at_the_points_of_a_coarser_one(blob):
    field = MultiscaleSDF(blob.base, [Siren(16, 2, omega=8.0)], [0.1])
    camera = VIEWS["whole"]
    plain, mapped = trace_view(field, camera, level=0), trace_view(field, camera, level=0, normal_level=-1)
    assert torch.equal(mapped.pixel, plain.pixel)
    assert len(plain.pixel) > 300
    assert float((mapped.depth - plain.depth).abs().max()) < pixel_size(camera)
    with torch.inference_mode():
        assert float(field.value(mapped.position, level=0).abs().max()) < 0.2 * pixel_size(camera)
        expected = normalize(field.jet(mapped.position, level=1).gradient, dim=1)
    assert torch.allclose(mapped.normal, expected, atol=1e-6)
    assert float((mapped.normal - plain.normal).norm(dim=1).median()) > 0.1
    assert torch.allclose(plain.normal, normalize(blob_gradient(plain.position), dim=1), atol=1e-3)


def test_levels_are_seen_at_their_own_depths(blob):
    camera = look_at((CENTER[0], CENTER[1], 3.0), CENTER, width=1, height=1)
    for level, inset in ((0, 0.0), (1, INSET)):
        depth = trace_view(blob, camera, level=level).depth
        assert float(depth) == pytest.approx(3.0 - CENTER[2] - math.acos(0.2 + 4 * inset) / 2, abs=1e-5)


def test_a_field_and_its_mesh_are_seen_alike():
    torus, camera = Torus(major=0.5, minor=0.2), VIEWS["whole"].resized(183, 141)
    traced = trace_view(torus, camera)
    meshed = mesh_view(extract_mesh(torus, resolution=128), camera)
    depths = torch.full((2, 183 * 141), torch.nan)
    depths[0, traced.pixel], depths[1, meshed.pixel] = traced.depth, meshed.depth
    one = depths.isnan().sum(0) == 1
    assert int(one.sum()) < 0.002 * len(traced.pixel)
    facing = torch.zeros(183 * 141)
    facing[traced.pixel] = -(traced.normal * traced.direction).sum(1)
    off = (depths[0] - depths[1]).abs()[facing > 0.3]
    sag = 3 * (2 / 128) ** 2 / 8 / 0.2  # of a cell's diagonal under the surface
    assert float(off[off.isfinite()].max()) < sag / 0.3


@pytest.mark.parametrize("shading", SHADINGS)
def test_every_shading_of_a_field_and_of_its_mesh(shapes, draw, shading):
    flags = f"--shading {shading} --no-legend --fast --size 40"
    pictures = []
    if shading != "color":
        pictures.append(draw("blob.safetensors", flags))
    if shading != "curvature":
        reference = f"--reference {shapes}/cloud.ply" if shading == "error" else ""
        pictures.append(draw("mesh.ply" if shading == "color" else "plain.obj", f"{flags} {reference}"))
    for picture in pictures:
        assert picture.shape == (40, 40, 3)
        assert 0.3 < (picture < 250).any(axis=2).mean() < 0.7
        assert (picture[[0, 0, -1, -1], [0, -1, 0, -1]] == 255).all()
    if len(pictures) == 2 and shading != "error":
        assert np.abs(pictures[0] - pictures[1]).mean() < 3
    if shading == "color":
        assert np.abs(pictures[0][20, 20] - (51, 153, 102)).max() <= 1


def test_normals_are_drawn_as_colours_of_the_right_pixels(shapes, draw, blob):
    picture = draw("blob.safetensors", "--shading normals --samples 1 --size 48 32")
    subject = open_subject(shapes / "blob.safetensors")
    seen = trace_view(blob, orbit(subject.outline(), width=48, height=32))
    normals = normalize(blob_gradient(seen.position), dim=1)
    assert np.abs(picture.reshape(-1, 3)[seen.pixel] - (normals.numpy() + 1) * 127.5).max() < 1


def test_shadows_and_occlusion_are_on_for_fields_and_can_be_left_out(draw):
    flags = ("", "--no-shadows", "--no-occlusion", "--fast", "--fast --shadows --occlusion")
    pictures = {each: draw("blob.safetensors", f"--samples 1 {each}") for each in flags}
    assert (pictures[""] == pictures["--fast --shadows --occlusion"]).all()
    assert pictures["--fast"].mean() >= pictures["--no-shadows"].mean() >= pictures[""].mean() - 1e-9
    assert (pictures["--no-shadows"] != pictures["--fast"]).any()


def test_strips_do_not_show(shapes, draw, tmp_path, monkeypatch):
    whole = draw("blob.safetensors", "--shading depth --levels")
    monkeypatch.setattr(trace, "STRIP", 24 * 4 * 5)
    steps = []
    options = RenderOptions(size=(24,), shading="depth", levels=True)
    render_run(shapes / "blob.safetensors", tmp_path / "b.png", options, progress=lambda *done: steps.append(done))
    assert np.abs(iio.imread(tmp_path / "b.png") - whole).max() <= 1
    assert steps == [(done, 10) for done in range(1, 11)]  # two levels of five strips


def test_a_transparent_picture_covers_what_the_shape_does(draw):
    flags = "--background transparent --size 30 --samples 4"
    picture = draw("mesh.ply", f"{flags} --shading color")
    assert picture.shape == (30, 30, 4)
    fine = draw("mesh.ply", "--background transparent --size 240 --samples 1")
    assert picture[..., 3].mean() == pytest.approx(fine[..., 3].mean(), rel=0.005)
    rim = (picture[..., 3] > 20) & (picture[..., 3] < 235)
    assert np.abs(picture[rim][:, :3] - (51, 153, 102)).max() <= 2  # nothing of a background in it
    traced = draw("blob.safetensors", f"{flags} --fast")
    assert np.abs(traced[..., 3] - picture[..., 3]).mean() < 0.5


@pytest.mark.parametrize(("shading", "power"), [("depth", 1), ("curvature", -1)])
def test_limits_and_legends_are_in_input_units(shapes, draw, capsys, shading, power):
    limits = []
    for name in ("unit.safetensors", "blob.safetensors"):
        picture = draw(name, f"--shading {shading}")
        said = capsys.readouterr().out
        limits.append([float(number) for number in said.split(" from ")[1].split(",")[0].split(" to ")])
    assert limits[1] == pytest.approx([SCALE**power * limit for limit in limits[0]], rel=1e-3)
    if shading == "depth":
        subject = open_subject(shapes / "blob.safetensors")
        eye = float((orbit(subject.outline(), width=24, height=24).eye - torch.tensor(CENTER)).norm())
        assert limits[1][0] == pytest.approx(SCALE * (eye - REACH), rel=0.05)
    else:
        assert limits[1][0] == -limits[1][1]
    low, high = limits[1]
    given = draw(name, f"--shading {shading} --limits {low} {high}")
    assert np.abs(given - picture)[:24].mean() < 0.5
    wide = draw(name, f"--shading {shading} --limits -1000 1000")
    assert np.ptp(wide[10:14, 10:14], axis=(0, 1)).max() < 12  # all of it in the middle of the map


@pytest.mark.slow
def test_the_error_is_the_distance_between_surfaces(shapes):
    subject = open_subject(shapes / "blob.safetensors", RenderOptions(level=0))
    distance = reference_distance(subject, None)  # the cloud is on level 1
    seen = subject.view(orbit(subject.outline(), width=40, height=40), subject.panels[0])
    gap = INSET / blob_gradient(seen.position).norm(dim=1)
    assert torch.allclose(distance(seen.position), gap, rtol=0.1)
    bare = reference_distance(subject, shapes / "bare.xyz")(seen.position)
    assert bool((bare > 0.9 * gap).all())
    meshed = reference_distance(subject, shapes / "plain.obj")(seen.position)
    assert torch.allclose(meshed, gap, rtol=0.1)


def test_levels_stand_side_by_side(draw, capsys):
    picture = draw("blob.safetensors", "--levels --shading headlight")
    assert picture.shape == (24 + 40, 3 * (24 + 12), 3)
    assert "level 0, level 1, level 0 + normals of level 1" in capsys.readouterr().out
    ink = [(picture[40:, start : start + 36] < 250).any(axis=2).sum() for start in (0, 36, 72)]
    assert ink[0] == ink[2] >= ink[1]
    assert (picture[40:, 6:30] == draw("blob.safetensors", "--level 0 --shading headlight")).all()


def test_sides_stand_side_by_side_as_they_look_alone(draw, capsys):
    picture = draw("blob.safetensors", "--shading normals --azimuth 100 --sides 4")
    assert "level 1, normals, 24×24, 4 sides" in capsys.readouterr().out
    assert picture.shape == (24 + 40, 4 * (24 + 12), 3)
    tiles = [picture[40:, 36 * side + 6 : 36 * side + 30] for side in range(4)]
    alone = [draw("blob.safetensors", f"--shading normals --azimuth {each}") for each in (100, -170, -80, 10)]
    # All stand as far off as the one that must stand furthest, which looks as it does alone; the others are smaller.
    assert any((tile == one).all() for tile, one in zip(tiles, alone, strict=True))
    assert max(np.abs(tile[12, 12] - one[12, 12]).max() for tile, one in zip(tiles, alone, strict=True)) < 40
    assert min(np.abs(tiles[a] - tiles[b]).mean() for a in range(4) for b in range(a)) > 5
    both = draw("blob.safetensors", "--shading normals --sides 3 --levels")
    assert both.shape == (3 * (24 + 40), 3 * (24 + 12), 3)  # two levels, and one with the other's normals


@pytest.mark.parametrize("source", ["blob.safetensors", "plain.obj"])
def test_posed_cameras_are_in_input_coordinates(shapes, draw, source):
    plain = draw("plain.obj", "--shading normals --azimuth 50 --elevation 30 --fov 20 --size 40 30")
    cameras = f"--shading normals --cameras {shapes}/transforms.json --frame"
    posed = draw(source, f"{cameras} a")
    assert posed.shape == (30, 40, 3)
    assert np.abs(posed - plain).mean() < 1
    assert draw(source, f"{cameras} b").shape == (36, 48, 3)
    assert draw(source, f"{cameras} b --size 16").shape == (12, 16, 3)


def test_frames_are_chosen_by_name_or_index():
    camera = VIEWS["whole"]
    named = [("left/1.png", camera), ("left/0.png", camera), ("right/0.png", camera), ("extra", camera)]
    chosen = {"left/0.png": "left/0.png", "extra": "extra", "1.png": "left/1.png", "3": "extra"}
    chosen |= {"1": "left/1.png", "0": "left/1.png"}  # a name comes before an index, but two end in 0
    assert {frame: choose_frame("c.json", named, frame)[0] for frame in chosen} == chosen
    for frame in ("0.png", "4", "-1", "absent"):
        with pytest.raises(InputError, match="none, or more than one"):
            choose_frame("c.json", named, frame)


def test_clouds_are_drawn_as_their_surface_without_gaps(draw):
    mesh, discs, bare = (draw(name, "--size 60") for name in ("plain.obj", "cloud.ply", "bare.xyz"))
    meshed, covered = ((picture < 250).any(axis=2) for picture in (mesh, discs))
    assert (meshed & ~covered).sum() < 10
    assert covered.sum() < 1.15 * meshed.sum()
    assert np.median(np.abs(mesh - discs)[meshed & covered]) < 8
    assert bare.shape[0] > 60  # the legend of depths: points without normals have no shade


def test_turntables_have_the_frames_asked_for_and_one_scale_of_colours(draw):
    frames = draw("blob.safetensors", "--size 48 --frames 5 --fps 10 --samples 1 --shading depth", "a.gif")
    assert len(frames) == 5
    legends = frames[:, 48:]
    assert legends.shape[1] > 0
    assert np.abs(legends - legends[0]).mean() < 1
    assert all(np.abs(frames[k, :48] - frames[0, :48]).mean() > 2 for k in range(1, 5))


def test_a_film_goes_through_posed_cameras(shapes, tmp_path):
    camera = orbit(SIMILARITY.to_input(open_subject(shapes / "unit.safetensors").outline()), width=32, height=32)
    write_transforms(shapes / "even.json", {"a": camera, "b": camera, "c": camera})
    line = f"render {shapes}/plain.obj -o {tmp_path}/a.mp4 --cameras {shapes}/even.json --fast"
    assert main(line.split()) == 0
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_an_interruption_leaves_what_was_there(shapes, tmp_path, name):
    def stop(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    (tmp_path / name).write_text("old")
    with pytest.raises(KeyboardInterrupt):
        render_run(shapes / "blob.safetensors", tmp_path / name, RenderOptions(size=(8,), frames=3), progress=stop)
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {name: "old"}


def test_it_says_when_nothing_is_in_view(draw, tmp_path, capsys):
    away = look_at((1000.0, 0.0, 0.0), (2000.0, 0.0, 0.0), width=8, height=8)
    write_transforms(tmp_path / "away.json", {"a": away})
    assert (draw("blob.safetensors", f"--cameras {tmp_path}/away.json") == 255).all()
    assert "nothing of it is in view" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("blob.safetensors -o a.bmp", "a.bmp: unknown extension"),
        ("absent.safetensors -o a.png", "absent.safetensors: no such run"),
        ("blob.safetensors -o a.png --level 2", "--level 2: blob.safetensors has levels 0 to 1"),
        ("plain.obj -o a.png --level 0", "--level: plain.obj has no levels"),
        ("blob.safetensors -o a.png --levels --level 1", "--level: --levels draws all"),
        ("blob.safetensors -o a.png --shading color", "blob.safetensors: has no colours"),
        ("plain.obj -o a.png --shading curvature", "needs a field"),
        ("unit.safetensors -o a.png --shading error", "--reference FILE"),
        ("lost.safetensors -o a.png --shading error", "its cloud absent.ply is not to be found"),
        ("blob.safetensors -o a.png --reference cloud.ply --shading depth", "--reference: goes with --shading error"),
        ("blob.safetensors -o a.png --limits 0 1", "--limits: goes with --shading depth or curvature or error"),
        ("blob.safetensors -o a.jpg --background transparent", "--background transparent: needs a .png"),
        ("blob.safetensors -o a.png --cameras broken.json --frame 0", "broken.json: is not JSON"),
        ("blob.safetensors -o a.png --cameras transforms.json --frame c", "--frame c: transforms.json has 2 cameras"),
        ("blob.safetensors -o a.png --cameras transforms.json", "choose one with --frame"),
        ("blob.safetensors -o a.png --cameras transforms.json --frame a --zoom 2", "--zoom: the cameras of"),
        ("blob.safetensors -o a.png --cameras transforms.json --frame a --size 8 8", "--size: with --cameras"),
        ("blob.safetensors -o a.mp4 --cameras transforms.json", "the images have 2 sizes"),
        ("plain.obj -o a.gif --sides 2 --frames 2", "--sides: goes with a picture"),
        ("blob.safetensors -o a.mp4 --cameras transforms.json --frame a", "--frame: a film goes through"),
        ("nothing.safetensors -o a.png", "nothing.safetensors: no surface to render"),
        ("time.safetensors -o a.png", "time.safetensors: a surface that moves; say when with --time"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(shapes, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(shapes)
    before = sorted(shapes.iterdir())
    assert message in fails(capsys, f"render {arguments}")
    assert sorted(shapes.iterdir()) == before


def test_a_colour_bar_has_the_colours_in_order_and_ticks_at_round_numbers():
    ramp = np.linspace((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 256)
    picture = np.full((400, 480, 3), 7, np.uint8)
    both = with_color_bar(picture, ramp, (-0.35, 1.0), title="a number")
    assert (both[:400] == 7).all()
    strip = both[400:].astype(int)
    colored = (strip[..., 1] < 5) & (strip.max(axis=2) > 100)
    rows, columns = np.flatnonzero(colored.any(axis=1)), np.flatnonzero(colored.any(axis=0))
    bar = strip[rows[0], columns[0] : columns[-1] + 1]
    assert np.abs(bar[:, 2] - np.linspace(0, 255, len(bar))).max() <= 2
    ticks = np.flatnonzero((strip[rows[-1] + 1] < 120).all(axis=1))
    values = -0.35 + 1.35 * (ticks - columns[0]) / (len(bar) - 1)
    assert np.allclose(values / 0.2, np.rint(values / 0.2), atol=0.02)
    assert len(ticks) == 7


def test_colour_bars_suit_their_paper():
    ramp, picture = np.zeros((4, 3)), np.zeros((30, 200, 4), np.uint8)
    strip = with_color_bar(picture, ramp, (0, 1), title="t", background=None)[30:]
    assert (strip[0, 0, 3], strip[..., 3].max()) == (0, 255)
    dark = with_color_bar(picture[..., :3], ramp, (0, 1), title="t", background=(0, 0, 0.1))[30:]
    assert dark[0, 0].tolist() == [0, 0, 26]
    assert dark.min(axis=2).max() > 180  # light letters
