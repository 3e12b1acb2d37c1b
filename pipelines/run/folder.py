"""Run directories: what an argument ``RUN|FILE`` means, and what a training writes and finds again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from ...neural_fields import Field, InputError, SavedField, Similarity, load_field, save_field
from ...neural_fields.dynamic_tracing import moment
from ...neural_fields.files import check_place, damage, write_json, write_whole
from .config import load_config
from .lock import check_unlocked, lock_file, locked
from .team import is_leader

__all__ = [
    "CLOUD_FILE",
    "FIELD_FILE",
    "RECORD_FILE",
    "STATE_FILE",
    "TEXTURE_FILE",
    "RunFolder",
    "check_new_run",
    "chosen_level",
    "digest_of",
    "find_field",
    "fitted_cloud",
    "is_field",
    "is_fitted",
    "kept_cloud",
    "load_state",
    "load_still",
    "named_cloud",
    "read_record",
    "save_state",
    "texture_state_file",
    "write_record",
]

C = TypeVar("C")

FIELD_FILE = "field.safetensors"
RECORD_FILE = "run.json"
STATE_FILE = "resume.safetensors"
TEXTURE_FILE = "texture.safetensors"
CLOUD_FILE = "cloud.ply"  # what was made of depth maps
# What is in the record alone: too long for the head of a field's file.
LONG = ("checks", "held_out")


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


def chosen_level(field: Field, file: Path, level: int | None, *, otherwise: int = -1, flag: str = "--level") -> int:
    """A level of the field in ``file``, counted from 0, or ``otherwise``, by default the finest, where it is None.

    Raises:
        InputError: the field has no such level; the message names the ``flag``.
    """
    if level is None:
        return field.resolve_level(otherwise)
    if not 0 <= level < field.num_levels:
        raise InputError(f"{flag} {level}: {file} has levels 0 to {field.num_levels - 1}")
    return level


def is_fitted(run: Path) -> bool:
    """Whether the training in a directory went to its end."""
    return (run / FIELD_FILE).is_file() and not (run / STATE_FILE).is_file() and bool(read_record(run)["finished"])


def kept_cloud(run: Path) -> Path:
    """The file of the cloud that was made of the depth maps of a run.

    Raises:
        InputError: the run was not fitted to depth maps.
    """
    kept = run / CLOUD_FILE
    if not kept.is_file():
        raise InputError(f"{run}: holds no {CLOUD_FILE}, so it was not fitted to depth maps; name its own cloud")
    return kept


def named_cloud(source: str, run: Path | None) -> dict[str, str]:
    """Where a cloud is, for a record: so that `fitted_cloud` finds it from any folder.

    Args:
        source: its file; what else it may be called stays as it is.
        run: directory of the run, if there is one.

    Returns:
        ``cloud``, the absolute path, and ``cloud_from_run``, the path from the run's directory, which holds when both
        are moved together.
    """
    file = Path(source)
    if not file.is_file():
        return {"cloud": source}
    named = {"cloud": str(file.absolute())}
    if run is not None:
        with suppress(ValueError):  # Windows: they are on two drives
            named["cloud_from_run"] = os.path.relpath(file.resolve(), run.resolve())
    return named


def fitted_cloud(file: Path, metadata: Mapping[str, Any], *, remedy: str) -> Path:
    """The file of the cloud that a field was fitted to.

    Args:
        file: the field's checkpoint.
        metadata: what is in it.
        remedy: what to do where it is not found, for the message.

    Raises:
        InputError: it is in neither of the places that `named_cloud` noted.
    """
    record = metadata.get("run", {})
    source, from_run = record.get("cloud"), record.get("cloud_from_run")
    if not source:
        raise InputError(f"{file}: was not fitted to a cloud; {remedy}")
    places = [Path(source)] + ([] if from_run is None else [file.parent / from_run])
    for place in places:
        if place.is_file():
            return place
    raise InputError(f"{file}: its cloud {source} is not to be found; {remedy}")


def texture_state_file(texture: Path) -> Path:
    """Where the training of the texture that will be written to ``texture`` is kept."""
    return texture.with_suffix(".resume.safetensors")


def check_new_run(path: str | Path, *, resume: bool, force: bool) -> Path:
    """The directory of a run to be written, if nothing there would be lost.

    Raises:
        InputError: it cannot be made, is being written, holds something already, or with ``resume`` holds nothing to
            resume.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a directory for the run")
    check_place(path)
    check_unlocked(path)
    if resume:
        if not (path / STATE_FILE).is_file():
            finished = (path / FIELD_FILE).is_file()
            reason = "is finished" if finished else "holds no interrupted run"
            raise InputError(f"{path}: {reason}, so there is nothing to resume; leave out --resume")
        return path
    if path.is_dir() and not force and any(file != lock_file(path) for file in path.iterdir()):
        hint = " --resume continues it," if (path / STATE_FILE).is_file() else ""
        raise InputError(f"{path}: exists and is not empty;{hint} --force overwrites it, or choose another -o")
    return path


