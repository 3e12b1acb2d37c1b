"""What images should show: traces run to convergence, and an exact raycast of a fine mesh of the same surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from mplicits.datasets.cameras import Camera
from mplicits.neural_fields import Field, InputError, Mesh, sphere_trace
from mplicits.neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from mplicits.neural_fields.tracing.cones import cone_starts
from mplicits.pipelines.render.rasterise import mesh_view
from mplicits.pipelines.render.shade import shade
from mplicits.pipelines.render.trace import Seen
from numpy.typing import NDArray
from torch import Tensor

OUTLINE_RESOLUTION = 64
# A mesh and a trace that disagree about a pixel are settled by this search of the field itself along the ray.
WINDOW, SPACING = 0.01, 1e-4
# A hit further behind the mesh than this has passed through a surface.
PASSED = 0.02
# Neighbouring pixels whose depths differ by more are on two sides of a silhouette.
SILHOUETTE_JUMP = 0.05


@dataclass(frozen=True)
class Agreement:
    """How images agree with what they should show, over all cameras.

    Attributes:
        image_error: root mean square difference of the headlight images (display values in [0, 1]) from that of the
            converged trace of the level that gives the normals, over the pixels in which one of them sees something.
        depth_error: 99.9 % quantile of the difference in depth from the converged trace of the level that is traced.
        mesh_depth_error: median difference in depth from the raycast of the mesh.
        holes: pixels that miss the surface, or see another one behind it, although the mesh and the field agree that it
            is there.
        false_hits: pixels that see a surface where neither the mesh nor the field has one.
        silhouette: pixels on silhouettes of the raycast.
    """

    image_error: float
    depth_error: float
    mesh_depth_error: float
    holes: int
    false_hits: int
    silhouette: int


class Truth:
    """Reference images of the levels of some fields, each made once.

    Args:
        fields: by name.
        resolution: cells along each side of the meshes.
        device: where they are.
        report: called with what is being made.
    """

    def __init__(
        self,
        fields: Mapping[str, Field],
        *,
        resolution: int = 512,
        device: torch.device | str = "cpu",
        report: Callable[[str], None],
    ) -> None:
        self._fields, self._resolution, self._device, self._report = fields, resolution, device, report
        self._meshes: dict[tuple[str, int], Mesh] = {}
        self._traces: dict[tuple[str, int, Camera], Seen] = {}
        self._casts: dict[tuple[str, int, Camera], NDArray[np.float32]] = {}

    def outline(self, name: str) -> NDArray[np.float64]:
        """Vertices of a coarse mesh of a field, for cameras to look at.

        Raises:
            InputError: the field has no surface.
        """
        return self._mesh(name, 0, OUTLINE_RESOLUTION).vertices

    def judge(
        self, name: str, level: int, normal_level: int, cameras: Sequence[Camera], images: Sequence[Seen]
    ) -> Agreement:
        """Compare images of ``level`` with normals of ``normal_level``, one per camera, with the truth."""
        squares, counted = 0.0, 0
        depths, mesh_depths = [], []
        holes = false = silhouette = 0
        for camera, image in zip(cameras, images, strict=True):
            shown = self._trace(name, normal_level, camera)
            difference = _headlight(image, camera) - _headlight(shown, camera)
            either = torch.zeros_like(difference[..., 0], dtype=torch.bool)
            either.view(-1)[torch.cat((image.pixel, shown.pixel))] = True
            squares, counted = squares + float(difference[either].square().sum()), counted + 3 * int(either.sum())
            depth, converged = _depths(image), _depths(self._trace(name, level, camera))
            depths.append((depth - converged).abs()[depth.isfinite() & converged.isfinite()])
            cast = torch.from_numpy(self._cast(name, level, camera)).to(depth)
            both = depth.isfinite() & cast.isfinite()
            mesh_depths.append((depth - cast).abs()[both])
            missed = cast.isfinite() & (depth > cast + PASSED)  # infinitely far where nothing was hit
            wrong = depth.isfinite() & ~cast.isfinite()
            holes += self._confirmed(name, level, camera, missed, cast)
            false += int(wrong.sum()) - self._confirmed(name, level, camera, wrong, depth)
            silhouette += int(_silhouette(cast).sum())
        every = torch.cat(depths)
        rank = max(1, round(0.999 * len(every)))
        return Agreement(
            image_error=(squares / max(counted, 1)) ** 0.5,
            depth_error=float(every.kthvalue(rank).values) if len(every) else float("nan"),
            mesh_depth_error=float(torch.cat(mesh_depths).median()) if len(every) else float("nan"),
            holes=holes,
            false_hits=false,
            silhouette=silhouette,
        )

    @torch.inference_mode()
    def _trace(self, name: str, level: int, camera: Camera) -> Seen:
        """The converged trace."""
        key = (name, level, camera)
        if key not in self._traces:
            self._report(f"converged trace of {name}, level {level}")
            field = self._fields[name]
            eye, directions = camera.rays(device=self._device)
            near = cone_starts(field, eye, directions, level=level)
            hits = sphere_trace(field, eye, directions, level=level, near=near, tolerance=1e-6, resolution=1e-5)
            pixel = hits.mask.flatten().nonzero()[:, 0]
            position = hits.position.reshape(-1, 3)[pixel]
            normal = torch.nn.functional.normalize(field.jet(position, level=level).gradient, dim=-1)
            depth, direction = hits.depth.flatten()[pixel], directions.reshape(-1, 3)[pixel]
            self._traces[key] = Seen((camera.width, camera.height), pixel, depth, position, normal, direction)
        return self._traces[key]

    def _mesh(self, name: str, level: int, resolution: int) -> Mesh:
        try:
            return extract_mesh(self._fields[name], resolution=resolution, level=level)
        except NoSurfaceError as error:
            raise InputError(f"{name}: the fit has no surface ({error}); fit it again with other settings") from error

    def _cast(self, name: str, level: int, camera: Camera) -> NDArray[np.float32]:
        """Depth ``(H, W)`` of a fine mesh in every pixel, infinite where there is none."""
        key = (name, level, camera)
        if key not in self._casts:
            mesh = (name, level)
            if mesh not in self._meshes:
                self._report(f"mesh of {name}, level {level}")
                self._meshes[mesh] = self._mesh(name, level, self._resolution)
            self._casts[key] = _depths(mesh_view(self._meshes[mesh], camera)).numpy()
        return self._casts[key]

    @torch.inference_mode()
    def _confirmed(self, name: str, level: int, camera: Camera, where: Tensor, depth: Tensor) -> int:
        """In how many of the pixels ``where`` the field changes sign on the ray near ``depth``."""
        if not bool(where.any()):
            return 0
        eye, directions = camera.rays(device=self._device)
        ladder = torch.arange(-WINDOW, WINDOW, SPACING, device=depth.device)
        confirmed = 0
        for d, t in zip(directions[where].split(64), depth[where].split(64), strict=True):
            points = eye + (t[:, None] + ladder)[..., None] * d[:, None]
            inside = self._fields[name].value(points, level=level) < 0
            confirmed += int((inside.any(dim=1) & ~inside.all(dim=1)).sum())
        return confirmed


def _headlight(seen: Seen, camera: Camera) -> Tensor:
    """``(H, W, 3)`` on white, as floating-point numbers."""
    rgb = shade(seen, "headlight", camera=camera)
    image = rgb.new_ones(camera.height * camera.width, 3)
    image[seen.pixel] = rgb
    return image.reshape(camera.height, camera.width, 3)


def _depths(seen: Seen) -> Tensor:
    """``(H, W)``, infinite where nothing is seen."""
    width, height = seen.size
    depth = seen.depth.new_full((height * width,), torch.inf)
    depth[seen.pixel] = seen.depth
    return depth.reshape(height, width)


def _silhouette(depth: Tensor) -> Tensor:
    """Pixels that see something, with a neighbour that sees nothing or something much nearer or further."""
    edge = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (0, 1):
        ahead, behind = depth.narrow(axis, 1, depth.shape[axis] - 1), depth.narrow(axis, 0, depth.shape[axis] - 1)
        # Where both see nothing inf − inf is NaN, which is no jump.
        jump = (ahead - behind).abs() > SILHOUETTE_JUMP
        edge.narrow(axis, 1, depth.shape[axis] - 1).logical_or_(jump)
        edge.narrow(axis, 0, depth.shape[axis] - 1).logical_or_(jump)
    return edge & depth.isfinite()
