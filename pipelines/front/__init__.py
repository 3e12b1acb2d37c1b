"""Neural implicit surfaces as nested multiscale residuals: what most scripts need, by one import.

    import mplicits

    run = mplicits.fit("scan.ply")  # or reconstruct, evolve, texture: each returns a `Run`
    run.mesh().export("scan_mesh.ply")
    shape = mplicits.load("runs/scan")
    shape.distance(points)  # in the scan's coordinates and units

Names are imported on first use, so that ``import mplicits`` loads neither torch nor numpy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from mplicits.neural_fields import (  # pyright: ignore[reportMissingImports]
        Difference,
        Field,
        FunctionField,
        InputError,
        Intersection,
        Jet,
        Mesh,
        MultiscaleSDF,
        NeuSGeometry,
        Offset,
        Shell,
        Similarity,
        Siren,
        Sphere,
        TextureField,
        Union,
        WorldField,
        extract_mesh,
        load_field,
        render_volume,
        save_field,
        sphere_trace,
    )
    from mplicits.pipelines.evolve import evolve  # pyright: ignore[reportMissingImports]
    from mplicits.pipelines.fit import fit  # pyright: ignore[reportMissingImports]
    from mplicits.pipelines.reconstruct import reconstruct  # pyright: ignore[reportMissingImports]
    from mplicits.pipelines.texture import texture_run as texture  # pyright: ignore[reportMissingImports]
    from mplicits.pipelines.training.result import Run  # pyright: ignore[reportMissingImports]
    from mplicits.pipelines.training.settings import (  # pyright: ignore[reportMissingImports]
        EvolveConfig,
        FitConfig,
        ReconstructConfig,
        TextureConfig,
    )
    from torch import device as Device  # noqa: N812

    __version__: str

# Where names come from; what else of ``__all__`` is not defined here is of `mplicits.neural_fields`.
_CONFIGS = ("EvolveConfig", "FitConfig", "ReconstructConfig", "TextureConfig")
HOMES = {
    "Run": "pipelines.training.result.Run",
    "evolve": "pipelines.evolve.evolve",
    "fit": "pipelines.fit.fit",
    "reconstruct": "pipelines.reconstruct.reconstruct",
    "texture": "pipelines.texture.texture_run",
    **{name: f"pipelines.training.settings.{name}" for name in _CONFIGS},
}
PACKAGES = ("configs", "datasets", "neural_fields", "pipelines")

__all__ = [  # noqa: RUF022
    "__version__",
    "load",
    "save",
    "Difference",
    "EvolveConfig",
    "Field",
    "FitConfig",
    "FunctionField",
    "InputError",
    "Intersection",
    "Jet",
    "Mesh",
    "MultiscaleSDF",
    "NeuSGeometry",
    "Offset",
    "ReconstructConfig",
    "Run",
    "Shell",
    "Similarity",
    "Siren",
    "Sphere",
    "TextureConfig",
    "TextureField",
    "Union",
    "WorldField",
    "evolve",
    "extract_mesh",
    "fit",
    "load_field",
    "reconstruct",
    "render_volume",
    "save_field",
    "sphere_trace",
    "texture",
]


def load(path: str | Path, *, time: float | None = None, device: Device | str = "cpu", **official: Any) -> WorldField:
    """The field of a run or file, in the coordinates of its input.

    Args:
        path: run directory of ``mplicits fit``, ``reconstruct`` or ``evolve``, or a .safetensors file; or a model of
            the paper's own code, a folder with ``coarse/best.pth`` or a .pth file.
        time: the moment, from 0 to 1, of a surface that moves; None for one that does not.
        device: where to put the field.
        official: options of `read_official`, for a model of the paper's code: ``cloud``, ``deltas``, ``w0``,
            ``negate``.

    Raises:
        InputError: there is no such run, it is damaged, or the time does not fit to it.
    """
    folder = importlib.import_module("mplicits.pipelines.training.folder")
    if official or folder.is_official(path):
        read = importlib.import_module("mplicits.pipelines.fit.official").read_official(path, **official)
        return importlib.import_module("mplicits.neural_fields").WorldField(read.field.to(device), read.similarity)
    saved = folder.load_still(path, time, device=device)
    return importlib.import_module("mplicits.neural_fields").WorldField(saved.field, saved.similarity)


def save(path: str | Path, shape: WorldField | Run | Field) -> None:
    """Write a field and where it belongs to a .safetensors file, whole or not at all; `load` reads it.

    Args:
        path: the file.
        shape: what `load` or a training returned, or a field, which is then taken to be in input coordinates.

    Raises:
        InputError: the file cannot be written.
        TypeError: a field of this type has no description on disk.
    """
    field, similarity = getattr(shape, "field", shape), getattr(shape, "similarity", None)
    importlib.import_module("mplicits.neural_fields").save_field(path, field, similarity=similarity)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("mplicits")
    if name in PACKAGES:
        return importlib.import_module(f"mplicits.{name}")
    if name in __all__:
        home, _, name = HOMES.get(name, f"neural_fields.{name}").rpartition(".")
        return getattr(importlib.import_module(f"mplicits.{home}"), name)
    raise AttributeError(f"module 'mplicits' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *PACKAGES})
