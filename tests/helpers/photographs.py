"""A speckled sphere to photograph; posed photographs as other programs write them."""

import json
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import torch
from mplicits.datasets import Camera
from mplicits.datasets.synthetic.scenes import Scene
from mplicits.neural_fields import Sphere
from scipy.spatial.transform import Rotation

SPECKLES = np.random.default_rng(0).uniform(0, 1, (64, 64, 64, 3))


def speckled(points: np.ndarray) -> np.ndarray:
    return SPECKLES[tuple(np.floor((points + 2) * 14).astype(int).T % 64)]


SPECKLED = Scene("speckled", Sphere(radius=0.8), speckled, 0.85)


def eyes(count: int, distance: float) -> list[tuple[float, float, float]]:
    """Places on one side of the sphere, nine degrees apart."""
    angles = [math.radians(9 * number) for number in range(count)]
    return [(distance * math.cos(a), 0.6 * math.sin(2 * a), distance * math.sin(a)) for a in angles]


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, image)


def projections(cameras: Iterable[Camera]) -> dict[str, np.ndarray]:
    """``world_mat_i`` ``(4, 4)`` of NeuS: K [R t] in its upper rows."""
    found = {}
    for index, camera in enumerate(cameras):
        found[f"world_mat_{index}"] = np.eye(4)
        found[f"world_mat_{index}"][:3] = camera.intrinsics @ torch.linalg.inv(camera.world_from_camera)[:3]
    return found


def transforms(cameras: Iterable[Camera], **shared: object) -> dict:
    """A ``transforms.json``: the columns of a pose are right, up, backward and the eye."""
    frames = []
    for index, camera in enumerate(cameras):
        columns = torch.stack((camera.right, -camera.down, -camera.forward, camera.eye), dim=1)
        pose = [*columns.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose})
    return {**shared, "frames": frames}


@contextmanager
def changed_transforms(folder: Path) -> Iterator[dict]:
    """The content of a ``transforms.json``, which is written again after the block."""
    path = folder / "transforms.json"
    yield (content := json.loads(path.read_text()))
    path.write_text(json.dumps(content))


def colmap_pose(camera: Camera) -> list[float]:
    """World to camera: a quaternion w, x, y, z and a shift."""
    seen = torch.linalg.inv(camera.world_from_camera).numpy()
    x, y, z, w = Rotation.from_matrix(seen[:3, :3]).as_quat().tolist()
    return [w, x, y, z, *seen[:3, 3].tolist()]


def project_by_opencv(camera: Camera, points: torch.Tensor, lens: tuple[float, ...]) -> np.ndarray:
    """Pixels ``(N, 2)`` of points in the world through a distorted lens."""
    seen = torch.linalg.inv(camera.world_from_camera).numpy()
    turn, _ = cv2.Rodrigues(seen[:3, :3])
    matrix = camera.intrinsics.numpy()
    return cv2.projectPoints(points.numpy(), turn, seen[:3, 3], matrix, np.array(lens))[0].reshape(-1, 2)


def same_cameras(found: Iterable[Camera], expected: Iterable[Camera]) -> None:
    for camera, other in zip(found, expected, strict=True):
        assert (camera.width, camera.height) == (other.width, other.height)
        torch.testing.assert_close(camera.intrinsics, other.intrinsics, rtol=0, atol=1e-9)
        torch.testing.assert_close(camera.world_from_camera, other.world_from_camera, rtol=0, atol=1e-9)
