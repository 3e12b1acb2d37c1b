"""Depth maps beside photographs: found by name, of any size, in any unit; and what is refused."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.formats.shots import DepthSource
from mplicits.datasets.views.images import read_posed_images
from mplicits.datasets.views.writing import write_transforms
from photographs import changed_transforms
from refusals import refused

SIZE = 24


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    write_transforms(folder, render_scene(SCENES["painted-sphere"](), 3, SIZE, samples=1))
    return folder


def named(folder: Path, key: str, files: list, **shared: object) -> Path:
    with changed_transforms(folder) as content:
        content.update(shared)
        for frame, file in zip(content["frames"], files, strict=False):
            frame[key] = file
    return folder


def ramp(width: int = SIZE, height: int = SIZE) -> np.ndarray:
    """Depths in which no step is an edge."""
    return np.linspace(3.0, 3.3, height)[:, None] + np.linspace(0, 0.1, width)


def numbers(folder: Path, source: DepthSource | None = None) -> np.ndarray:
    return read_posed_images(folder, depths=source).views[0].depth.numbers


def test_nerfstudio_names_millimetres(data: Path) -> None:
    for name in "abc":
        iio.imwrite(data / f"{name}.png", np.rint(1000 * ramp()).astype(np.uint16))
    found = numbers(named(data, "depth_file_path", ["a.png", "b.png", "c.png"]))
    np.testing.assert_allclose(found, ramp(), rtol=0, atol=6e-4)  # half a step, and float32
    assert numbers(data, DepthSource(scale=500.0))[0, 0] == pytest.approx(6.0, abs=2e-3)


def test_instant_ngp_says_what_a_step_is(data: Path) -> None:
    iio.imwrite(data / "a.png", np.rint(5000 * ramp()).astype(np.uint16))
    found = numbers(named(data, "depth_path", ["a.png"], integer_depth_scale=0.0002))
    np.testing.assert_allclose(found, ramp(), rtol=0, atol=2e-4)
    assert read_posed_images(data).views[1].depth is None  # not all photographs need one


@pytest.mark.parametrize("place", ["000.npy", "images/000.npy"])
def test_a_folder_has_a_file_for_each_photograph(data: Path, tmp_path: Path, place: str) -> None:
    folder = tmp_path / "maps"
    (folder / place).parent.mkdir(parents=True)
    np.save(folder / place, ramp())
    np.testing.assert_allclose(numbers(data, DepthSource(folder)), ramp(), rtol=1e-7)


def test_a_map_may_have_other_pixels_than_its_photograph(data: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "000.npy", ramp(2 * SIZE, 2 * SIZE))
    photograph = read_posed_images(data, depths=DepthSource(tmp_path)).views[0]
    camera = photograph.depth.camera
    assert (camera.width, camera.height) == (2 * SIZE, 2 * SIZE)
    fx, _, cx, _ = photograph.camera.fx_fy_cx_cy
    assert camera.fx_fy_cx_cy[0] == pytest.approx(2 * fx)
    assert camera.fx_fy_cx_cy[2] + 0.5 == pytest.approx(2 * (cx + 0.5))


def test_pixels_at_an_edge_in_depth_are_not_known(data: Path, tmp_path: Path) -> None:
    step = ramp()
    step[:, 12:] += 1.0
    np.save(tmp_path / "000.npy", step)
    sensor = numbers(data, DepthSource(tmp_path))
    assert np.isnan(sensor[:, 11:13]).all()
    assert np.isfinite(np.delete(sensor, (11, 12), axis=1)).all()
    # What a network gives has no units in which a step could be told from a slope.
    assert np.isfinite(numbers(data, DepthSource(tmp_path, "relative"))).all()


def test_what_is_missing_or_of_another_shape_is_refused(data: Path, tmp_path: Path) -> None:
    with refused("transforms.json", r"frames\[0\]: no depth .*gone\.png"):
        read_posed_images(named(data, "depth_file_path", ["gone.png"]))
    with refused("transforms.json", r"frames\[0\]\.depth_file_path: 3"):
        read_posed_images(named(data, "depth_file_path", [3]))
    named(data, "depth_file_path", ["gone.png"])
    for folder, message in ((tmp_path / "nowhere", "no such folder"), (tmp_path, r"expected 000\.png")):
        with refused(folder, message):
            read_posed_images(data, depths=DepthSource(folder))
    np.save(tmp_path / "000.npy", ramp(SIZE, SIZE + 6))
    with refused(tmp_path / "000.npy", "24 × 30 pixels, but .* 24 × 24"):
        read_posed_images(data, depths=DepthSource(tmp_path))
    iio.imwrite(tmp_path / "000.png", np.zeros((SIZE, SIZE), np.uint8))
    with refused(tmp_path / "000.png", "8 bits per pixel"):
        read_posed_images(data, depths=DepthSource(tmp_path))
