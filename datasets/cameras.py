"""Cameras with lens distortion: pixels to rays and back, and orbits around a shape; in float64, for map coordinates.

OpenCV's convention: x right, y down, z forward. The centre of pixel (0, 0) is at (0, 0): an image runs from −0.5 to
width − 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..neural_fields import InputError, Similarity
from ..neural_fields.backend.arrays import Float64

UP_AXES: Mapping[str, tuple[float, float, float]] = MappingProxyType({"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)})
"""The names of the axes that may point up, and their directions."""

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's axes (x right, y up, z backward) to OpenCV's, and back
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # of OpenCV's distortion, in its order
OBLIQUE = 1e-3  # how far the axes of a pose in a file may be from orthogonal and of one length, as a share of it
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)  # OpenCV's own five steps leave 1e-3


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with a pose, and the distortion of its lens if it has any.

    Attributes:
        intrinsics: ``(3, 3)`` float64, in pixels: ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``.
        world_from_camera: ``(4, 4)`` float64 rigid pose; its columns are right, down, forward and the eye.
        width: of the image, in pixels.
        height: of the image, in pixels.
        distortion: the first of k1, k2, p1, p2, k3, k4, k5, k6 of OpenCV's model; ``()`` if all are zero.

    Raises:
        ValueError: a matrix has another shape, type or form, the image has no pixels, or a coefficient is not finite.

    Example:
        >>> camera = look_at((0, 0, 4), (0, 0, 0), width=3, height=3)
        >>> pixel, z = camera.project(torch.zeros(3))
        >>> pixel.tolist(), z.item()
        ([1.0, 1.0], 4.0)
    """

    intrinsics: Tensor
    world_from_camera: Tensor
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.distortion) > len(COEFFICIENTS) or not np.isfinite(self.distortion).all():
            raise ValueError(f"distortion={self.distortion}: expected at most {len(COEFFICIENTS)} finite numbers")
        if not any(self.distortion):
            object.__setattr__(self, "distortion", ())
        for name, shape in (("intrinsics", (3, 3)), ("world_from_camera", (4, 4))):
            matrix = getattr(self, name)
            if tuple(matrix.shape) != shape or matrix.dtype != torch.float64:
                raise ValueError(f"{name}: {tuple(matrix.shape)} of {matrix.dtype}; expected {shape} of torch.float64")
            if not bool(matrix.isfinite().all()):
                raise ValueError(f"{name}: holds a number that is not finite")
        for name in ("width", "height"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least one pixel")
        (fx, skew, _), (low, fy, _), last = self.intrinsics.tolist()
        if fx <= 0 or fy <= 0 or skew or low or last != [0, 0, 1]:
            expected = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
            raise ValueError(f"intrinsics: {self.intrinsics.tolist()}; expected {expected}")
        axes = self.world_from_camera[:3, :3]
        off = float((axes.T @ axes - torch.eye(3, dtype=torch.float64, device=axes.device)).abs().max())
        if off > 1e-6 or float(torch.linalg.det(axes)) < 0 or self.world_from_camera[3].tolist() != [0, 0, 0, 1]:
            raise ValueError(
                f"world_from_camera: {self.world_from_camera.tolist()}; expected a rigid pose (right-handed unit axes)"
            )

    @property
    def fx_fy_cx_cy(self) -> tuple[float, float, float, float]:
        """Focal lengths and the place where the axis meets the image, in pixels."""
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics.tolist()
        return fx, fy, cx, cy

    @property
    def eye(self) -> Tensor:
        """``(3,)`` where the camera stands, in world coordinates."""
        return self.world_from_camera[:3, 3]

    @property
    def right(self) -> Tensor:
        """``(3,)`` unit direction of growing x, in world coordinates."""
        return self.world_from_camera[:3, 0]

    @property
    def down(self) -> Tensor:
        """``(3,)`` unit direction of growing y, in world coordinates."""
        return self.world_from_camera[:3, 1]

    @property
    def forward(self) -> Tensor:
        """``(3,)`` unit direction of view, in world coordinates."""
        return self.world_from_camera[:3, 2]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """The eye ``(3,)`` and unit directions ``(H, W, 3)`` through the pixels' centres, in world coordinates.

        Both are computed in float64 and rounded once to ``dtype``.
        """
        # Metal has no float64: its rays are computed on the CPU.
        place = "cpu" if torch.device(device).type == "mps" else device
        pose = self.world_from_camera.to(place)
        directions = torch.nn.functional.normalize(self.sight_lines(device=place), dim=-1) @ pose[:3, :3].T
        return pose[:3, 3].to(dtype).to(device), directions.to(dtype).to(device)

    def sight_lines(self, *, device: torch.device | str = "cpu") -> Tensor:
        """``(H, W, 3)`` float64: the points at depth 1 that the pixels see, in camera coordinates."""
        from kornia.geometry.depth import unproject_meshgrid  # imported here: it takes a fifth of a second

        if not self.distortion:
            matrix = self.intrinsics.to(device)[None]
            return unproject_meshgrid(
                self.height, self.width, matrix, device=torch.device(device), dtype=torch.float64
            )[0]
        pixels = np.stack(np.meshgrid(np.arange(self.width), np.arange(self.height)), axis=-1).astype(np.float64)
        lines = np.ones((self.height, self.width, 3))
        lines[..., :2] = self.slopes_at(pixels.reshape(-1, 2)).reshape(self.height, self.width, 2)
        return torch.from_numpy(lines).to(device)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Where points ``(..., 3)`` fall in the image: pixels ``(..., 2)`` and depths z ``(...,)`` along the axis.

        Both are float64, on the points' device. Pixels are meaningless where z ≤ 0, behind the camera.
        """
        from kornia.geometry.camera import project_points

        if points.ndim == 0 or points.shape[-1] != 3:
            raise ValueError(f"points: shape {tuple(points.shape)}; expected (..., 3)")
        pose = self.world_from_camera.to(points.device)
        # The eye is taken off first, while map coordinates still have all their digits.
        seen = (points.double() - pose[:3, 3]) @ pose[:3, :3]
        rows = seen.reshape(-1, 3)
        if self.distortion:
            pixels = torch.from_numpy(self.pixels_at((rows[:, :2] / rows[:, 2:]).cpu().numpy())).to(points.device)
        else:
            pixels = project_points(rows, self.intrinsics.to(points.device))
        return pixels.reshape(*points.shape[:-1], 2), seen[..., 2]

    def in_view(self, points: Float64) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Pixels ``(N, 2)`` and depths ``(N,)`` of points ``(N, 3)``, and a mask ``(N,)`` of those in the picture.

        The polynomials of a distorted lens turn back far outside the image. So a point is inside only if its ray is
        within those of the image.
        """
        seen = (points - self.eye.numpy()) @ self.world_from_camera[:3, :3].numpy()
        depths = seen[:, 2]
        inside = depths > 0
        slopes = np.where(inside[:, None], seen[:, :2] / np.where(inside, depths, 1.0)[:, None], 0.0)
        pixels = self.pixels_at(slopes)
        for along, most in zip(pixels.T, (self.width, self.height), strict=True):
            inside &= (along >= -0.5) & (along < most - 0.5)
        if self.distortion:
            fx, fy, _, _ = self.fx_fy_cx_cy
            among, pixel = self.sight_lines().numpy()[..., :2], 1 / math.sqrt(fx * fy)
            low, high = among.min(axis=(0, 1)) - pixel, among.max(axis=(0, 1)) + pixel
            inside &= ((slopes >= low) & (slopes <= high)).all(axis=1)
        return pixels, depths, inside

    def slopes_at(self, pixels: Float64) -> Float64:
        """Undistorted slopes x / z and y / z in camera coordinates ``(N, 2)`` of pixels ``(N, 2)``."""
        matrix, lens = self.for_opencv
        if of_opencv_4 := getattr(cv2, "undistortPointsIter", None):  # whose undistortPoints stops after five steps
            found = of_opencv_4(pixels[:, None], matrix, lens, None, None, UNDISTORTION)
        else:
            found = cv2.undistortPoints(pixels[:, None], matrix, lens, criteria=UNDISTORTION)
        return np.asarray(found, np.float64).reshape(-1, 2)

    def pixels_at(self, slopes: Float64) -> Float64:
        """The pixels ``(N, 2)`` of slopes ``(N, 2)``: the inverse of `slopes_at`."""
        if not self.distortion:  # an affine map, ten times as fast as OpenCV's
            fx, fy, cx, cy = self.fx_fy_cx_cy
            return slopes * (fx, fy) + (cx, cy)
        if not len(slopes):
            return slopes
        ahead = np.column_stack((slopes, np.ones(len(slopes))))
        found, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), *self.for_opencv)
        return np.asarray(found, np.float64).reshape(-1, 2)

    @property
    def for_opencv(self) -> tuple[Float64, Float64]:
        """Matrix ``(3, 3)`` and coefficients ``(8,)`` for OpenCV."""
        coefficients = np.zeros(len(COEFFICIENTS))
        coefficients[: len(self.distortion)] = self.distortion
        return self.intrinsics.cpu().numpy(), coefficients

    def pinhole(self) -> Camera:
        """The camera without the distortion of its lens."""
        return replace(self, distortion=())

    def moved(self, similarity: Similarity) -> Camera:
        """The same camera in unit-sphere coordinates."""
        pose = self.world_from_camera.clone()
        pose[:3, 3] = torch.from_numpy(similarity.to_unit(self.eye.cpu().numpy()))
        return replace(self, world_from_camera=pose)

    def strip(self, first: int, rows: int) -> Camera:
        """The camera of ``rows`` rows of the image from row ``first`` on."""
        matrix = self.intrinsics.clone()
        matrix[1, 2] -= first
        return replace(self, intrinsics=matrix, height=rows)

    def fits(self, width: int, height: int) -> bool:
        """Whether an image of that size may show the same view: both sides scaled by one factor, but for rounding."""
        return abs(self.height * width / self.width - height) < 1

    def resized(self, width: int, height: int) -> Camera:
        """The same view in other pixels, which are not square if the aspect ratio changes.

        Corners, not pixel centres, stay: x becomes ``(x + 0.5) · width / self.width − 0.5``.
        """
        sx, sy = width / self.width, height / self.height
        scale = self.intrinsics.new_tensor([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return replace(self, intrinsics=scale @ self.intrinsics, width=width, height=height)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """``(3, 3)``: ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in float64."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def rigid_pose(value: Any, named: str, *, scaled: bool = False) -> Float64:
    """A pose ``(4, 4)`` of a file that has three or four rows of four numbers, with the nearest rotation.

    Files have the digits of float32, or fewer. A camera that was lost has a pose of NaN: no number of the file's is
    finite, or, if it may be ``scaled``, one is not. Then a common length of the axes, which moves no ray, is left out.
    An InputError that begins with ``named`` is raised for anything else.
    """
    expected = "expected a rigid pose, three or four rows of four numbers"
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{named}: {expected} ({error})") from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{named}: shape {matrix.shape}; {expected}")
    finite = np.isfinite(matrix[:3])
    if not (finite.all() if scaled else finite.any()):
        return np.full((4, 4), np.nan)
    left, lengths, right = np.linalg.svd(np.where(finite, matrix[:3], 0)[:, :3])
    unit = lengths[0] if scaled else 1.0
    rigid = bool(unit) and np.abs(lengths - unit).max() <= OBLIQUE * unit and np.linalg.det(left @ right) > 0
    if not (rigid and finite.all() and (scaled or (matrix[3:] == (0, 0, 0, 1)).all())):
        numbers = matrix.round(4).tolist()
        raise InputError(f"{named}: is singular, mirrored, oblique or not finite: {numbers}; {expected}")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = left @ right, matrix[:3, 3]
    return pose


def pinhole_intrinsics(fov: float, width: int, height: int) -> Tensor:
    """The ``(3, 3)`` matrix of square pixels and an axis through the middle; ``fov`` is vertical, in degrees."""
    if not 0 < fov < 180:
        raise ValueError(f"fov={fov}: expected degrees between 0 and 180")
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    return intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)


def look_at(
    eye: Sequence[float] | Tensor,
    target: Sequence[float] | Tensor,
    *,
    up: Sequence[float] | Tensor = UP_AXES["y"],
    fov: float = 25.0,
    width: int,
    height: int,
) -> Camera:
    """A camera at ``eye`` with ``target`` in the middle of its image.

    Args:
        eye: ``(3,)`` position of the camera.
        target: ``(3,)`` point in the middle of the image.
        up: ``(3,)`` direction that is up in the image. If the view is along it, the image's right is +x (or +y, if the
            view is along x).
        fov: full vertical angle of view, degrees.
        width: of the image, in pixels.
        height: of the image, in pixels.

    Raises:
        ValueError: ``eye`` and ``target`` coincide, ``up`` is zero, or one of them is not three finite numbers.
    """
    eye, target, up = _vector("eye", eye), _vector("target", target), _vector("up", up)
    forward = target - eye
    if not float(forward.norm()):
        raise ValueError(f"target={target.tolist()}: is where the eye is, so there is no direction of view")
    if not float(up.norm()):
        raise ValueError("up: is zero; expected a direction")
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, up / up.norm())
    if float(right.norm()) < 1e-9:  # the view runs along the up direction
        axis = torch.eye(3, dtype=torch.float64)[1 if abs(float(forward[0])) > 0.9 else 0]
        right = axis - (axis @ forward) * forward
    return _camera(eye, right / right.norm(), forward, pinhole_intrinsics(fov, width, height), width, height)


def orbit(
    points: NDArray[np.floating] | Tensor,
    *,
    azimuth: float = 30.0,
    elevation: float = 15.0,
    up: str = "y",
    fov: float = 25.0,
    width: int = 640,
    height: int = 640,
    margin: float = 0.94,
    zoom: float = 1.0,
) -> Camera:
    """A camera on a sphere around the middle of ``points``, as near as possible with all of them in view.

    Args:
        points: ``(N, 3)``; the corners of a box are enough.
        azimuth: degrees around the up axis, counter-clockwise from the front (+z for ``up="y"``, −y for ``up="z"``).
        elevation: degrees above the horizon, from −90 (from below) to 90 (from above).
        up: "y" or "z", the axis that points up.
        fov: full vertical angle of view, degrees.
        width: of the image, in pixels.
        height: of the image, in pixels.
        margin: share of the image that the points may fill.
        zoom: magnification from the same place.

    Raises:
        ValueError: an argument is out of its range, or the points are not ``(N, 3)``, not finite or all the same.
    """
    view: dict[str, Any] = {"up": up, "fov": fov, "width": width, "height": height, "margin": margin, "zoom": zoom}
    return turntable(points, 1, azimuth=azimuth, elevation=elevation, **view)[0]


def turntable(
    points: NDArray[np.floating] | Tensor,
    frames: int,
    *,
    azimuth: float = 30.0,
    elevation: float = 15.0,
    up: str = "y",
    fov: float = 25.0,
    width: int = 640,
    height: int = 640,
    margin: float = 0.94,
    zoom: float = 1.0,
) -> list[Camera]:
    """Cameras evenly spaced on a circle around ``points``, from ``azimuth`` on, at the largest distance of any `orbit`.

    Other arguments as for `orbit`.

    Raises:
        ValueError: ``frames`` is not positive, or as for `orbit`.
    """
    if frames < 1:
        raise ValueError(f"frames={frames}: expected at least one")
    if not 0 < margin <= 1:
        raise ValueError(f"margin={margin}: expected more than 0 and at most 1")
    if not (zoom > 0 and math.isfinite(zoom)):
        raise ValueError(f"zoom={zoom}: expected a positive number")
    points = torch.as_tensor(points, dtype=torch.float64, device="cpu")
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not bool(points.isfinite().all()):
        raise ValueError(f"points: shape {tuple(points.shape)}; expected (N, 3) finite numbers, N > 0")
    center = (points.amin(dim=0) + points.amax(dim=0)) / 2
    offset = points - center
    if not bool(offset.any()):
        raise ValueError("points: all of them coincide, so there is no distance to look from")
    axes = [_orbit_axes(azimuth + 360 * frame / frames, elevation, up) for frame in range(frames)]
    matrix = pinhole_intrinsics(fov, width, height)
    slopes = margin * torch.tensor([width, height]) / 2 / matrix.diagonal()[:2]
    distance = 0.0
    for right, forward in axes:
        seen = offset @ torch.stack((right, torch.linalg.cross(forward, right), forward), dim=1)  # (N, 3)
        # From distance d, a point at camera offset (x, y, z) is in view if |x| ≤ slope (d + z), and so for y.
        needed = (seen[:, :2].abs() / slopes).amax(dim=1) - seen[:, 2]
        distance = max(distance, float(needed.max()))
    matrix[:2, :2] *= zoom
    return [_camera(center - distance * forward, right, forward, matrix, width, height) for right, forward in axes]


def _orbit_axes(azimuth: float, elevation: float, up: str) -> tuple[Tensor, Tensor]:
    """Right and forward of a camera that looks at the middle of its orbit, also at the poles."""
    if up not in UP_AXES:
        raise ValueError(f"up={up!r}: expected 'y' or 'z'")
    if not -90 <= elevation <= 90:
        raise ValueError(f"elevation={elevation}: expected degrees from -90 to 90")
    if not math.isfinite(azimuth):
        raise ValueError(f"azimuth={azimuth}: expected degrees")
    a, e = math.radians(azimuth), math.radians(elevation)
    side, front, high = math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)
    if up == "y":
        right, forward = (math.cos(a), 0.0, -math.sin(a)), (-side, -high, -front)
    else:
        right, forward = (math.cos(a), math.sin(a), 0.0), (-side, front, -high)
    return torch.tensor(right, dtype=torch.float64), torch.tensor(forward, dtype=torch.float64)


def _camera(eye: Tensor, right: Tensor, forward: Tensor, matrix: Tensor, width: int, height: int) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack((right, torch.linalg.cross(forward, right), forward, eye), dim=1)
    return Camera(matrix, pose, width, height)


def _vector(name: str, numbers: Sequence[float] | Tensor) -> Tensor:
    vector = torch.as_tensor(numbers, dtype=torch.float64, device="cpu")
    if tuple(vector.shape) != (3,) or not bool(vector.isfinite().all()):
        raise ValueError(f"{name}={numbers}: expected three finite numbers")
    return vector