class RunFolder:
    """What a training writes: its record, a field that is usable at any time, and what it can be resumed from.

    Args:
        path: the directory; None keeps nothing.
        resume: whether the interrupted run there is continued.

    Attributes:
        out: where to write, ``path``; None where nothing is kept, or another process of a team writes.

    Raises:
        InputError: there is no directory to resume from.
    """

    def __init__(self, path: str | Path | None, *, resume: bool = False) -> None:
        if resume and path is None:
            raise InputError("resume: needs the run directory (out=...)")
        self.path, self.resume = None if path is None else Path(path), resume
        self.out = self.path if is_leader() else None

    def config(self, kind: type[C], given: C | None) -> C:
        """Settings of the run: its own if it is resumed, else those given, else the defaults.

        Raises:
            InputError: the record of the run is missing or damaged.
        """
        if self.resume and self.path is not None:
            return load_config(kind, None, read_record(self.path)["config"])
        return given or kind()

    @contextmanager
    def writing(self, *also: str) -> Iterator[None]:
        """Make the directory and be its only writer; unless it is resumed, forget the run that was there.

        What would be resumed into the new run or colour it is removed, and the files named ``also``.

        Raises:
            InputError: somebody else writes there.
        """
        if self.out is None:
            yield
            return
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out):
            if not self.resume:
                for name in (STATE_FILE, TEXTURE_FILE, texture_state_file(Path(TEXTURE_FILE)).name, *also):
                    (self.out / name).unlink(missing_ok=True)
            yield

    def begin(self, record: Mapping[str, Any]) -> None:
        """Write the record of a run that has not come to a field yet."""
        if self.out is not None:
            write_record(self.out, record)

    def save(
        self,
        field: Field,
        similarity: Similarity,
        record: Mapping[str, Any],
        tensors: Mapping[str, Tensor],
        progress: Mapping[str, Any],
    ) -> None:
        """Write a checkpoint: a usable field, and the ``tensors`` and ``progress`` (JSON) that `restore` returns."""
        if self.out is not None:
            self._save_field(self.out, field, similarity, record)
            save_state(self.out, tensors, progress)
            write_record(self.out, record)

    def finish(self, field: Field, similarity: Similarity, record: Mapping[str, Any]) -> None:
        """Write field and record of a finished run, of which nothing is left to resume."""
        if self.out is not None:
            self._save_field(self.out, field, similarity, record)
            write_record(self.out, record)
            (self.out / STATE_FILE).unlink(missing_ok=True)

    @staticmethod
    def _save_field(out: Path, field: Field, similarity: Similarity, record: Mapping[str, Any]) -> None:
        short = {name: value for name, value in record.items() if name not in LONG}
        save_field(out / FIELD_FILE, field, similarity=similarity, metadata={"run": short})

    def restore(self, fingerprint: str, mismatch: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The tensors and the progress that `save` was given last.

        Args:
            fingerprint: of what the run learns from; it is in the progress.
            mismatch: what to say if the run began with another.

        Raises:
            InputError: there is nothing to resume, it is damaged, or the fingerprint is another.
        """
        assert self.path is not None
        tensors, progress = load_state(self.path)
        if progress.get("fingerprint") != fingerprint:
            raise InputError(f"{mismatch}, or leave out --resume and choose a new -o")
        return tensors, progress


def digest_of(arrays: Iterable[NDArray[Any]]) -> str:
    """SHA-256 of what is in the arrays, one after the other: tells whether a resumed run sees the same data."""
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
    with damage(path, "fit again into a new directory"):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{path}: no such file; expected a run of mplicits fit, evolve or reconstruct") from None
        if not isinstance(record["config"], dict):
            raise TypeError("config is not a mapping")
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
    with damage(path, "begin again without --resume"), safe_open(path, framework="pt") as file:
        progress = json.loads(file.metadata()["progress"])
        return {name: file.get_tensor(name) for name in file.keys()}, progress  # noqa: SIM118
