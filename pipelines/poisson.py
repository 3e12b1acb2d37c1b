"""Screened Poisson reconstruction (Kazhdan and Hoppe 2013) through pymeshlab: a peer for benchmarks, never needed."""

from __future__ import annotations

import importlib.util

import numpy as np
import torch

from ..datasets import OrientedCloud
from .surface.surface import Surface

__all__ = ["has_poisson", "screened_poisson"]


def has_poisson() -> bool:
    """Whether the extra ``mplicits[poisson]`` is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def screened_poisson(cloud: OrientedCloud, *, depth: int = 10, trim: float = 0.0) -> Surface:
    """Reconstruct a cloud, with MeshLab's defaults except for the octree's depth (10 in the paper).

    Args:
        cloud: in unit-sphere coordinates.
        depth: of the octree.
        trim: vertices whose density is below this quantile are cut away with their faces, as the example code of
            Open3D does it (the paper's supplement, 1 %); 0 cuts nothing.

    Returns:
        The mesh, in unit-sphere coordinates.

    Raises:
        ModuleNotFoundError: the extra is not installed (see `has_poisson`).
        ValueError: ``trim`` is not in [0, 1).
    """
    if not 0 <= trim < 1:
        raise ValueError(f"trim={trim}: expected a fraction in [0, 1)")
    import pymeshlab  # pyright: ignore[reportMissingImports]  an extra

    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]  its names come from a C++ module
    points, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    mesh = pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.add_mesh(mesh)
    # Its threads wait for each other by spinning: more than there are cores for them, and they take ten times as long.
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=torch.get_num_threads())
    mesh = meshes.current_mesh()
    vertices = np.asarray(mesh.vertex_matrix(), np.float64)
    faces = np.asarray(mesh.face_matrix(), np.int64)
    if trim:
        density = np.asarray(mesh.vertex_scalar_array(), np.float64)
        kept = density >= np.quantile(density, trim)
        faces = faces[kept[faces].all(axis=1)]
    return Surface(vertices, faces)
