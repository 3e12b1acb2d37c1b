"""Run directories: which file an argument ``RUN|FILE`` means, and where a new run may be written.

What a fit leaves in its run directory, and how an interrupted one finds its way back.

What an interrupted training of a texture leaves beside the texture, so that it can go on.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ...datasets import OrientedCloud, PointCloud
from ...neural_fields import Field, InputError, SavedField, load_field
from ...neural_fields.dynamic_tracing import moment
from ...neural_fields.files import write_json, write_whole
from .config import load_config
from .settings import TextureConfig

__all__ = [
    "CLOUD_FILE",
    "FIELD_FILE",
    "RECORD_FILE",
    "STATE_FILE",
    "TEXTURE_FILE",
    "TextureState",
    "check_new_run",
    "digest_of",
    "find_field",
    "fingerprint",
    "forget_run",
    "is_field",
    "is_fitted",
    "kept_cloud",
    "load_state",
    "load_still",
    "read_record",
    "save_state",
    "texture_state_file",
    "write_record",
]


def find_field(path: str | Path) -> Path:
    """The checkpoint that ``RUN|FILE`` names.

    Raises:
        InputError: there is nothing there, or it is neither a run directory with a field nor a .safetensors file.
    """
    path = Path(path)
    if path.is_dir():
        field = path / FIELD_FILE
        if field.is_file():
            return field
        if (path / RECORD_FILE).is_file():
            raise InputError(
                f"{path}: holds no {FIELD_FILE} yet; finish it with --resume of the command that began it "
                "(mplicits fit, evolve or reconstruct)"
            )
        raise InputError(f"{path}: not a run directory (no {FIELD_FILE}); make one with `mplicits fit CLOUD -o {path}`")
    if not path.exists():
        raise InputError(f"{path}: no such run directory or file")
    if path.suffix.lower() != ".safetensors":
        raise InputError(f"{path}: expected a run directory or a .safetensors file")
    return path


def is_field(path: str | Path) -> bool:
    """Whether ``path`` is meant as a run or a checkpoint rather than as a mesh or a cloud."""
    return Path(path).is_dir() or Path(path).suffix.lower() == ".safetensors"


def load_still(path: str | Path, time: float | None = None, *, device: torch.device | str = "cpu") -> SavedField:
    """The field of a run as it is, or that of one moment if it moves.

    Args:
        path: run directory or .safetensors file.
        time: the moment, in [0, 1]; None for a field that does not move.
        device: where to put it.

    Raises:
        InputError: there is no such run; it moves and no time is given, or the other way round; or the time is not
            from 0 to 1.
    """
    file = find_field(path)
    saved = load_field(file, device=device)
    if time is None:
        if saved.field.in_dim != 3:
            raise InputError(f"{file}: a surface that moves; say when with --time T, from 0 to 1")
        return saved
    if saved.field.in_dim == 3:
        raise InputError(f"--time {time:g}: {file} does not move; leave it out")
    if not 0 <= time <= 1:
        raise InputError(f"--time {time:g}: expected a time from 0 to 1")
    return saved._replace(field=moment(saved.field, time))


def check_new_run(path: str | Path, *, resume: bool, force: bool) -> Path:
    """The directory of a run to be written, if nothing there would be lost.

    Raises:
        InputError: it cannot be made, holds something already, or with ``resume`` holds nothing to resume.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a directory for the run")
    parent = path.absolute().parent
    if not path.exists() and not parent.is_dir():
        raise InputError(f"{path}: the folder {parent} does not exist; make it first")
    if resume:
        if not (path / STATE_FILE).is_file():
            finished = (path / FIELD_FILE).is_file()
            reason = "is finished" if finished else "holds no interrupted run"
            raise InputError(f"{path}: {reason}, so there is nothing to resume; leave out --resume")
        return path
    if path.is_dir() and not force and any(path.iterdir()):
        hint = " --resume continues it," if (path / STATE_FILE).is_file() else ""
        raise InputError(f"{path}: exists and is not empty;{hint} --force overwrites it, or choose another -o")
    return path


def forget_run(directory: Path, *also: str) -> None:
    """Remove what of an earlier run must not be resumed into a new one in its place, nor colour it.

    Args:
        directory: of the run, once the new data are known to be good.
        also: names of other files that only this kind of run has.
    """
    texture = directory / TEXTURE_FILE
    for path in (directory / STATE_FILE, texture, texture_state_file(texture), *(directory / name for name in also)):
        path.unlink(missing_ok=True)


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


def texture_state_file(texture: Path) -> Path:
    """Where the training of the texture that will be written to ``texture`` is kept."""
    return texture.with_suffix(".resume.safetensors")


@dataclass(frozen=True)
class TextureState:
    """A training under way.

    Attributes:
        config: its settings.
        level: of the geometry; None is the finest.
        fingerprint: of what it learns from; see `fingerprint_of`.
        tensors: network, optimiser and random numbers; see `pack_training`.
    """

    config: TextureConfig
    level: int | None
    fingerprint: str
    tensors: Mapping[str, Tensor]

    @staticmethod
    def fingerprint_of(cloud: PointCloud, geometry: Field) -> str:
        """A digest of points, colours and field, to tell whether a resumed training sees the same."""
        assert cloud.colors is not None
        weights = (tensor.detach().cpu().numpy() for _, tensor in sorted(geometry.state_dict().items()))
        return digest_of((cloud.points, cloud.colors, *weights))

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        about: dict[str, Any] = {"config": dataclasses.asdict(self.config), "level": self.level}
        save_state(path.parent, self.tensors, about | {"fingerprint": self.fingerprint}, name=path.name)

    @staticmethod
    def load(path: Path) -> TextureState:
        """Read what `save` wrote.

        Raises:
            InputError: there is no such file, or it is damaged.
        """
        tensors, about = load_state(path.parent, name=path.name)
        try:
            config = load_config(TextureConfig, None, about["config"])
            return TextureState(config, about["level"], about["fingerprint"], tensors)
        except KeyError as error:
            raise InputError(f"{path}: damaged (no {error}); begin again without --resume") from error


TEXTURE_FILE = "texture.safetensors"


CLOUD_FILE = "cloud.ply"


def kept_cloud(run: Path) -> Path:
    """The file of the cloud that was made of the depth maps of a run.

    Raises:
        InputError: the run was not fitted to depth maps.
    """
    kept = run / CLOUD_FILE
    if not kept.is_file():
        raise InputError(f"{run}: holds no {CLOUD_FILE}, so it was not fitted to depth maps; name its own cloud")
    return kept


def is_fitted(run: Path) -> bool:
    """Whether the fit in a directory was trained to its end."""
    return (run / FIELD_FILE).is_file() and not (run / STATE_FILE).is_file() and bool(read_record(run)["finished"])
