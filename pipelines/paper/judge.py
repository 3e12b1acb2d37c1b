"""Judges surfaces: extracts them, writes and draws them, and measures them as the protocol says."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from ...datasets import orbit
from ...neural_fields import Field, Similarity, sphere_trace
from ...neural_fields.meshing import Mesh, NoSurfaceError, extract_mesh
from ..bench.cells import Cell, Workplace
from ..mesh.files import write_mesh
from ..render.rasterise import picture_of, write_picture
from ..surface.measure import evaluate_surfaces
from ..surface.surface import Surface, from_mesh, read_reference
from ..surface.trim import Support, drop_unsupported
from .protocol import protocol_of

__all__ = ["STEEP", "Judge", "reference_of"]

# Bound on |∇f| for extracting fields whose slope nobody keeps near 1: what is culled by it is safely empty.
STEEP = 2.0
# Steps on the coarsest level of an output and on each finer one (paper, Sec. 4).
FIRST_STEPS, MORE_STEPS = 20, 5


def reference_of(cell: Cell) -> Surface:
    """The surface that a cell's results are measured against.

    Raises:
        InputError: it cannot be read, or has no faces.
    """
    return read_reference(cell.reference or cell.shape, fix="give --reference MESH")


class Judge:
    """Measures the surfaces of one cell against its reference.

    Raises:
        InputError: see `reference_of`.
    """

    def __init__(self, cell: Cell, work: Workplace) -> None:
        self.work = work
        self.seed = cell.seed
        self.reference = reference_of(cell)
        self.protocol = protocol_of(cell.preset)

    def field(
        self,
        name: str,
        field: Field,
        similarity: Similarity,
        *,
        level: int = -1,
        parameters: int,
        train_seconds: float,
        lipschitz: float = STEEP,
        support: Support | None = None,
    ) -> dict[str, Any]:
        """Extract a level, time a picture of it, and measure the mesh.

        Args:
            name: of the output.
            field: in unit-sphere coordinates.
            similarity: the way back to input coordinates.
            level: whose zero set it is.
            parameters: trained numbers that it needs.
            train_seconds: until it was there.
            lipschitz: see `extract_mesh`.
            support: the points of a fit of ours; components that rest on none of them are dropped, and counted.
        """
        field = field.to(self.work.device)
        started = time.perf_counter()
        try:
            mesh = extract_mesh(field, resolution=self.protocol.resolution, level=level, lipschitz=lipschitz)
        except NoSurfaceError:
            mesh = None
        dropped = 0
        if mesh is not None and support is not None:
            mesh, dropped, _ = drop_unsupported(mesh, support.points, radius=support.radius)
        seconds = time.perf_counter() - started
        figures = self.mesh(
            name, mesh, similarity, parameters=parameters, train_seconds=train_seconds, mesh_seconds=seconds
        )
        rays = None if mesh is None else self._rays_per_second(field, level)
        return figures | {"dropped_components": dropped, "rays_per_second": rays}

    def mesh(
        self,
        name: str,
        mesh: Mesh | None,
        similarity: Similarity,
        *,
        parameters: int | None = None,
        train_seconds: float,
        mesh_seconds: float | None = None,
    ) -> dict[str, Any]:
        """Write, draw and measure a mesh in unit-sphere coordinates; None is a method that found no surface."""
        figures: dict[str, Any] = {
            "name": name,
            "parameters": parameters,
            "train_seconds": train_seconds,
            "mesh_seconds": mesh_seconds,
            "chamfer": None,
        }
        if mesh is None or not len(mesh.faces):
            return figures
        write_mesh(self.work.mesh(name), mesh, similarity)
        surface = from_mesh(replace(mesh, vertices=similarity.to_input(mesh.vertices)))
        tile = self.protocol.tile
        camera = orbit(self.reference.vertices, width=tile, height=tile)
        write_picture(self.work.picture(name), picture_of(surface, camera))
        metrics = evaluate_surfaces(
            surface,
            self.reference,
            samples=self.protocol.samples,
            seed=self.seed,
            columns=self.protocol.columns,
        )
        return figures | {key: value for key, value in asdict(metrics).items() if key not in ("samples", "seed")}

    @torch.inference_mode()
    def _rays_per_second(self, field: Field, level: int) -> float:
        """Of the paper's fixed-step sphere tracing, without normals, of an image that the unit sphere fills."""
        size = self.protocol.image
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        origin, directions = orbit(corners, width=size, height=size).rays(device=self.work.device)
        # Levels without bands are alternatives: only the one that is wanted is traced.
        level = field.resolve_level(level)
        traced = [index for index in range(level) if field.deltas[index].isfinite()] + [level]
        budget = [MORE_STEPS if index in traced else 0 for index in range(level + 1)]
        budget[traced[0]] = FIRST_STEPS
        started = time.perf_counter()
        hits = sphere_trace(field, origin, directions, level=level, budget=budget)
        hits.mask.any().item()  # a GPU works on after the call returns
        return size * size / (time.perf_counter() - started)
