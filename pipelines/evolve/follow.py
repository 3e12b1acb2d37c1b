"""One mesh that follows a surface through time: its vertices move, its triangles stay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, InputError, flow, project_to_surface
from ...neural_fields.meshing.extract import extract_mesh, surface_needed, surface_of
from ...neural_fields.spacetime.dynamic_tracing import moment
from ...neural_fields.spacetime.flow import IntegrationError, Solver
from ...neural_fields.spacetime.surface_velocity import CarriedVelocity
from .topology import topology_of

# Cells on a side that pieces and holes of a surface are counted on; those that slip through do not count.
TOPOLOGY_RESOLUTION = 64
# A fixed step: near a change of topology adaptive ones would shrink to nothing before we can say when that was.
FOLLOW = Solver(method="rk4", step=0.02)


@dataclass(frozen=True, eq=False)
class TrackedMesh:
    """A mesh, and where its vertices are at T times."""

    faces: NDArray[np.integer]  # (F, 3), the same at all times
    vertices: NDArray[np.float32]  # (T, V, 3)
    normals: NDArray[np.float32]  # (T, V, 3), of unit length


@torch.no_grad()
def follow_mesh(
    field: Field,
    times: Sequence[float],
    *,
    resolution: int = 96,
    level: int = -1,
    name: str = "the run",
    progress: Callable[[int, int], None] | None = None,
) -> TrackedMesh:
    """Mesh a surface at the first of ``times`` and follow its vertices (see `CarriedVelocity`) to the others.

    The surface must not tear, join or close a hole. At every time the pieces and the Euler number of the slice are
    compared with those of the start. The vertices must still lie on the surface, and the mesh must not fold over.
    ``resolution`` is in cells along the cube.

    Raises:
        InputError: there is no surface at the start, or it cannot be followed; says to which time.
    """
    start = moment(field, times[0])
    with surface_needed(f"{name}: no surface at time {times[0]:.3g}"):
        mesh = extract_mesh(start, resolution=resolution, level=level)
    shape = topology_of(surface_of(start, resolution=TOPOLOGY_RESOLUTION, level=level))
    # The mesher's vertices are on the edges of its lattice, and as near to the surface as one step along them brings.
    points = project_to_surface(start, torch.from_numpy(mesh.vertices).to(field.like), level=level)[0]
    cell = 2.0 / resolution
    faces = torch.from_numpy(mesh.faces).long().to(points.device)
    velocity = CarriedVelocity(field, level=level)
    path, normals = [points], [_normals(start, points, level)]
    for index in range(1, len(times)):
        before, time = times[index - 1], times[index]
        still = moment(field, time)
        if (now := topology_of(surface_of(still, resolution=TOPOLOGY_RESOLUTION, level=level))) != shape:
            raise _lost(name, time, f"it has {now}, after {shape}")
        try:
            moved = flow(velocity, path[-1], before, time, solver=FOLLOW)
        except IntegrationError as error:
            raise _lost(name, time, str(error)) from error
        points, arrived = project_to_surface(still, moved, level=level)
        away = float((points - moved).norm(dim=-1).max())
        # Vertices further from the surface than this, in cells of the mesh, have lost it.
        if not away <= 0.5 * cell or not bool(arrived.all()):
            raise _lost(name, time, f"a vertex is {away:.2g} from it")
        path.append(points)
        normals.append(_normals(still, path[-1], level))
        # Triangles that look inward: more of them than this, as a share of the area, and the mesh is folded.
        if (share := _folded(path[-1], normals[-1], faces)) > 0.02:
            raise _lost(name, time, f"{share:.0%} of the mesh has folded over")
        if progress is not None:
            progress(index, len(times) - 1)
    vertices, directions = (torch.stack(rows).float().cpu().numpy() for rows in (path, normals))
    return TrackedMesh(mesh.faces, vertices, directions)


def _lost(name: str, time: float, reason: str) -> InputError:
    return InputError(
        f"{name}: its mesh cannot be followed to time {time:.3g} ({reason}); write a folder of meshes, -o FOLDER"
    )


def _normals(field: Field, points: Tensor, level: int) -> Tensor:
    return torch.nn.functional.normalize(field.jet(points, level=level).gradient, dim=-1)


def _folded(points: Tensor, normals: Tensor, faces: Tensor) -> float:
    """Share of the area whose triangles look against the normals of the field."""
    a, b, c = points[faces].unbind(dim=1)
    facing = torch.linalg.cross(b - a, c - a)
    area = facing.norm(dim=-1)
    against = (facing * normals[faces].sum(dim=1)).sum(dim=-1) < 0
    return float(area[against].sum() / area.sum().clamp(min=1e-30))
