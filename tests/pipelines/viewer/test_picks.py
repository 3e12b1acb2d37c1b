"""Landmarks that are picked: two balls side by side, clicks on both, and the file that comes of them."""

from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from evolutions import fails
from mplicits.datasets.landmarks import read_landmarks
from mplicits.neural_fields import InputError, Similarity, Siren, SpaceTimeSDF, Sphere, save_field
from mplicits.pipelines.viewer.camera import probe
from mplicits.pipelines.viewer.client import Client
from mplicits.pipelines.viewer.picks import ASIDE, Picks, SideBySide, open_picks
from mplicits.pipelines.viewer.server import show_field

RADII = (0.8, 0.4)
PLACES = (Similarity((10.0, 0.0, 0.0), 2.0), Similarity((0.0, -5.0, 0.0), 0.1))


def two_balls() -> SideBySide:
    return SideBySide(*(Sphere(radius=radius) for radius in RADII))


def front(side: int) -> np.ndarray:
    """The foremost point of a ball, where it is shown."""
    return np.array([side - 0.5, 0.0, 0.5 * RADII[side]])


def picks(path: Path) -> Picks:
    return Picks(two_balls(), PLACES, ("cat", "dog"), path)


def test_two_shapes_at_half_size():
    """A ball is at its distance within its own sphere, and nowhere further than the other one's sphere."""
    field, x = two_balls(), 2 * torch.rand(2000, 3, dtype=torch.float64) - 1
    away = [x - x.new_tensor([side - 0.5, 0.0, 0.0]) for side in (0, 1)]
    radii = [part.norm(dim=1) for part in away]
    ours = [torch.where(r < 0.5, r - size / 2, r - 0.5 + ASIDE / 2) for r, size in zip(radii, RADII, strict=True)]
    left = x[:, 0] < 0
    own, other = torch.where(left, *ours), torch.where(left, *reversed(radii)) - 0.5 + ASIDE / 2
    found = field.jet(x)
    torch.testing.assert_close(found.value, own.minimum(other))
    normals = [part / r[:, None] for part, r in zip(away, radii, strict=True)]
    expected = torch.where((left == (own <= other))[:, None], *normals)
    torch.testing.assert_close(found.gradient, expected)


def test_a_ray_meets_what_is_shown():
    for side in (0, 1):
        point = front(side)
        reading = probe(two_balls(), Similarity.identity(), [point[0], 0.0, 3.0], [0.0, 0.0, -1.0], level=0)
        assert reading is not None
        np.testing.assert_allclose(reading.point, point, atol=1e-4)


def test_clicks_make_pairs_in_input_coordinates(tmp_path: Path):
    file = tmp_path / "pairs.txt"
    mine = picks(file)
    mine.pick(front(1) + np.array([0.0, 0.0, 0.1]))  # beside it, and put right by the next
    assert "Pair 1**: now click on the same point of cat (left)" in mine.text()
    mine.pick(front(1))
    assert not file.exists()
    mine.pick(front(0))
    before, after = read_landmarks(file)
    np.testing.assert_allclose(before, [[10.0, 0.0, 1.6]])
    np.testing.assert_allclose(after, [[0.0, -5.0, 0.04]])
    again = picks(file)  # goes on with what is there
    again.pick(front(0))
    assert "1 pair in" in again.text()
    numbers, places = zip(*again.places(), strict=True)
    assert numbers == (1, 1, 2)
    np.testing.assert_allclose(places, [front(0), front(1), front(0)], atol=1e-9)
    again.undo()
    assert (again.pairs, len(again.places())) == (1, 2)
    again.undo()
    assert again.pairs == 0
    assert not file.exists()


def test_a_browser_picks_and_takes_back(tmp_path: Path):
    mine = picks(tmp_path / "pairs.txt")
    handle = MagicMock()
    handle.gui.add_checkbox.return_value.value = False
    handle.gui.add_dropdown.side_effect = lambda _label, options, **_said: MagicMock(value=options[0])
    camera = handle.camera
    camera.image_width = camera.image_height = 64
    camera.wxyz, camera.position, camera.fov = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 0.6
    client = Client(handle, show_field(mine.field, picks=mine), MagicMock())
    read = handle.scene.on_click.return_value.call_args.args[0]
    for side in (0, 1):
        read(MagicMock(ray_origin=(side - 0.5, 0.0, 3.0), ray_direction=(0.0, 0.0, -1.0)))
    read(MagicMock(ray_origin=(0.0, 0.9, 3.0), ray_direction=(0.0, 0.0, -1.0)))  # past both
    np.testing.assert_allclose(read_landmarks(tmp_path / "pairs.txt")[0], [[10.0, 0.0, 1.6]], atol=1e-3)
    assert [call.args[1] for call in handle.scene.add_label.call_args_list] == ["1", "1", "1"]
    client._undo()
    assert mine.pairs == 0
    client.leave()


def test_what_cannot_be_picked_is_named(tmp_path: Path):
    (tmp_path / "other.txt").write_text("hello\n")
    with pytest.raises(InputError, match=r"other\.txt, line 1: expected six numbers"):
        picks(tmp_path / "other.txt")
    save_field(tmp_path / "film.safetensors", SpaceTimeSDF.from_static(Siren(8, 1)))
    with pytest.raises(InputError, match=r"film\.safetensors: moves; landmarks are picked on shapes that stand still"):
        open_picks([tmp_path / "film.safetensors"] * 2, tmp_path / "pairs.txt")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a b", "--landmarks: goes with two runs"),
        ("a --landmarks pairs.txt", "--landmarks: goes with two runs"),
        ("a b --landmarks pairs.txt --cloud c.ply", "--cloud: does not go with --landmarks"),
        ("a b --landmarks pairs.txt", "a: no such run directory or file"),
    ],
)
def test_bad_arguments(capsys: pytest.CaptureFixture[str], line: str, message: str):
    assert message in fails(capsys, f"view {line}")
