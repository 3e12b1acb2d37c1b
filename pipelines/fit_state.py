"""What a fit leaves in its run directory, and how an interrupted one finds its way back."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..datasets import OrientedCloud
from ..neural_fields import InputError
from ..neural_fields.files import write_json, write_whole

__all__ = [
    "FIELD_FILE",
    "RECORD_FILE",
    "STATE_FILE",
    "digest_of",
    "environment",
    "fingerprint",
    "load_state",
    "read_record",
    "save_state",
    "write_record",
]

FIELD_FILE = "field.safetensors"
RECORD_FILE = "run.json"
STATE_FILE = "resume.safetensors"


def fingerprint(cloud: OrientedCloud) -> str:
    """A digest of points and normals, to tell whether a resumed run sees the same cloud."""
    return digest_of((cloud.points, cloud.normals))


def digest_of(arrays: Iterable[NDArray[Any]]) -> str:
    """SHA-256 of what is in the arrays, one after the other."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def environment(device: torch.device) -> dict[str, Any]:
    """What the figures of a run depend on: versions, threads, machine."""
    names = ("mplicits", "torch", "numpy", "scipy", "scikit-image", "safetensors")
    return {
        "versions": {name: importlib.metadata.version(name) for name in names},
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cpu_count": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
    }


def write_record(directory: Path, record: Mapping[str, Any]) -> None:
    """Write ``run.json``, whole or not at all."""
    write_json(directory / RECORD_FILE, record)


def read_record(directory: Path) -> dict[str, Any]:
    """Read ``run.json``.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = directory / RECORD_FILE
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(record["config"], dict):
            raise TypeError("config is not a mapping")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a run of mplicits fit, evolve or reconstruct") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged ({error}); fit again into a new directory") from error
    return record


def save_state(
    directory: Path, tensors: Mapping[str, Tensor], progress: Mapping[str, Any], *, name: str = STATE_FILE
) -> None:
    """Write the resume file, whole or not at all; ``progress`` is JSON."""
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    write_whole(directory / name, save(plain, metadata={"progress": json.dumps(dict(progress))}))


def load_state(directory: Path, *, name: str = STATE_FILE) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_state` wrote.

    Raises:
        InputError: there is no resume file, or it is damaged.
    """
    path = directory / name
    if not path.is_file():
        raise InputError(f"{path}: no such file, so there is nothing to resume; leave out --resume and choose a new -o")
    try:
        with safe_open(path, framework="pt") as file:
            progress = json.loads(file.metadata()["progress"])
            return {name: file.get_tensor(name) for name in file.keys()}, progress  # noqa: SIM118
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged ({error}); begin again without --resume") from error
