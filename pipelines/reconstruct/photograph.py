"""New photographs of a reconstruction: its colours by direction, through the volume renderer, from any camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...datasets.cameras import Camera
from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.devices import choose_device
from ...neural_fields.backend.files import damage
from ...neural_fields.checkpoint import load_radiance
from ...neural_fields.networks.grids import ValueGrid
from ...neural_fields.volume.render import Sampling
from ..render.draw import RenderOptions, render_run
from ..render.picture import Image
from ..training.folder import RADIANCE_FILE, find_field, load_still
from .model import SceneModel
from .views import render_camera


class TrainedScene(NamedTuple):
    """A reconstruction that can be rendered, in unit-sphere coordinates."""

    model: SceneModel
    similarity: Similarity  # the way back to world coordinates
    sampling: Sampling  # where its rays are sampled
    sdf_grid: ValueGrid | None  # places the samples; None for the coarsest level

    def paint(self, camera: Camera, level: int = -1) -> Image:
        """The image of a camera in unit-sphere coordinates, with the mean exposure of the photographs."""
        image = render_camera(self.model, camera, self.sampling, level=level, sdf_grid=self.sdf_grid)
        return (255 * image.color).round().astype(np.uint8)


def open_scene(run: str | Path, *, device: torch.device | str = "cpu") -> TrainedScene:
    """Load what `reconstruct` has left in a run directory, or beside the field in it.

    Raises:
        InputError: there is no such run, it is damaged, or it keeps no colours by direction.
    """
    file = find_field(run)
    geometry, similarity, _ = load_still(file, device=device)
    path = file.with_name(RADIANCE_FILE)
    if not path.is_file():
        raise InputError(
            f"{file.parent}: keeps no colours by direction (no {RADIANCE_FILE}); a finished `mplicits reconstruct` does"
        )
    radiance, metadata = load_radiance(path, geometry)
    with damage(path, "take it from a backup, or run `mplicits reconstruct` again"):
        about = {"uniform": 64, "importance": 64, "march_grid": 0} | dict(metadata.get("sampling", {}))
        sampling = Sampling(uniform=int(about["uniform"]), importance=int(about["importance"]))
        cells = int(about["march_grid"])
        if cells > 1024:
            raise ValueError(f"a grid of {cells}³ cells")
    sdf_grid = ValueGrid(cells, geometry.like.device) if cells else None
    if sdf_grid is not None:
        sdf_grid.refresh(geometry)
    return TrainedScene(SceneModel.of(geometry, radiance), similarity, sampling, sdf_grid)


def photograph(
    run: str | Path,
    out: str | Path,
    options: RenderOptions | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Render a finished reconstruction as its photographs show it → what was drawn, in a few words.

    Highlights move with the eye, and the background is the scene's. Arguments and errors are those of `render_run`, and
    errors of `open_scene`.
    """
    options = dataclasses.replace(options or RenderOptions(), shading=None)
    scene = open_scene(run, device=choose_device(options.device))
    return render_run(run, out, options, painter=scene.paint, progress=progress)
