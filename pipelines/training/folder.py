"""Run directories: what an argument ``RUN|FILE`` means, and what a training writes and finds again.

All files of a directory belong to one run, whose *generation*, a random name, is in each of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save as save_arrays
from safetensors.torch import save
from torch import Tensor

from ...datasets.clouds.readers.las import coordinate_system
from ...neural_fields import Field, InputError, Similarity, load_field
from ...neural_fields.backend import files as disk
from ...neural_fields.backend.files import check_place, damage, json_bytes, write_whole
from ...neural_fields.checkpoint import SavedField, checksum_of, field_bytes
from ...neural_fields.spacetime.dynamic_tracing import moment
from ...neural_fields.spacetime.velocity import VelocitySiren
from .settings import command_line, load_config

C = TypeVar("C")

FIELD_FILE = "field.safetensors"
RECORD_FILE = "run.json"
STATE_FILE = "resume.safetensors"
TEXTURE_FILE = "texture.safetensors"
RADIANCE_FILE = "radiance.safetensors"
SUPPORT_FILE = "support.safetensors"
VELOCITY_FILE = "velocity.safetensors"
CLOUD_FILE = "cloud.ply"  # what was made of depth maps
MERGED_FILE = "merged_cloud.npz"  # of a large cloud, made again where it is missing
STAGES = ("coarse", "medium", "fine")  # folders of a model of the paper's code: its levels
WEIGHTS_FILE = "best.pth"  # in each of them
JOURNAL = ".journal"
PARTIAL = re.compile(r"\..*\.(\d+)\.partial(\.[^.]*)?")  # of `whole_file`
# What a resumed run may do otherwise than it began; all else would make another run of it.
MAY_CHANGE = ("device", "time_budget")
# What is in the record alone: too long for the head of a field's file.
LONG = ("checks", "held_out")


# One writer at a time.


def lock_file(target: Path) -> Path:
    """The lock of a run directory, which lies in it, or of a file, beside it.

    It stays, empty: removing it would let two processes hold locks of two files of one name.
    """
    return target / "run.lock" if target.is_dir() else target.with_suffix(".lock")


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Be the only writer of a run directory, or of a file, until the block or the process ends.

    Raises:
        InputError: another process writes there, or the lock cannot be made.
    """
    file = lock_file(target)
    if not file.parent.is_dir():
        raise InputError(f"{file}: cannot be written (no such folder); choose another place")
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"{target}: is being written by another process; wait until it ends, or choose another -o"
        ) from error
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror or error}); choose another place") from error
    try:
        yield
    finally:
        lock.release()


def check_unlocked(target: Path) -> None:
    """Refuse a run directory, or a file, that another process writes; see `locked`."""
    if lock_file(target).is_file():
        with locked(target):
            pass


# Several files replaced at once: their new contents are written into one file, the journal, and its renaming is the
# moment of the change. The files are then written from it. After a kill the next reader or writer repeats that.


def replace_files(folder: Path, contents: Mapping[str, bytes], remove: Iterable[str] = ()) -> None:
    """Write files of a folder, by name, and remove others, which may be absent: after a kill all are old, or all new.

    The caller holds the folder's lock.

    Raises:
        InputError: the folder cannot be written. It is then unchanged, or the next `recover` ends the change.
    """
    packed = {name: np.asarray(bytearray(content)) for name, content in contents.items()}
    gone = sorted({*remove} - {*contents})
    disk.write_whole(folder / JOURNAL, save_arrays(packed, {"remove": json.dumps(gone)}))
    _carry_out(folder, contents, gone)


