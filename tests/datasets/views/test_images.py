"""Posed photographs: colours, masks, cameras and regions come out as they were written, from every format."""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from mplicits.datasets import (
    Camera,
    PosedImage,
    PosedImages,
    linear_to_srgb,
    look_at,
    read_cameras,
    read_posed_images,
    srgb_to_linear,
)
from mplicits.neural_fields import Similarity
from photographs import changed_transforms, colmap_pose, project_by_opencv, projections, same_cameras, transforms
from photographs import write_image as write
from refusals import refused

WIDTH, HEIGHT, VIEWS = 48, 36, 6
CENTER, RADIUS = np.array([0.3, -0.2, 0.1]), 0.7
ROUNDED = 0.5 / 255 + 1e-5  # of a picture that was resampled to 8 bits, in float32
LENS = {"k1": -0.2, "k2": 0.05, "p1": 0.002, "p2": -0.001}


def cameras() -> list[Camera]:
    intrinsics = torch.tensor([[60.0, 0, 24.5], [0, 58.0, 17.0], [0, 0, 1]], dtype=torch.float64)
    turns = 2 * np.pi * np.arange(VIEWS) / VIEWS
    eyes = CENTER + 3 * np.stack((np.cos(turns), 0.5 * (-1.0) ** np.arange(VIEWS), np.sin(turns)), axis=1)
    views = [look_at(eye.tolist(), CENTER.tolist(), width=WIDTH, height=HEIGHT) for eye in eyes]
    return [Camera(intrinsics, view.world_from_camera, WIDTH, HEIGHT) for view in views]


def silhouette(camera: Camera) -> np.ndarray:
    eye, ways = (tensor.numpy() for tensor in camera.rays(dtype=torch.float64))
    to = CENTER - eye
    return to @ to - (ways @ to) ** 2 < RADIUS**2


def picture(index: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (size[1], size[0], 3), np.uint8)


def white_inside(mask: np.ndarray) -> np.ndarray:
    return mask.astype(np.uint8) * 255


def write_masks(
    folder: Path, name: str = "{:03d}.png", make: Callable[[np.ndarray], np.ndarray] = white_inside
) -> None:
    for index, camera in enumerate(cameras()):
        write(folder / name.format(index), make(silhouette(camera)))


def write_neus(folder: Path, *, scale: np.ndarray | None = None, masks: bool = True, **changes: np.ndarray) -> Path:
    scales = {} if scale is None else {f"scale_mat_{index}": scale for index in range(VIEWS)}
    for index in range(VIEWS):
        write(folder / "image" / f"{index:03d}.png", picture(index))
    if masks:
        write_masks(folder / "mask")
    np.savez(folder / "cameras_sphere.npz", **projections(cameras()), **(scales | changes))
    return folder


def write_transforms(folder: Path, size: tuple[int, int] = (WIDTH, HEIGHT), **shared: object) -> Path:
    for index in range(VIEWS):
        write(folder / "images" / f"{index}.png", picture(index, size))
    lens = {"fl_x": 60.0, "fl_y": 58.0, "cx": 25.0, "cy": 17.5, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps(transforms(cameras(), **lens, **shared)))
    return folder


def write_colmap(folder: Path, points: np.ndarray | None = None) -> Path:
    model, lines = folder / "sparse" / "0", ""
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 60 58 25 17.5\n")
    for index, camera in enumerate(cameras()):
        lines += f"{index} {' '.join(map(str, colmap_pose(camera)))} 1 {index}.png\n\n"
        write(folder / "images" / f"{index}.png", picture(index))
    (model / "images.txt").write_text(lines)
    if points is not None:
        rows = [f"{k} {x} {y} {z} 0 0 0 1" for k, (x, y, z) in enumerate(points)]
        (model / "points3D.txt").write_text("\n".join(rows))
    return folder


def sphere_points() -> np.ndarray:
    ways = np.random.default_rng(0).normal(size=(400, 3))
    return CENTER + RADIUS * ways / np.linalg.norm(ways, axis=1, keepdims=True)


def assert_as_written(read: PosedImages) -> None:
    same_cameras([view.camera for view in read.views], cameras())
    for index, view in enumerate(read.views):
        assert view.color.dtype == np.float32
        np.testing.assert_allclose(view.color, picture(index) / 255, atol=1e-6)


