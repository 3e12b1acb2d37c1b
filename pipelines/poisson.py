"""Screened Poisson reconstruction (Kazhdan and Hoppe 2013) through pymeshlab: a peer for benchmarks, never needed."""

from __future__ import annotations

import importlib.util

import numpy as np

from ..datasets import OrientedCloud
from .surface import Surface

__all__ = ["has_poisson", "screened_poisson"]


def has_poisson() -> bool:
    """Whether the extra ``mplicits[poisson]`` is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def screened_poisson(cloud: OrientedCloud, *, depth: int = 10) -> Surface:
    """Reconstruct a cloud, with MeshLab's defaults except for the octree's depth (10 in the paper).

    Returns:
        The mesh, in unit-sphere coordinates.

    Raises:
        ModuleNotFoundError: the extra is not installed (see `has_poisson`).
    """
    import pymeshlab  # pyright: ignore[reportMissingImports]  an extra

    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]  its names come from a C++ module
    points, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    mesh = pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.add_mesh(mesh)
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth)
    mesh = meshes.current_mesh()
    return Surface(np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int64))
