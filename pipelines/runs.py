"""Run directories: which file an argument ``RUN|FILE`` means, and where a new run may be written."""

from __future__ import annotations

from pathlib import Path

import torch

from ..neural_fields import InputError, SavedField, load_field
from ..neural_fields.dynamic_tracing import moment
from .fit_state import FIELD_FILE, RECORD_FILE, STATE_FILE

__all__ = ["check_new_run", "find_field", "forget_run", "is_field", "load_still"]


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
    from .texture import TEXTURE_FILE
    from .texture_state import texture_state_file

    texture = directory / TEXTURE_FILE
    for path in (directory / STATE_FILE, texture, texture_state_file(texture), *(directory / name for name in also)):
        path.unlink(missing_ok=True)
