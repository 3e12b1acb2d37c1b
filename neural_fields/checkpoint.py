"""Fields on disk: safetensors with a description in its header. No pickle, nothing executed on loading."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from .errors import InputError
from .field import Field
from .multiscale import MultiscaleSDF
from .similarity import Similarity
from .siren import Siren

__all__ = ["SavedField", "load_field", "save_field"]

FORMAT = "mplicits-field"
VERSION = 1


class SavedField(NamedTuple):
    """What a checkpoint holds.

    Attributes:
        field: the field, on the CPU (or the device asked for), in unit-sphere coordinates.
        similarity: the way back to the input's coordinates.
        metadata: whatever the writer added; JSON values.
    """

    field: Field
    similarity: Similarity
    metadata: dict[str, Any]


def save_field(
    path: str | os.PathLike[str],
    field: Field,
    *,
    similarity: Similarity | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write ``field`` to a safetensors file, whole or not at all (a temporary file beside it, then a rename).

    Args:
        path: where to write.
        field: a `Siren` or a `MultiscaleSDF` of them.
        similarity: the map from input to unit-sphere coordinates; the identity if there is none.
        metadata: JSON values to keep with the field.

    Raises:
        TypeError: a field of this type has no description on disk.
    """
    similarity = similarity or Similarity.identity()
    header = {
        "format": FORMAT,
        "version": VERSION,
        "field": _describe(field),
        "similarity": {"center": list(similarity.center), "scale": similarity.scale},
        "metadata": dict(metadata or {}),
    }
    path = Path(path)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in field.state_dict().items()}
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        # Bytes, not save_file: that makes files nobody else may read, whatever the umask.
        partial.write_bytes(save(tensors, metadata={FORMAT: json.dumps(header)}))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_field(path: str | os.PathLike[str], *, device: torch.device | str = "cpu") -> SavedField:
    """Read what `save_field` wrote.

    Raises:
        InputError: there is no such file, it is damaged, or it is not a field of this package.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a field written by `mplicits fit` (field.safetensors)")
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            header_text = (file.metadata() or {}).get(FORMAT)
            if header_text is None:
                raise InputError(f"{path}: a safetensors file, but not a field; expected one written by `mplicits fit`")
            header = json.loads(header_text)
            if header["version"] != VERSION:
                raise InputError(
                    f"{path}: field format version {header['version']}; this mplicits reads version {VERSION}, "
                    "so write it again with `mplicits fit` or install the version that wrote it"
                )
            field = _build(header["field"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for tensor in tensors.values():
            if tensor.is_floating_point():
                field = field.to(dtype=tensor.dtype)
        field.load_state_dict(tensors)
        for name, tensor in tensors.items():
            if not bool(torch.isfinite(tensor).all()):
                raise InputError(f"{path}: tensor {name!r} has NaN or infinite entries; fit the field again")
        center, scale = header["similarity"]["center"], header["similarity"]["scale"]
        similarity = Similarity((float(center[0]), float(center[1]), float(center[2])), float(scale))
        return SavedField(field.to(device).requires_grad_(False), similarity, header["metadata"])
    except InputError:
        raise
    except (SafetensorError, KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged, or not a field written by `mplicits fit` ({reason})") from error


def _describe(field: Field) -> dict[str, Any]:
    """What `_build` needs to construct an untrained copy."""
    if isinstance(field, Siren):
        return {
            "type": "Siren",
            "width": field.width,
            "depth": field.depth,
            "omega": field.omega,
            "in_dim": field.in_dim,
            "num_features": field.num_features,
        }
    if isinstance(field, MultiscaleSDF):
        levels = [field.base, *field.residuals]
        return {
            "type": "MultiscaleSDF",
            "taper": field.taper,
            "levels": [_describe(level) for level in levels],  # pyright: ignore[reportArgumentType]
        }
    raise TypeError(f"a {type(field).__name__} cannot be saved; expected a Siren or a MultiscaleSDF of Sirens")


def _build(description: Mapping[str, Any]) -> Field:
    arguments = {key: value for key, value in description.items() if key != "type"}
    if description["type"] == "Siren":
        return Siren(arguments.pop("width"), arguments.pop("depth"), **arguments)
    if description["type"] == "MultiscaleSDF":
        levels = [_build(level) for level in description["levels"]]
        # The band widths are among the tensors; the constructor only needs as many of them.
        return MultiscaleSDF(levels[0], levels[1:], [1.0] * (len(levels) - 1), taper=description["taper"])
    raise ValueError(f"unknown field type {description['type']!r}")