def test_neus(tmp_path):
    scale = np.diag([2.5, 2.5, 2.5, 1]).astype(np.float32)
    scale[:3, 3] = CENTER
    folder = write_neus(tmp_path, scale=scale)
    for path in (folder, folder / "cameras_sphere.npz"):
        read = read_posed_images(path)
        assert_as_written(read)
        assert [view.name for view in read.views] == [f"image/{k:03d}.png" for k in range(VIEWS)]
        for view, camera in zip(read.views, cameras(), strict=True):
            np.testing.assert_array_equal(view.mask, silhouette(camera))
        assert read.similarity.scale == 2.5
        np.testing.assert_allclose(read.similarity.center, CENTER, rtol=1e-6)
        assert read.region == "scale_mat_i of cameras_sphere.npz"
        assert read.points is None
        assert read.source == folder / "cameras_sphere.npz"


def test_transforms(tmp_path):
    read = read_posed_images(write_transforms(tmp_path))
    assert_as_written(read)
    assert all(view.mask is None for view in read.views)
    assert read.region == "what the cameras look at"
    assert np.linalg.norm(np.array(read.similarity.center) - CENTER) < 0.2
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert_as_written(read_posed_images(tmp_path))


def test_colmap(tmp_path):
    read = read_posed_images(write_colmap(tmp_path, sphere_points()))
    assert_as_written(read)
    np.testing.assert_allclose(read.points, sphere_points())
    assert read.region == "sparse points"
    assert np.linalg.norm(np.array(read.similarity.center) - CENTER) < 0.1
    assert RADIUS < read.similarity.scale < 1.2 * RADIUS
    assert read.source == tmp_path / "sparse" / "0"


def test_the_hull_of_the_masks_goes_before_points_and_both_before_cameras(tmp_path):
    folder = write_colmap(tmp_path, sphere_points() + 0.2)
    write_masks(folder / "masks", "{}.png.png")
    read = read_posed_images(folder)
    assert read.region == "visual hull of the masks"
    assert np.linalg.norm(np.array(read.similarity.center) - CENTER) < 0.1
    assert RADIUS < read.similarity.scale < 1.5 * RADIUS


def test_what_could_not_say_where_the_object_is_says_why(tmp_path):
    folder = write_colmap(tmp_path, sphere_points() + 900)
    write_masks(folder / "masks", "{}.png", lambda mask: 0 * white_inside(mask))
    region = read_posed_images(folder).region
    assert all(said in region for said in ("what the cameras look at", "; not masks: ", "; not points: 0 of 400"))


def test_masks_that_are_white_in_all_views_are_none(tmp_path):
    """NeuS wants white masks where there are none, and many programs write pictures with an opaque alpha."""
    folder = write_neus(tmp_path, masks=False)
    write_masks(folder / "mask", make=lambda mask: np.full_like(mask, 255, np.uint8))
    assert all(view.mask is None for view in read_posed_images(folder, width=17).views)
    write(folder / "mask" / "000.png", white_inside(silhouette(cameras()[0])))
    masks = [view.mask for view in read_posed_images(folder).views]
    assert [mask is not None and mask.min() for mask in masks] == [0, 1, 1, 1, 1, 1]


def test_without_anything_that_cameras_share_the_region_must_be_given(tmp_path):
    with changed_transforms(write_transforms(tmp_path)) as content:
        del content["frames"][1:]
    with refused(tmp_path / "transforms.json", "region: not found .* parallel"):
        read_posed_images(tmp_path, allow_missing=True)
    assert len(read_posed_images(tmp_path, region=Similarity.identity(), allow_missing=True).views) == 1


def test_distorted_pictures_show_the_world_where_the_new_cameras_have_it(tmp_path):
    """A dot at the ball's centre and one beside it; the json counts pixels from the corner."""
    write_transforms(tmp_path, **LENS)
    points = torch.tensor(np.stack((CENTER, CENTER + np.array((0.5, 0.35, 0.5)))))
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for index, camera in enumerate(cameras()):
        dots = project_by_opencv(camera, points, tuple(LENS.values()))
        squares = (x - dots[:, 0, None, None]) ** 2 + (y - dots[:, 1, None, None]) ** 2
        light = np.moveaxis(np.exp(-squares / (2 * 1.3**2)), 0, 2)  # one dot is red, the other green
        light = np.dstack((light, np.zeros((HEIGHT, WIDTH))))
        write(tmp_path / "images" / f"{index}.png", (linear_to_srgb(light) * 255 + 0.5).astype(np.uint8))
    for view in read_posed_images(tmp_path).views:
        light = srgb_to_linear(view.color.astype(np.float64))[..., :2]
        for k, expected in enumerate(view.camera.project(points)[0].numpy()):
            near = (np.abs(x - expected[0]) < 5) & (np.abs(y - expected[1]) < 5)
            weights = light[..., k] * near
            found = np.array(((weights * x).sum(), (weights * y).sum())) / weights.sum()
            np.testing.assert_allclose(found, expected, atol=0.1)


