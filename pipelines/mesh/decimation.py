"""Fewer triangles, and how far they are from those before."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError, Mesh
from ..surface.distance import MeshDistance
from ..surface.surface import is_closed
from .atlas import decimate

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Decimation:
    """What a decimation has cost; ``largest`` and ``mean`` distance are in the units of the mesh, both ways.

    Distances from each mesh to the other are exact, at the vertices of the full mesh and at the vertices, edge
    midpoints and face centres of the other, evenly thinned to 50,000 points each way.
    """

    faces_before: int
    faces: int
    largest: float
    mean: float
    closed_before: bool
    closed: bool

    def times(self, scale: float) -> Decimation:
        """The same in other units, of which one of these is ``scale``."""
        return dataclasses.replace(self, largest=self.largest * scale, mean=self.mean * scale)

    def describe(self, unit: str) -> str:
        """One line, for people."""
        line = f"{self.faces_before:,} → {self.faces:,} faces, at most {self.largest:.3g} {unit} from the full mesh"
        line += f" (mean {self.mean:.2g})"
        if self.closed_before:
            return f"{line}; {'still watertight' if self.closed else 'NO LONGER WATERTIGHT: keep more faces'}"
        return f"{line}; not watertight, as before"


class Decimated(NamedTuple):
    """A mesh with fewer triangles, without normals and colours, and what that has cost."""

    mesh: Mesh
    cost: Decimation


def check_decimation_tool() -> None:
    """Raise an InputError before any long work if the extra ``mplicits[texture]`` is not installed."""
    try:
        import fast_simplification  # noqa: F401
    except ImportError as error:
        raise InputError(f"--faces needs {error.name}; pip install 'mplicits[texture]'") from error


def decimated(mesh: Mesh, faces: int) -> Decimated:
    """Collapse edges until about ``faces`` triangles are left, and measure how far that has led."""
    full = Mesh(mesh.vertices, mesh.faces.astype(np.int64))
    closed = is_closed(full)
    if len(mesh.faces) <= faces:
        bare = dataclasses.replace(mesh, normals=None, colors=None)
        return Decimated(bare, Decimation(len(mesh.faces), len(mesh.faces), 0.0, 0.0, closed, closed))
    vertices, corners = decimate(mesh.vertices, mesh.faces, faces)
    left = Mesh(vertices, corners)
    largest, mean = deviation(full, left)
    cost = Decimation(len(mesh.faces), len(corners), largest, mean, closed, is_closed(left))
    return Decimated(Mesh(vertices, corners.astype(np.int32)), cost)


def deviation(full: Mesh, left: Mesh) -> tuple[float, float]:
    """Largest and mean distance between two meshes, both ways; where it is measured says `Decimation`."""
    there = np.abs(MeshDistance(left).signed(_thinned(full.used_vertices())))
    back = np.abs(MeshDistance(full).signed(_thinned(_probes(left))))
    return float(max(there.max(), back.max())), float(there.mean() + back.mean()) / 2


def _probes(surface: Mesh) -> Float64:
    """Vertices, edge midpoints and face centres."""
    corners = surface.vertices[surface.faces]  # (F, 3, 3)
    ends = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = np.unique(np.sort(ends, axis=1), axis=0)
    return np.concatenate((surface.used_vertices(), surface.vertices[edges].mean(axis=1), corners.mean(axis=1)))


def _thinned(points: Float64) -> Float64:
    # More points would take seconds and change little.
    return points[:: -(-len(points) // 50_000)]
