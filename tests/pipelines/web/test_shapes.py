"""Clouds, meshes and fields that no shader traces: what of them is on a page, and what the page makes of it."""

import base64
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from evolutions import fails
from mplicits.datasets import PointCloud, sample_sphere, write_cloud_ply
from mplicits.datasets.cameras import look_at
from mplicits.datasets.landmarks import read_landmarks
from mplicits.neural_fields import InputError, Similarity, Sphere, extract_mesh, save_field
from mplicits.pipelines.cli import main
from mplicits.pipelines.web.assembly import SCRIPTS, field_file
from mplicits.pipelines.web.export import WebOptions, pack
from mplicits.pipelines.web.landmarks import Pairs
from mplicits.pipelines.web.serve import PageServer
from mplicits.pipelines.web.shapes import read_shape
from pages import open_page, rendered, round_field, until

PAGE = Path(__file__).parents[3] / "pipelines" / "web" / "page"
NODE = shutil.which("node")
# What the page reads of a file, and which of two pictures it shows in each pixel.
READ = """
const [text, one, other] = JSON.parse(require('fs').readFileSync(0));
const bytes = Uint8Array.from(Buffer.from(text, 'base64'));
const picture = ({ seen, color }) => ({ seen: Float32Array.from(seen), color: Float32Array.from(color) });
splitFile(bytes.buffer).then(({ header, arrays }) => {
  const { seen, color } = nearer(picture(one), picture(other), 0.1);
  const found = Object.fromEntries([...arrays].map(([name, numbers]) => [name, Array.from(numbers)]));
  console.log(JSON.stringify([header, found, Array.from(seen), Array.from(color)]));
});
"""


def ball(file: Path) -> None:
    save_field(file, round_field(0.6), similarity=Similarity((10.0, 0.0, 0.0), 2.0))


@pytest.fixture
def cloud(tmp_path) -> Path:
    points = sample_sphere(500).points * 4 + np.array([10.0, 0.0, 0.0])
    write_cloud_ply(tmp_path / "cloud.ply", PointCloud(points, None, np.abs(points / 13).clip(0, 1).astype(np.float32)))
    return tmp_path / "cloud.ply"


@pytest.fixture
def box(tmp_path) -> Path:
    trimesh.creation.box((2, 1, 1)).export(tmp_path / "box.obj")
    return tmp_path / "box.obj"


def read_by_page(source: Path, one: dict | None = None, other: dict | None = None) -> list:
    if NODE is None:
        pytest.skip("no node on this machine")
    packed = pack(source)
    script = "\n".join((PAGE / name).read_text(encoding="utf-8") for name in (*SCRIPTS[:3], "file.js"))
    empty = {"seen": [], "color": []}
    text = base64.b64encode(field_file(packed.header, packed.data)).decode()
    given = json.dumps([text, one or empty, other or empty])
    return json.loads(subprocess.run([NODE, "-e", script + READ], input=given, capture_output=True, text=True).stdout)


def test_the_page_reads_the_points_of_a_cloud(cloud: Path):
    header, arrays, *_ = read_by_page(cloud)
    (shape,) = header["shapes"]
    assert (shape["kind"], shape["count"], shape["colored"], header["levels"]) == ("points", 500, True, [])
    low, high = np.array(shape["low"]), np.array(shape["high"])
    places = low + np.array(arrays["shape0.vertices"]).reshape(-1, 3) / 65535 * (high - low)
    found = places * header["unit"] + np.array(header["center"])
    assert np.allclose(np.linalg.norm(found - [10, 0, 0], axis=1), 2, atol=1e-3)
    expected = 255 * np.abs(found / 13).clip(0, 1)
    assert np.abs(np.array(arrays["shape0.colors"]).reshape(-1, 3) - expected).max() <= 2  # the file has 8 bits too
    assert 0 < shape["size"] < 0.5


def test_the_page_reads_the_triangles_of_a_mesh(box: Path):
    header, arrays, *_ = read_by_page(box)
    (shape,) = header["shapes"]
    assert (shape["kind"], shape["count"], shape["colored"]) == ("triangles", 12, False)
    assert sorted(set(arrays["shape0.faces"])) == list(range(8))
    assert np.ptp(np.array(arrays["shape0.vertices"])) == 65535
    extent = (np.array(shape["high"]) - shape["low"]) * header["unit"]
    assert np.allclose(extent, [2, 1, 1])