def test_opaque_distortion_needs_opencvs_full_model(tmp_path):
    write_transforms(tmp_path, k1=0.1, k4=0.2)
    with refused(tmp_path / "transforms.json", r"k4: 0\.2; .*FULL_OPENCV"):
        read_posed_images(tmp_path)
    read = read_posed_images(write_transforms(tmp_path, k1=0.1, k4=0.2, camera_model="FULL_OPENCV"))
    assert float(read.views[0].camera.intrinsics[0, 0]) != pytest.approx(60.0, abs=0.1)
    write_transforms(tmp_path, k1=-5.0)
    with refused(tmp_path / "transforms.json", r"frames\[0\]: distortion=\(-5\.0"):
        read_posed_images(tmp_path)


def test_smaller_pictures_are_averages_of_light_and_their_cameras_follow(tmp_path):
    read = read_posed_images(write_neus(tmp_path), width=WIDTH // 2)
    for index, (view, camera) in enumerate(zip(read.views, cameras(), strict=True)):
        light = srgb_to_linear(picture(index) / 255).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(view.color, linear_to_srgb(light), atol=ROUNDED)
        share = silhouette(camera).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(view.mask, share, atol=ROUNDED)
        expected = camera.resized(WIDTH // 2, HEIGHT // 2)
        torch.testing.assert_close(view.camera.intrinsics, expected.intrinsics)
        assert (view.camera.width, view.camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert_as_written(read_posed_images(tmp_path, width=10 * WIDTH))  # never enlarged


def test_transparent_pixels_lend_no_colour_to_their_neighbours(tmp_path):
    write_transforms(tmp_path)
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[:, ::2] = (200, 100, 50, 255)
    for index in range(VIEWS):
        write(tmp_path / "images" / f"{index}.png", image)
    view = read_posed_images(tmp_path, region=Similarity.identity()).views[0]
    np.testing.assert_array_equal(view.mask, np.tile([1.0, 0.0], (HEIGHT, WIDTH // 2)))
    view = read_posed_images(tmp_path, width=WIDTH // 2, region=Similarity.identity()).views[0]
    np.testing.assert_allclose(view.mask, 0.5, atol=ROUNDED)
    expected = np.broadcast_to(np.array([200, 100, 50]) / 255, view.color.shape)
    np.testing.assert_allclose(view.color, expected, atol=ROUNDED)


@pytest.mark.parametrize(
    "make",
    [
        white_inside,
        lambda mask: mask.astype(np.uint8),
        lambda mask: mask.astype(np.uint16) * 65535,
        lambda mask: np.repeat(mask.astype(np.uint8)[..., None], 3, axis=2) * 255,
        lambda mask: np.where(mask, 130, 125).astype(np.uint8),
    ],
)
def test_masks_of_any_depth_say_object_above_half(make, tmp_path):
    write_masks(write_neus(tmp_path, masks=False) / "mask", make=make)
    for view, camera in zip(read_posed_images(tmp_path).views, cameras(), strict=True):
        np.testing.assert_array_equal(view.mask, silhouette(camera))


def test_masks_of_a_transforms_json_are_named_frame_by_frame(tmp_path):
    write_masks(tmp_path / "m", "{}.png")
    with changed_transforms(write_transforms(tmp_path)) as content:
        for index, frame in enumerate(content["frames"]):
            frame["mask_path"] = f"m/{index}.png"
    read = read_posed_images(tmp_path)
    assert read.region == "visual hull of the masks"
    np.testing.assert_array_equal(read.views[2].mask, silhouette(cameras()[2]))


def test_cameras_follow_pictures_of_another_size_but_the_same_shape(tmp_path):
    read = read_posed_images(write_transforms(tmp_path, size=(WIDTH // 2, HEIGHT // 2)))
    expected = cameras()[0].resized(WIDTH // 2, HEIGHT // 2)
    torch.testing.assert_close(read.views[0].camera.intrinsics, expected.intrinsics)
    write_transforms(tmp_path, size=(HEIGHT, WIDTH))
    with refused(tmp_path, r"0\.png has 36 × 48 pixels.* 48 × 36"):
        read_posed_images(tmp_path)


def test_missing_files_are_counted_before_anything_is_read(tmp_path):
    write_transforms(tmp_path)
    for name in ("1", "4"):
        (tmp_path / "images" / f"{name}.png").unlink()
    (tmp_path / "images" / "0.png").write_bytes(b"damaged")
    with refused(tmp_path / "transforms.json", r"frames\[1\]: no image .*1\.png \(2 of 6"):
        read_posed_images(tmp_path)


def test_damaged_pictures_and_masks_of_another_size_are_named(tmp_path):
    mask = write_neus(tmp_path) / "mask" / "002.png"
    write(mask, np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with refused(mask, "49 × 36 pixels.* 48 × 36"):
        read_posed_images(tmp_path)
    mask.write_bytes(b"damaged")
    with refused(mask, "cannot be decoded"):
        read_posed_images(tmp_path)
    mask.unlink()
    with refused(tmp_path / "cameras_sphere.npz", "6 world_mat_i, but 5 masks"):
        read_posed_images(tmp_path)
    write(write_colmap(tmp_path / "colmap") / "masks" / "0.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with refused("images.txt", r"1\.png: no mask .*1\.png\.png \(5 of 6"):
        read_posed_images(tmp_path / "colmap")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_mat_3": np.diag([2.0, 2, 2, 1])}, "scale_mat_3: differs from scale_mat_0"),
        ({"scale_mat_0": np.diag([1.0, 2, 1, 1])}, "scale_mat_0: .*expected one uniform scale and shift"),
        ({"scale_mat_0": -np.eye(4)}, "scale_mat_0: .*expected one uniform scale and shift"),
        ({"scale_mat_0": np.full((4, 4), math.nan)}, "scale_mat_0: float64 of shape .*finite"),
        ({"scale_mat_0": np.eye(3)}, r"scale_mat_0: float64 of shape \(3, 3\)"),
    ],
)
def test_spheres_that_are_none_are_refused(change, message, tmp_path):
    write_neus(tmp_path, scale=np.eye(4), **change)
    with refused(tmp_path / "cameras_sphere.npz", message):
        read_posed_images(tmp_path)


def test_what_is_no_data_set_says_what_was_looked_for(tmp_path):
    with refused(tmp_path, r"none of cameras_sphere\.npz, "):
        read_posed_images(tmp_path)
    with pytest.raises(ValueError, match="width=0: expected at least one pixel"):
        read_posed_images(tmp_path, width=0)


def test_photographs_without_a_camera_are_counted(tmp_path):
    write_colmap(tmp_path, np.random.default_rng(0).normal(size=(50, 3)) * 0.2 + CENTER)
    for index in range(2):
        write(tmp_path / "images" / f"more{index}.png", picture(0))
    assert read_posed_images(tmp_path).reading == f"{VIEWS} of {VIEWS + 2} photographs have a camera"
    for index in range(20):
        write(tmp_path / "images" / f"more{index}.png", picture(0))
    with refused(tmp_path, "6 of 26 photographs .*--allow-missing"):
        read_posed_images(tmp_path)
    (tmp_path / "images" / "3.png").unlink()
    read = read_posed_images(tmp_path, allow_missing=True)
    assert [view.name for view in read.views] == [f"{k}.png" for k in range(VIEWS) if k != 3]
    assert read.reading == "5 of 26 photographs have a camera"


UNIT = Similarity((0.0, 0.0, 0.0), 1.0)


def lose_in_transforms(folder: Path, numbers: list[int], value: float) -> None:
    with changed_transforms(write_transforms(folder)) as content:
        for index in numbers:
            content["frames"][index]["transform_matrix"][0][3] = value


def null_in_transforms(folder: Path, numbers: list[int], _: float) -> None:
    with changed_transforms(write_transforms(folder)) as content:
        for index in numbers:
            content["frames"][index]["transform_matrix"] = None


def lose_in_neus(folder: Path, numbers: list[int], value: float) -> None:
    path = write_neus(folder, masks=False) / "cameras_sphere.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **arrays | {f"world_mat_{index}": np.full((4, 4), value) for index in numbers})


def lose_in_colmap(folder: Path, numbers: list[int], value: float) -> None:
    file = write_colmap(folder) / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    for index in numbers:
        lines[2 * index] = f"{index} {' '.join([str(value)] * 4)} 0 0 3 1 {index}.png"
    file.write_text("\n".join(lines))


def lose_in_binary_colmap(folder: Path, numbers: list[int], value: float) -> None:
    model = write_colmap(folder) / "sparse" / "0"
    (model / "cameras.txt").unlink()
    (model / "images.txt").unlink()
    lens = struct.pack("<QIiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 60, 58, 25, 17.5)
    images = struct.pack("<Q", VIEWS)
    for index, camera in enumerate(cameras()):
        pose = [value if index in numbers else number for number in colmap_pose(camera)]
        images += struct.pack("<I7dI", index, *pose, 1) + f"{index}.png".encode() + struct.pack("<xQ", 0)
    (model / "cameras.bin").write_bytes(lens)
    (model / "images.bin").write_bytes(images)


@pytest.mark.parametrize("value", [math.nan, -math.inf])
@pytest.mark.parametrize(
    "lose", [lose_in_transforms, null_in_transforms, lose_in_neus, lose_in_colmap, lose_in_binary_colmap]
)
def test_photographs_whose_pose_is_lost_are_left_out_and_counted(tmp_path, lose, value):
    lose(tmp_path / "few", [1, 4], value)
    read = read_posed_images(tmp_path / "few")
    assert [int(Path(view.name).stem) for view in read.views] == [0, 2, 3, 5]
    assert read.reading.startswith("4 of 6 photographs have a camera")
    same_cameras([view.camera for view in read.views], [cameras()[k] for k in (0, 2, 3, 5)])
    same_cameras((camera for _, camera in read_cameras(tmp_path / "few")), [cameras()[k] for k in (0, 2, 3, 5)])
    lose(tmp_path / "most", [0, 1, 3, 4], value)
    with refused(tmp_path / "most", "2 of 6 photographs .*--allow-missing"):
        read_posed_images(tmp_path / "most")
    assert len(read_posed_images(tmp_path / "most", allow_missing=True, region=UNIT).views) == 2
    lose(tmp_path / "all", [*range(VIEWS)], value)
    for read_all in (read_cameras, read_posed_images):
        with refused(tmp_path / "all", "finite"):
            read_all(tmp_path / "all")


def test_observations_go_with_the_photographs_that_stay(tmp_path):
    lose_in_colmap(tmp_path, [2], math.nan)
    tracks = [f"{k} 0.{k} 0 0 9 9 9 0.5 {k % VIEWS} 0 2 0 5 0\n" for k in range(12)]
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text("".join(tracks))
    read = read_posed_images(tmp_path, region=UNIT)
    kept = [0, 1, 3, 4, 5]
    expected = [(kept.index(view), k) for k in range(12) for view in (k % VIEWS, 2, 5) if view != 2]
    assert read.observations.tolist() == [list(pair) for pair in expected]


def test_names_that_were_written_on_windows(tmp_path):
    content = json.loads((write_transforms(tmp_path) / "transforms.json").read_text())
    unused = {"camera_angle_x": 0, "integer_depth_scale": 0}
    for frame in content["frames"]:
        frame.update(file_path=frame["file_path"].replace("/", "\\"), mask_path="", depth_file_path="")
    (tmp_path / "transforms.json").write_text(json.dumps(content | unused), encoding="utf-8-sig")
    read = read_posed_images(tmp_path)
    assert len(read.views) == VIEWS
    assert all(view.mask is None and view.depth is None for view in read.views)


@pytest.mark.parametrize("extension", [".tif", ".webp"])
def test_photographs_of_other_kinds(tmp_path, extension):
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101] if extension == ".webp" else []
    with changed_transforms(write_transforms(tmp_path)) as content:
        for index, frame in enumerate(content["frames"]):
            (tmp_path / frame["file_path"]).unlink()
            frame["file_path"] = f"images/{index}"  # Blender's leave the extension out
            cv2.imwrite(str(tmp_path / "images" / f"{index}{extension}"), picture(index)[..., ::-1], lossless)
    assert np.allclose(read_posed_images(tmp_path).views[2].color, picture(2) / 255, atol=1e-6)


def test_pictures_stay_in_the_bits_they_have_and_read_as_float32() -> None:
    camera = look_at((0, 0, 4), (0, 0, 0), width=16, height=16)
    levels = np.arange(768, dtype=np.uint8).reshape(16, 16, 3)
    between = (np.arange(256, dtype=np.float32).reshape(16, 16) / 256 + np.float32(0.001)).clip(0, 1)
    view = PosedImage("0.png", camera, levels, between)
    assert view.color.dtype == np.float32
    assert np.array_equal(view.color, levels / np.float32(255))
    assert view.color_bytes is levels
    assert np.array_equal(view.mask, between)  # numbers that 8 bits do not hold
    assert np.array_equal(view.mask_bytes, np.rint(255 * between).astype(np.uint8))
    copy = replace(view, name="1.png", mask=None)
    assert vars(copy)["color"].dtype == np.uint8
    assert np.array_equal(copy.color, view.color)
    assert copy.mask is None
    assert copy.mask_bytes is None
