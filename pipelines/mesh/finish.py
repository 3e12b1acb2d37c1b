"""``mplicits fit --mesh``: after the fit, the texture of its own colours, and the mesh with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...datasets import read_cloud
from ...neural_fields import InputError, Similarity
from ...neural_fields.meshing.extract import Mesh
from ..fit.depth import DepthInput, trim_suggestion
from ..texture.train import FittedTexture, has_colors, texture_run
from ..training.folder import CLOUD_FILE, TEXTURE_FILE, kept_cloud, read_record, texture_state_file
from ..training.progress import Progress, reported
from ..training.settings import TextureConfig
from .extract import MeshOptions, mesh_run
from .files import check_mesh_path


@dataclass(frozen=True)
class FitMesh:
    """The mesh that a fit shall end with.

    Attributes:
        source: what holds the colours, a cloud or a mesh in the coordinates of the fit.
        colored: whether there are colours, and they are wanted.
        trim: whether what the fit closes behind a depth map is cut off.
        columns: of that cloud; see `read_cloud`.
    """

    out: Path
    run: Path
    source: Path
    colored: bool
    trim: bool
    columns: str | None = None

    def texture(self, *, refit: bool, progress: Callable[[Progress], None] | None = None) -> FittedTexture | None:
        """Train the texture with default settings; None if there are no colours, or it was trained before.

        ``refit``: the field is new; otherwise a texture that is there is kept, and an interrupted one continued.
        """
        texture = self.run / TEXTURE_FILE
        resume = not refit and texture_state_file(texture).is_file()
        if not self.colored or (not refit and not resume and texture.is_file()):
            return None
        fitted = read_record(self.run)["config"]
        config = dataclasses.replace(
            TextureConfig(), device=fitted["device"], seed=fitted["seed"], columns=self.columns
        )
        return texture_run(self.run, self.source, config, resume=resume, progress=progress)

    def extract(
        self, say: Callable[[str], None] | None = None, *, progress: Callable[[Progress], None] | None = None
    ) -> Mesh:
        """Extract and write the mesh, as `mesh_run` does by default, trimmed where it shall be."""
        trim = trim_suggestion(self.run) if self.trim else None
        options = MeshOptions(colors=self.colored, trim_distance=trim, cloud=self.source if self.trim else None)
        with reported(progress, "mesh"):
            return mesh_run(self.run, self.out, options, say=say)


def plan_mesh(
    out: Path, run: Path, source: Path | DepthInput, *, colors: bool, resume: bool, columns: str | None = None
) -> FitMesh:
    """Check, before the fit, all that its mesh will need; depth maps are not read again to ``resume``.

    Raises an InputError if ``out`` cannot be written or is the cloud itself, or the cloud's texture cannot be read.
    """
    depth = isinstance(source, DepthInput)
    cloud = run / CLOUD_FILE if depth else source
    check_mesh_path(out)
    if out.absolute().resolve() == cloud.absolute().resolve():
        raise InputError(f"--mesh {out}: is the cloud that is fitted; name another file")
    colors = colors and out.suffix.lower() != ".stl"  # which has none
    if depth and not resume:
        return FitMesh(out, run, cloud, colors and source.color is not None, trim=True)
    points = read_cloud(kept_cloud(run) if depth else cloud, columns=columns).points
    check_mesh_path(out, Similarity.to_unit_sphere(points[np.isfinite(points).all(axis=1)]))
    try:
        colored = colors and has_colors(cloud, columns)
    except InputError as error:
        raise InputError(f"{error} (or leave the colours out: --no-colors)") from error
    return FitMesh(out, run, cloud, colored, trim=depth, columns=columns)
