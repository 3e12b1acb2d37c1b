"""A triangle mesh, and its way to other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..fields.similarity import Similarity
from .placement import Placement
from .writers import Triangles, write_triangles

__all__ = ["Mesh", "MeshStats"]


@dataclass(frozen=True)
class MeshStats:
    """What an extraction cost.

    Attributes:
        points: how many points were sent to each level (a level may answer a part of them by a coarser one).
        blocks: surviving blocks of 2³ cells.
        cells: cells that the surface crosses.
        seconds: wall time of each stage: "cull", "corners", "triangles", "normals".
    """

    points: tuple[int, ...]
    blocks: int
    cells: int
    seconds: dict[str, float]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: in the field's own coordinates from `extract_mesh`, in input coordinates from `WorldField.mesh`.

    Attributes:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int32, counter-clockwise as seen from outside (the positive side).
        normals: ``(V, 3)`` float32 unit vectors, outward; None where they were not asked for.
        colors: ``(V, 3)`` float32 in [0, 1], or None.
        stats: what it cost, for a mesh that `extract_mesh` made.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None
    stats: MeshStats | None = None

    def to_trimesh(self) -> Any:
        """The mesh as a ``trimesh.Trimesh``: the same vertices in the same order, in float64, with normals and colours.

        Colours have 8 bits there, and an alpha of 255.

        Example:
            >>> from mplicits.neural_fields import Sphere, extract_mesh
            >>> ball = extract_mesh(Sphere(radius=0.5), resolution=32).to_trimesh()
            >>> ball.is_watertight, round(float(ball.volume), 2)
            (True, 0.52)
        """
        import trimesh

        colors = None
        if self.colors is not None:
            colors = np.full((len(self.colors), 4), 255, np.uint8)
            colors[:, :3] = np.rint(np.clip(self.colors, 0, 1) * 255)
        # process=False: it would merge vertices and drop faces.
        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=colors, process=False
        )

    def export(self, path: str | Path, *, up: str | None = None, unit: str | None = None, center: bool = False) -> None:
        """Write the mesh as PLY, OBJ, STL or GLB, as ``mplicits mesh`` does; the extension chooses.

        Normals and colours go where the format has room for them. Coordinates are doubles in PLY and OBJ where floats
        would spoil them; a GLB keeps its offset from the origin in float64.

        Args:
            path: the file; it has its name only when it is complete.
            up: the axis that points up in the mesh, "y" or "z". A GLB is y-up, and z is turned up there; the others
                are turned (OBJ to y-up, PLY and STL to z-up) if it is given.
            unit: of the coordinates, "mm", "cm", "m", … (`Placement`). A GLB is in metres, by its node; the others
                are scaled (to millimetres in STL, else to metres) if it is given.
            center: whether the middle of the bounding box goes to the origin.

        Raises:
            InputError: the extension is unknown, the file cannot be written, or STL has too few digits for coordinates
                so far from the origin.
            ValueError: there is no such axis or unit, or the mesh has no faces.
        """
        if not len(self.faces):
            raise ValueError("the mesh has no faces, so there is nothing to write")
        placement = Placement(up, unit, center)
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        x, y, z = ((low + high) / 2).tolist()
        home = Similarity((x, y, z), float(np.linalg.norm(high - low)) / 2 or 1.0)
        write_triangles(path, Triangles(self.vertices, self.faces, self.normals, self.colors), home, placement)