def test_what_is_nearer_is_seen(box: Path):
    one = {"seen": [0, 0, 1, 2, 0, 0, 1, 2, 0, 0, 0, 0, 0, 0, 1, 2], "color": []}
    other = {"seen": [1, 0, 0, 2.05, 1, 0, 0, 3, 1, 0, 0, 9, 0, 0, 0, 0], "color": [0.5] * 16}
    *_, seen, color = read_by_page(box, one, other)
    assert np.allclose(np.array(seen).reshape(4, 4)[:, 3], [2.05, 2, 9, 2])
    assert np.array(color).reshape(4, 4)[:, 0].tolist() == [0.5, 0, 0.5, 0]


def test_a_field_that_no_shader_traces_is_shown_as_a_mesh(tmp_path):
    save_field(tmp_path / "ball.safetensors", Sphere(radius=0.5))
    packed = pack(tmp_path / "ball.safetensors")
    (shape,) = packed.header["shapes"]
    assert shape["name"] == "level 0"
    assert shape["count"] == packed.page.triangles > 1000


def test_the_cloud_beside_a_field_has_the_colours_of_its_distance(cloud: Path, tmp_path):
    ball(tmp_path / "ball.safetensors")
    packed = pack(tmp_path / "ball.safetensors", WebOptions(cloud=cloud))
    (shape,) = packed.header["shapes"]
    assert len(packed.header["levels"]) == 1
    assert (shape["hidden"], shape["colored"]) == (True, True)
    assert np.allclose(np.abs(shape["low"]), 1, atol=0.05)  # in the field's coordinates: 2 input units of 2
    assert pack(tmp_path / "ball.safetensors", WebOptions(cloud="auto")).header["shapes"] == []


def test_mistakes_are_one_line(cloud: Path, tmp_path, capsys):
    ball(tmp_path / "ball.safetensors")
    run, page = str(tmp_path / "ball.safetensors"), str(tmp_path / "page.html")
    (tmp_path / "empty.ply").write_text("ply")
    for line, expected in (
        (f"web {cloud} -o {page} --levels 1", "--levels: goes with a run"),
        (f"web {tmp_path}/empty.ply -o {page}", "empty.ply"),
        (f"view {run} --stream", "unknown flag --stream"),
        (f"view {run} --size 64", "--size"),
        (f"view {run} {run}", "--landmarks"),
        (f"view {run} {run} --landmarks {cloud}", "cloud.ply"),
        (f"view {run} --cloud {tmp_path}/none.ply", "none.ply"),
    ):
        assert expected in fails(capsys, line)


def test_landmarks_are_kept_in_input_coordinates(tmp_path):
    ball(tmp_path / "a.safetensors")
    save_field(tmp_path / "b.safetensors", Sphere(radius=0.5))
    pairs = Pairs((tmp_path / "a.safetensors", tmp_path / "b.safetensors"), tmp_path / "pairs.txt")
    header = pairs.pack().header
    assert header["landmarks"] == {"names": ["a", "b"], "pairs": []}
    left, right = header["shapes"]
    assert left["high"][0] < 0 < right["low"][0]
    pairs.keep([[[-0.2, 0, 0], [0.75, 0, 0]]])
    np.testing.assert_allclose(read_landmarks(tmp_path / "pairs.txt"), [[[11.2, 0, 0]], [[0.5, 0, 0]]], atol=1e-6)
    again = Pairs((tmp_path / "a.safetensors", tmp_path / "b.safetensors"), tmp_path / "pairs.txt")
    assert np.allclose(again.pack().header["landmarks"]["pairs"], [[[-0.2, 0, 0], [0.75, 0, 0]]])
    for wrong in ([[[0, 0, 0]]], [[1]], {"a": 1}, "text", [[["x", 0, 0], [0, 0, 0]]], [[[np.nan, 0, 0], [0, 0, 0]]]):
        with pytest.raises(ValueError, match="landmarks"):
            pairs.keep(wrong)
    pairs.keep([])
    assert not (tmp_path / "pairs.txt").exists()
    with pytest.raises(InputError):
        Pairs((tmp_path / "a.safetensors", tmp_path / "none"), tmp_path / "pairs.txt")