def recover(folder: Path) -> None:
    """End a change that a kill has interrupted. The caller holds the folder's lock.

    Raises:
        InputError: the journal is damaged, or the folder cannot be written.
    """
    journal = folder / JOURNAL
    if not journal.is_file():
        return
    with damage(journal, "remove it"):
        with safe_open(journal, framework="np") as file:
            gone = json.loads(file.metadata()["remove"])
            contents = {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
        if any(Path(name).name != name for name in [*contents, *gone]):
            raise ValueError("names a file outside of its folder")
    _carry_out(folder, contents, gone)


def _carry_out(folder: Path, contents: Mapping[str, bytes], gone: Iterable[str]) -> None:
    """Do what the journal says, and remove it."""
    try:
        disk.sync(folder)  # the journal lasts before anything else changes
        for name, content in contents.items():
            disk.write_whole(folder / name, content)
        for name in gone:
            disk.remove(folder / name)
        disk.sync(folder)
        disk.remove(folder / JOURNAL)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{folder}: cannot be written ({reason}); make room, or choose another -o") from error


def recovered(folder: Path) -> None:
    """Wait up to ten seconds for a change that is under way, and end one that was interrupted; see `recover`."""
    until = time.monotonic() + 10
    while (folder / JOURNAL).is_file():
        try:
            with locked(folder):
                recover(folder)
        except InputError:  # the writer does it
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


def prune(folder: Path) -> None:
    """`recover`, and remove partial files of killed processes. The caller holds the folder's lock."""
    recover(folder)
    for file in list(folder.iterdir()):
        found = PARTIAL.fullmatch(file.name)
        if found and _has_ended(int(found[1])):
            disk.remove(file)


def _has_ended(number: int) -> bool:
    """Whether there is no process of this number; False on Windows, which has no signal that only asks."""
    try:
        if os.name != "nt":
            os.kill(number, 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        pass
    return False


# What is in a run directory.


def find_field(path: str | Path) -> Path:
    """The checkpoint that ``RUN|FILE`` names; a change of the run directory that was interrupted is ended.

    Raises:
        InputError: there is nothing there, it is neither a run directory with a field nor a .safetensors file, or the
            field is not the one of the run's record.
    """
    path = Path(path)
    if is_official(path):
        raise InputError(f"{path}: a model of other code; make a run of it with `mplicits import {path} -o RUN`")
    if path.is_dir():
        field = path / FIELD_FILE
        _check_whole(path)
        if field.is_file():
            return field
        if (path / RECORD_FILE).is_file():
            raise InputError(
                f"{path}: holds no {FIELD_FILE}; begin again with --force of the command that began it "
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
    return Path(path).is_dir() or Path(path).suffix.lower() == ".safetensors" or is_official(path)


def is_official(path: str | Path) -> bool:
    """Whether ``path`` is a model as the paper's own code writes it, a .pth file or a folder of them, and no run."""
    path = Path(path)
    return path.suffix.lower() in (".pth", ".pt") or (path / STAGES[0] / WEIGHTS_FILE).is_file()


def load_still(path: str | Path, time: float | None = None, *, device: torch.device | str = "cpu") -> SavedField:
    """The field of a run; if it moves, that of one moment in [0, 1].

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


def load_motion(run: str | Path) -> VelocitySiren | None:
    """The velocity that a run of ``evolve --kind deform`` has learnt, on the CPU; None where the run has none.

    Raises:
        InputError: the file is damaged, or not of this run.
    """
    folder = Path(run) if Path(run).is_dir() else Path(run).parent
    file = folder / VELOCITY_FILE
    if not file.is_file():
        return None
    tensors, about = load_state(folder, name=VELOCITY_FILE)
    record = read_record(folder)
    if about.get("generation") != record.get("generation"):
        raise InputError(f"{file}: not of the run in {folder}; evolve it again")
    config = record["config"]
    velocity = VelocitySiren(config["motion_width"], 2, omega=config["motion_omega"])
    try:
        velocity.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{file}: not a motion as {RECORD_FILE} describes it; evolve it again") from error
    return velocity.requires_grad_(False)


def is_fitted(run: Path) -> bool:
    """Whether the training in a directory went to its end."""
    recovered(run)
    if not (run / FIELD_FILE).is_file() or not (run / RECORD_FILE).is_file() or (run / STATE_FILE).is_file():
        return False
    return bool(read_record(run).get("finished"))


def kept_cloud(run: Path) -> Path:
    """The file of the cloud that was made of the depth maps of a run; InputError without one."""
    kept = run / CLOUD_FILE
    if not kept.is_file():
        raise InputError(f"{run}: holds no {CLOUD_FILE}, so it was not fitted to depth maps; name its own cloud")
    return kept


def named_cloud(source: str, run: Path | None) -> dict[str, str]:
    """Where the cloud of a run directory is, for a record, so that `fitted_cloud` finds it from any folder.

    ``cloud`` is the absolute path; a source that is no file stays unchanged. ``cloud_from_run`` is the path from the
    run's directory, which holds when both are moved together. ``crs`` is its coordinate reference system, if any.
    """
    file = Path(source)
    if not file.is_file() and (run is None or file != run / CLOUD_FILE):  # that one comes with the first checkpoint
        return {"cloud": source}
    named = {"cloud": str(file.absolute())}
    if file.is_file() and (crs := coordinate_system(file)) is not None:
        named["crs"] = crs
    if run is not None:
        with suppress(ValueError):  # Windows: they are on two drives
            named["cloud_from_run"] = os.path.relpath(file.resolve(), run.resolve())
    return named


def fitted_cloud(file: Path, metadata: Mapping[str, Any], *, remedy: str) -> Path:
    """The file of the cloud that the field in a ``file`` with this ``metadata`` was fitted to.

    Raises:
        InputError: it is in neither of the places that `named_cloud` noted; the message ends with the ``remedy``.
    """
    record = metadata.get("run", {})
    source, from_run = record.get("cloud"), record.get("cloud_from_run")
    if not source:
        raise InputError(f"{file}: was not fitted to a cloud; {remedy}")
    for place in [Path(source)] + ([] if from_run is None else [file.parent / from_run]):
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
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:  # set by torchrun
        raise InputError("torchrun: a training runs in one process; start mplicits without it")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a directory for the run")
    check_place(path)
    check_unlocked(path)
    recovered(path)
    if resume:
        if not (path / STATE_FILE).is_file():
            reason = "is finished" if (path / FIELD_FILE).is_file() else "holds no interrupted run"
            raise InputError(f"{path}: {reason}, so there is nothing to resume; leave out --resume")
        return path
    harmless = {lock_file(path), path / MERGED_FILE}
    files = path.iterdir() if path.is_dir() and not force else ()
    if any(not (file in harmless or PARTIAL.fullmatch(file.name)) for file in files):
        hint = " --resume continues it," if (path / STATE_FILE).is_file() else ""
        raise InputError(f"{path}: exists and is not empty;{hint} --force overwrites it, or choose another -o")
    return path


def resumes_with(run: Path, record: Mapping[str, Any]) -> str | None:
    """The command that ends what an interrupted training in a directory began; None if nothing of one is there."""
    if not (run / STATE_FILE).is_file():
        return None
    if "shapes" in record:
        return command_line("evolve", "-o", run, "--resume")
    if "data" in record:
        return command_line("reconstruct", record["data"], "-o", run, "--resume")
    return command_line("fit", record.get("cloud", "CLOUD"), "-o", run, "--resume")


class RunFolder:
    """What a training writes: its record, a field that is usable at any time, and what it can be resumed from.

    A checkpoint replaces all files at once. An old run stays whole until the first checkpoint of a new one. Without a
    ``path`` nothing is kept; ``resume`` continues the interrupted run there.

    Raises:
        InputError: there is no directory to resume from.
    """

    def __init__(self, path: str | Path | None, *, resume: bool = False) -> None:
        if resume and path is None:
            raise InputError("resume: needs the run directory (out=...)")
        self.path, self.resume = None if path is None else Path(path), resume
        self.out = self.path
        self._found = None if self.path is None else _generation_in(self.path)
        self._generation = secrets.token_hex(8)
        self._gone: set[str] = set()  # of an older run, until the next checkpoint
        self._kept: dict[str, bytes] = {}  # for the next checkpoint

    def config(self, kind: type[C], given: C | None) -> C:
        """Settings of the run: its own if it is resumed, else those given, else the defaults.

        Raises:
            InputError: the record of the run is missing, damaged, or not as the run began.
        """
        if not self.resume or self.path is None:
            return given or kind()
        record, progress = read_record(self.path), load_state(self.path, tensors=False)[1]
        if progress.get("generation") != record.get("generation"):  # older runs have none
            raise InputError(f"{self.path}: {RECORD_FILE} and {STATE_FILE} are of two runs; begin again with --force")
        if "config" in progress:
            config, began = record["config"], progress["config"]
            for name in sorted({*config, *began} - {*MAY_CHANGE}):
                if config.get(name) != began.get(name):
                    raise InputError(
                        f"{self.path / RECORD_FILE}: says {name} {config.get(name)}, but the run began with "
                        f"{began.get(name)}; put it back (only {' and '.join(MAY_CHANGE)} may change at a resume), or "
                        "begin again with --force"
                    )
        return load_config(kind, None, record["config"])

    @contextmanager
    def writing(self, *also: str) -> Iterator[None]:
        """Make the directory and be its only writer; unless it is resumed, forget the run that was there.

        That one stays until the first checkpoint. Then what would be resumed into the new run, or colour it, is removed
        with it, and the files named ``also``.

        Raises:
            InputError: somebody else writes there, or has written since this was made.
        """
        if self.path is None:
            yield
            return
        self.path.mkdir(parents=True, exist_ok=True)
        with locked(self.path):
            prune(self.path)
            if _generation_in(self.path) != self._found:
                raise InputError(
                    f"{self.path}: another run was written there meanwhile; look at it, or choose another -o"
                )
            if self.resume:
                self._generation = read_record(self.path).get("generation", self._generation)
            else:
                self._gone = {SUPPORT_FILE, CLOUD_FILE, *also}
            yield

    def keep(self, name: str, content: bytes) -> None:
        """Have a file in the directory from the next checkpoint on."""
        if self.path is not None:
            self._kept[name] = content

    def keep_tensors(self, name: str, tensors: Mapping[str, Tensor]) -> None:
        """Have tensors in a file of the directory from the next checkpoint on; `load_state` reads them."""
        self.keep(name, state_bytes(tensors, {"generation": self._generation}))

    def save(
        self,
        field: Field,
        similarity: Similarity,
        record: Mapping[str, Any],
        tensors: Mapping[str, Tensor],
        progress: Mapping[str, Any],
    ) -> None:
        """Write a checkpoint: a usable field, and the ``tensors`` and ``progress`` (JSON) that `restore` returns."""
        if self.path is not None:
            about = {**progress, "config": record["config"], "generation": self._generation}
            self.keep(STATE_FILE, state_bytes(tensors, about))
            self._replace(self.path, field, similarity, record)

    def finish(self, field: Field, similarity: Similarity, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write field and record of a finished run → the record; what was to be resumed goes."""
        if self.path is None:
            return dict(record)
        self._gone |= {STATE_FILE}
        return self._replace(self.path, field, similarity, record)

    def _replace(self, out: Path, field: Field, similarity: Similarity, record: Mapping[str, Any]) -> dict[str, Any]:
        """Replace the files of the directory at once; the texture of an older field is removed."""
        record = {"generation": self._generation, **record}
        short = {name: value for name, value in record.items() if name not in LONG}
        files = {**self._kept, FIELD_FILE: field_bytes(field, similarity=similarity, metadata={"run": short})}
        gone = {*self._gone, TEXTURE_FILE, RADIANCE_FILE, texture_state_file(Path(TEXTURE_FILE)).name} - {*files}
        if record.get("cloud") == str((out / CLOUD_FILE).absolute()):
            gone.discard(CLOUD_FILE)  # it is what is fitted
        record = {**record, "files": {FIELD_FILE: _digest(files[FIELD_FILE])}}
        replace_files(out, {**files, RECORD_FILE: json_bytes(record)}, gone)
        self._kept, self._gone = {}, set()
        return record

    def restore(self, fingerprint: str, mismatch: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The tensors and the progress that `save` was given last.

        Raises:
            InputError: there is nothing to resume, it is damaged, or the progress has another ``fingerprint`` of what
                the run learns from; the message begins with ``mismatch``.
        """
        assert self.path is not None
        tensors, progress = load_state(self.path)
        if progress.get("fingerprint") != fingerprint:
            raise InputError(f"{mismatch}, or leave out --resume and choose a new -o")
        return tensors, progress


def write_texture(run: Path, content: bytes, record: Mapping[str, Any], *, finished: bool) -> None:
    """Write a texture, and what the record of its run, if there is one, holds as ``texture``, at once.

    The caller holds the run's lock. The state of a ``finished`` training is removed.

    Raises:
        InputError: the directory cannot be written, or its record is damaged.
    """
    files = {TEXTURE_FILE: content}
    if (run / RECORD_FILE).is_file():
        files[RECORD_FILE] = json_bytes({**read_record(run), "texture": dict(record)})
    replace_files(run, files, [texture_state_file(Path(TEXTURE_FILE)).name] * finished)


def _generation_in(run: Path) -> object:
    """What tells the run in a directory from any other; None where there is none."""
    recovered(run)
    if not (run / RECORD_FILE).is_file():
        return None
    try:
        record = json.loads((run / RECORD_FILE).read_text(encoding="utf-8"))
        return record.get("generation", "older") if isinstance(record, dict) else "damaged"
    except (OSError, ValueError, RecursionError):
        return "damaged"  # whoever reads it says so


def _check_whole(run: Path) -> None:
    """Refuse a run whose field is not that of its record, by SHA-256; a writer who is at it is waited for."""
    for _ in range(20):
        recovered(run)
        try:
            digest = json.loads((run / RECORD_FILE).read_text(encoding="utf-8"))["files"][FIELD_FILE]
            held = (run / FIELD_FILE).read_bytes()
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return  # an older run, or a field without a record; a reader reports damage
        if _digest(held) == digest:
            return
        time.sleep(0.05)  # replaced between two looks
    raise InputError(
        f"{run}: {FIELD_FILE} is damaged, or not the one that {RECORD_FILE} was written with; bring back both, or "
        "begin again with --force"
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def digest_of(arrays: Iterable[NDArray[Any]]) -> str:
    """SHA-256 of what is in the arrays, one after the other: tells whether a resumed run sees the same data."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read_record(directory: Path) -> dict[str, Any]:
    """What is in ``run.json``; InputError if there is none, or it is damaged."""
    path = directory / RECORD_FILE
    with damage(path, "fit again into a new directory"):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{path}: no such file; expected a run of mplicits fit, evolve or reconstruct") from None
        if not isinstance(record["config"], dict):
            raise TypeError("config is not a mapping")
    return record


def state_bytes(tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> bytes:
    """What `load_state` reads: tensors, and JSON."""
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    return save(plain, metadata={"progress": json.dumps({**progress, "checksum": _checksum(plain, progress)})})


def save_state(file: Path, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> None:
    """Write a file that `load_state` reads, whole or not at all; ``progress`` is JSON."""
    write_whole(file, state_bytes(tensors, progress))


def load_state(
    directory: Path, *, name: str = STATE_FILE, tensors: bool = True
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors, unless they are not wanted, and the progress in a file of `state_bytes`.

    Raises:
        InputError: there is no such file, or it is damaged.
    """
    path = directory / name
    if not path.is_file():
        raise InputError(f"{path}: no such file, so there is nothing to resume; leave out --resume and choose a new -o")
    with damage(path, "begin again without --resume"), safe_open(path, framework="pt") as file:
        progress = json.loads(file.metadata()["progress"])
        checksum = progress.pop("checksum", None)  # older ones have none
        held = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}  # noqa: SIM118
        if tensors and checksum not in (None, _checksum(held, progress)):
            raise InputError(
                f"{path}: damaged (its numbers are not those that were written); begin again without --resume"
            )
        return held, progress


def _checksum(tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> str:
    return hashlib.sha256((checksum_of(tensors) + json.dumps(dict(progress))).encode()).hexdigest()
