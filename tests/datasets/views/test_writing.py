"""Posed images on disk: what other programs would find in the files is what was written."""

import json
import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from mplicits.datasets.cameras import Camera, look_at
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.formats.shots import DepthSource
from mplicits.datasets.views.images import PosedImage, PosedImages, read_cameras, read_posed_images
from mplicits.datasets.views.writing import check_new_folder, write_colmap, write_neus, write_transforms
from mplicits.neural_fields import Similarity
from photographs import same_cameras, transforms
from refusals import refused

CENTER, SCALE = (10.0, -4.0, 2.0), 1.7


def photograph(index: int, *, masked: bool = True) -> PosedImage:
    """Noise seen from a place off centre, through a lens of no symmetry; sizes and lenses come in two kinds."""
    random = np.random.default_rng(index)
    width, height = (9, 7) if index % 2 else (8, 6)
    eye = np.array(CENTER) + 4 * random.normal(size=3)
    pose = look_at(eye.tolist(), CENTER, up=(0.1, 0.2, 1.0), width=width, height=height).world_from_camera
    lens = torch.tensor([[11.25, 0, 3.9], [0, 12.5, 2.7 + index % 2], [0, 0, 1]], dtype=torch.float64)
    color = random.integers(0, 256, (height, width, 3)) / np.float32(255)
    mask = random.integers(0, 256, (height, width)) / np.float32(255)
    return PosedImage(f"shot {index}.jpg", Camera(lens, pose, width, height), color, mask if masked else None)


@pytest.fixture
def photographs() -> PosedImages:
    points = np.random.default_rng(9).normal(size=(5, 3)) + CENTER
    views = tuple(photograph(index) for index in range(4))
    return PosedImages(views, Similarity(CENTER, SCALE), "made up", points, Path("nowhere"))


WRITERS = {"neus": write_neus, "transforms": write_transforms, "colmap": write_colmap}


def bytes_of(values) -> np.ndarray:
    return np.rint(values * 255).astype(np.uint8)


def test_transforms_have_opengl_poses_and_corners_of_pixels(tmp_path, photographs):
    write_transforms(tmp_path / "nerf", photographs)
    content = json.loads((tmp_path / "nerf" / "transforms.json").read_text())
    assert content["camera_angle_x"] == pytest.approx(2 * math.atan(4 / 11.25))
    expected = transforms([view.camera for view in photographs.views])["frames"]
    for frame, other, view in zip(content["frames"], expected, photographs.views, strict=True):
        np.testing.assert_allclose(frame["transform_matrix"], other["transform_matrix"], atol=1e-12)
        assert (frame["fl_x"], frame["fl_y"], frame["cx"]) == (11.25, 12.5, 4.4)
        picture = iio.imread(tmp_path / "nerf" / frame["file_path"])
        assert np.array_equal(picture[..., :3], bytes_of(view.color))
        assert np.array_equal(picture[..., 3], bytes_of(view.mask))
    found = [camera for _, camera in read_cameras(tmp_path / "nerf" / "transforms.json")]
    same_cameras(found, [view.camera for view in photographs.views])


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_read_is_what_was_written(tmp_path, photographs, name):
    WRITERS[name](tmp_path / "data", photographs)
    read = read_posed_images(tmp_path / "data", region=None if name == "neus" else photographs.similarity)
    same_cameras([view.camera for view in read.views], [view.camera for view in photographs.views])
    for view, written in zip(read.views, photographs.views, strict=True):
        assert Path(view.name).suffix == ".png"
        assert np.array_equal(bytes_of(view.color), bytes_of(written.color))
        # A file of masks says object or not; transparency says how much.
        mask = written.mask > 0.5 if name == "neus" else written.mask
        assert np.array_equal(bytes_of(view.mask), bytes_of(mask))
    assert np.allclose(read.similarity.center, CENTER, atol=1e-9)
    assert read.similarity.scale == pytest.approx(SCALE, rel=1e-9)
    assert np.array_equal(read.points, photographs.points) if name == "colmap" else read.points is None


def test_colmap_says_which_views_saw_a_point_and_where(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    images = render_scene(SCENES["painted-sphere"](), 5, 16, samples=1)
    images = replace(images, observations=images.observations[::7])
    write_colmap(tmp_path / "colmap", images)
    read = read_posed_images(tmp_path / "colmap")
    order = np.lexsort(read.observations.T)
    expected = images.observations[np.lexsort(images.observations.T)]
    assert np.array_equal(read.observations[order], expected)
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    for number, view in enumerate(images.views):
        marks = model.images[number + 1].points2D
        seen = images.observations[images.observations[:, 0] == number, 1]
        assert [mark.point3D_id for mark in marks] == (seen + 1).tolist()
        pixels, _ = view.camera.project(torch.from_numpy(images.points[seen]))
        assert np.abs(np.array([mark.xy for mark in marks]) - 0.5 - pixels.numpy()).max() < 1e-9
        for place, point in enumerate(seen):  # and each point leads back to its place
            track = [(element.image_id, element.point2D_idx) for element in model.points3D[point + 1].track.elements]
            assert (number + 1, place) in track


@pytest.mark.parametrize("name", WRITERS)
def test_depth_maps_are_beside_the_images(tmp_path, name):
    images = render_scene(SCENES["painted-sphere"](), 3, 16, samples=1, depths=True)
    WRITERS[name](tmp_path / "data", images)
    named = read_posed_images(tmp_path / "data")
    assert (named.views[0].depth is not None) == (name == "transforms")
    read = read_posed_images(tmp_path / "data", depths=DepthSource(tmp_path / "data" / "depths"))
    for view, written in zip(read.views, images.views, strict=True):
        # At the rim, where pixels mix near and far, nothing is known any more.
        known = np.isfinite(view.depth.numbers)
        assert known.sum() > 30
        assert np.array_equal(view.depth.numbers[known], written.depth.numbers[known])


def test_pictures_without_masks_have_no_alpha(tmp_path, photographs):
    bare = PosedImages((photograph(0, masked=False),), photographs.similarity, "", None, Path())
    for name, picture in (
        ("transforms", "images/000.png"),
        ("colmap", "images/000.png"),
        ("neus", "mask/000.png"),
    ):
        WRITERS[name](tmp_path / name, bare)
        assert iio.imread(tmp_path / name / picture).shape[2:] == (() if name == "neus" else (3,))
    assert iio.imread(tmp_path / "neus" / "mask" / "000.png").min() == 255


def test_nothing_is_overwritten_and_nothing_is_left_behind(tmp_path, photographs, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for folder, message in (("full", "is not empty"), ("file", "is a file"), ("file/where", "file is no folder")):
        with refused(tmp_path / folder, message):
            write_neus(tmp_path / folder, photographs)
    (tmp_path / "empty").mkdir()
    assert check_new_folder(tmp_path / "empty") == tmp_path / "empty"
    write_neus(tmp_path / "empty", photographs)
    assert (tmp_path / "empty" / "cameras_sphere.npz").is_file()

    def full_disk(*_arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mplicits.datasets.views.writing._write_png", full_disk)
    with refused(tmp_path / "new", "No space left on device"):
        write_colmap(tmp_path / "new", photographs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "file", "full"]