def depth_of_ball(eye: np.ndarray, directions: np.ndarray, radius: float) -> np.ndarray:
    """Depths ``(H, W)`` at which rays meet a ball around the origin; infinite where they miss it."""
    along = directions @ eye
    under = along**2 - eye @ eye + radius**2
    return np.where(under > 0, -along - np.sqrt(under.clip(0)), np.inf)


def depth_of_discs(eye: np.ndarray, directions: np.ndarray, forward: np.ndarray, points: np.ndarray, radius: float):
    """Depths ``(H, W)`` at which rays meet discs around points, parallel to the picture; infinite where they miss."""
    offsets = points - eye
    depth = (offsets @ forward) / (directions @ forward)[..., None]  # (H, W, N)
    beside = np.linalg.norm(depth[..., None] * directions[..., None, :] - offsets, axis=-1)
    return np.where(beside <= radius, depth, np.inf).min(axis=-1)


@pytest.mark.parametrize("kind", ["cloud", "mesh", "both"])
def test_a_page_draws_what_it_shows(browser, cloud: Path, tmp_path, kind: str):
    """Depths of a ball as points, as triangles, and as points around a traced field, against exact ones."""
    source = {"cloud": cloud, "mesh": tmp_path / "ball.ply", "both": tmp_path / "ball.safetensors"}[kind]
    out = tmp_path / "page.html"
    if kind == "mesh":
        extract_mesh(Sphere(radius=1.0), resolution=32).to_trimesh().export(source)
    elif kind == "both":
        ball(source)
    assert main(f"web {source} -o {out} {f'--cloud {cloud}' if kind == 'both' else ''}".split()) == 0
    open_page(browser, out.as_uri())
    camera = look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov=40.0, width=48, height=48)
    found, counts = rendered(browser, camera, hidden=[])
    eye, directions = (part.double().numpy() for part in camera.rays())
    expected = depth_of_ball(eye, directions, {"mesh": 1.0, "cloud": 0.0, "both": 0.6}[kind])
    if kind != "mesh":
        packed = pack(source, WebOptions(cloud=cloud if kind == "both" else None))
        (shape,) = packed.header["shapes"]
        places, own = read_shape(cloud)
        points = places.vertices
        if kind == "both":
            points = (own.to_input(points) - np.array([10.0, 0.0, 0.0])) / 2
        discs = depth_of_discs(eye, directions, camera.forward.double().numpy(), points, shape["size"] / 2)
        expected = np.where(discs <= expected + shape["size"], discs, expected)  # the page prefers points near a field
    hit, known = found[..., 3] > 0, np.isfinite(expected)
    assert known.sum() > 800
    # A rasteriser may round corners to 1/16 of a pixel, so a few pixels see the neighbour of a disc.
    assert (hit != known).mean() < 0.01
    wrong = np.abs(found[..., 3] - expected)[hit & known] > 0.02
    assert wrong.mean() < 0.05
    assert len(counts["color"]) == hit.size
    assert not browser.find_element("id", "message").is_displayed()


def test_landmarks_are_clicked(browser, tmp_path):
    for name in "ab":
        ball(tmp_path / f"{name}.safetensors")
    pairs = Pairs((tmp_path / "a.safetensors", tmp_path / "b.safetensors"), tmp_path / "pairs.txt")
    with PageServer(pairs.pack, keep=pairs.keep) as server:
        browser.get(f"{server.url}?pixel=16&webgl")
        until(lambda: browser.find_elements("id", "undo"))
        click = "return begun.then((page) => page.tools.landmarks.pick(arguments[0]))"
        browser.execute_script(click, [0.7, 0.0, 0.0])
        browser.execute_script(click, [-0.2, 0.0, 0.0])
        until(lambda: (tmp_path / "pairs.txt").exists())
        browser.execute_script("document.getElementById('undo').click()")
        until(lambda: not (tmp_path / "pairs.txt").exists())
