"""The fits and textures of ``mplicits bench texture``: kept in a folder, and used again if they are the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets import TexturedMesh, sample_textured
from ..neural_fields import Field, InputError, Similarity, TextureField, load_field, load_texture
from ..neural_fields.files import write_json
from .fit.train import fit
from .run.folder import FIELD_FILE, RECORD_FILE, STATE_FILE, TEXTURE_FILE, read_record
from .run.machine import choose_device
from .run.settings import FitConfig, TextureConfig
from .run.trainer import Progress
from .texture.train import texture_run

__all__ = ["Fitted", "Report", "check_kept", "fitted_texture"]

FIT_POINTS = 100_000
MESH_FILE = "mesh.json"

Report = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Fitted:
    """A surface and its texture.

    Attributes:
        field: the surface, on the device of the texture's settings.
        similarity: from input to its coordinates.
        texture: around it.
        record: what ``run.json`` says of both.
    """

    field: Field
    similarity: Similarity
    texture: TextureField
    record: dict[str, Any]

    @property
    def name(self) -> str:
        """The widths and depths of its levels, as the paper writes them."""
        sizes = zip(self.record["config"]["widths"], self.record["config"]["depths"], strict=True)
        return "▷".join(f"({width},{depth})" for width, depth in sizes)


def check_kept(home: Path, mesh: TexturedMesh, fits: Mapping[str, FitConfig | None], texture: TextureConfig) -> None:
    """Check that what is kept in a folder was made from this mesh and with these settings; make the folder if new.

    Args:
        home: the folder of the mesh.
        mesh: with an image.
        fits: settings by the names of the runs in that folder; None: it is not asked for.
        texture: settings of their textures.

    Raises:
        InputError: something there is of another mesh or has other settings.
    """
    digest = hashlib.sha256()
    for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.image):
        digest.update(np.ascontiguousarray(array).tobytes())
    file = home / MESH_FILE
    if file.is_file() and file.read_text(encoding="utf-8") != json.dumps(digest.hexdigest(), indent=2) + "\n":
        raise InputError(f"{home}: holds the fits of another mesh than {mesh.source}; choose another -o, or remove it")
    for name, config in fits.items():
        run = home / name
        if config is None or not (run / RECORD_FILE).is_file():
            continue
        record = read_record(run)
        _check_settings(run, record["config"], config)
        if "texture" in record:
            _check_settings(run / TEXTURE_FILE, record["texture"]["config"], texture)
    home.mkdir(exist_ok=True)
    write_json(file, digest.hexdigest())


def _check_settings(where: Path, kept: Mapping[str, Any], wanted: FitConfig | TextureConfig) -> None:
    given = json.loads(json.dumps(asdict(wanted)))  # lists, as the file has them
    for name in given:
        if name != "device" and kept.get(name) != given[name]:
            raise InputError(
                f"{where}: was made with {name} {kept.get(name)}, not {given[name]}; choose another -o, or remove it"
            )


def fitted_texture(
    path: Path, mesh: TexturedMesh, run: Path, config: FitConfig, texture: TextureConfig, progress: Report | None
) -> Fitted:
    """The surface and its texture; whatever is not in the folder ``run`` yet is trained.

    Args:
        path: of the mesh.
        mesh: what it holds.
        run: run directory of the fit and its texture; its name is that of the fit.
        config: settings of the fit.
        texture: settings of the texture.
        progress: called with a name and the progress of a training.

    Raises:
        Interrupted: the fit was asked to stop; the next call resumes it.
        KeyboardInterrupt: the texture was asked to stop; the next call trains it anew.
    """

    def told(step: Progress) -> None:
        if progress is not None:
            progress(f"{path.stem} {run.name}", step)

    resume = (run / STATE_FILE).is_file()
    if resume or not (run / FIELD_FILE).is_file():
        fit(sample_textured(mesh, FIT_POINTS, seed=config.seed), config, out=run, resume=resume, progress=told)
    trained = (run / TEXTURE_FILE).is_file() and read_record(run).get("texture", {}).get("finished", False)
    if not trained and not texture_run(run, path, texture, progress=told).record["finished"]:
        raise KeyboardInterrupt
    field, similarity, _ = load_field(run / FIELD_FILE, device=choose_device(texture.device))
    return Fitted(field, similarity, load_texture(run / TEXTURE_FILE, field), read_record(run))
