"""Typed settings: flat dataclasses whose fields say what is allowed, filled from a YAML preset and then from flags."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import functools
import math
import shlex
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

__all__ = [
    "Settings",
    "add_config_flags",
    "closest",
    "command_line",
    "given_flags",
    "input_error",
    "load_config",
    "preset_names",
    "setting",
    "thing_of",
]

T = TypeVar("T")


def command_line(*words: object) -> str:
    """A command of ours that can be pasted into a shell: words with spaces or brackets are quoted."""
    return shlex.join(["mplicits", *map(str, words)])


Pairs = Mapping[object, object]


class _MismatchError(Exception):
    """A value does not fit its annotation; the message says what would."""


def setting(
    default: Any,
    help: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    per_level: bool = False,
) -> Any:
    """A field of `Settings`.

    Args:
        default: its value where nothing else is said.
        help: what it is, for the help of its flag.
        above: the number, or every number of a list, must be larger; None, no number, is under no bound.
        at_least: it must not be smaller.
        at_most: it must not be larger; goes with one of the others.
        per_level: a list with an entry for each level; the first such field of a class says how many there are.
    """
    low = at_least if above is None else above
    if low is None:
        allowed = ""
    elif at_most is not None:
        allowed = f"in {'[' if above is None else '('}{low:g}, {at_most:g}]"
    else:
        allowed = f"> {low:g}" if above is not None else f"at least {low:g}" if low else "≥ 0"

    def holds(number: float) -> bool:  # not of NaN
        return (
            (above is None or number > above)
            and (at_least is None or number >= at_least)
            and (at_most is None or number <= at_most)
        )

    metadata = {"help": help, "allowed": allowed, "holds": holds, "per_level": per_level}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """What all settings share: their fields are made by `setting`, and checked when an instance is made.

    Raises:
        ValueError: lists of different lengths, a word that is no choice, or a number out of range; the message names
            the field, what came and what is allowed.
    """

    def __post_init__(self) -> None:
        fields = dataclasses.fields(self)
        lists = {field.name: len(getattr(self, field.name)) for field in fields if field.metadata["per_level"]}
        first, count = next(iter(lists.items()), ("", 1))
        if count == 0:
            raise ValueError(f"{first}: expected at least one level")
        for name, entries in lists.items():
            if entries != count:
                raise ValueError(f"{name}: {entries} entries for {count} {first}; expected one for each")
        for field in fields:
            kind, value = _hints(type(self))[field.name], getattr(self, field.name)
            allowed = None if value is None else _refused(value, _without_none(kind), field.metadata)
            if allowed is not None:
                choice = ", or none" * (kind is not _without_none(kind))
                raise ValueError(f"{field.name}: {value}; expected {allowed}{choice}")


def _refused(value: Any, kind: Any, metadata: Mapping[str, Any]) -> str | None:
    """What is allowed in place of a value; None where it is allowed itself."""
    if get_origin(kind) is Literal:
        return None if value in get_args(kind) else "one of " + ", ".join(get_args(kind))
    numbers, count = value if isinstance(value, list | tuple) else (value,), _length(kind)
    if count in (None, len(numbers)) and all(map(metadata["holds"], numbers)):
        return None
    if get_origin(kind) is tuple:
        return f"{count or ''} numbers {metadata['allowed']}".strip()
    return f"{'a number ' * metadata['allowed'].startswith('in')}{metadata['allowed']}"


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def load_config(
    cls: type[T],
    preset: str | Path | None = None,
    overrides: Mapping[str, object] | None = None,
    *,
    thing: str | None = None,
) -> T:
    """Build a ``cls`` from its defaults, then a preset, then overrides.

    Args:
        cls: a flat dataclass: bool, int, float, str, Literal, ``tuple[X, ...]`` and ``X | None``.
        preset: the name of a preset in ``mplicits.configs`` (``"fast"`` is ``<thing>_fast.yaml``), or
            the path of a YAML file (a ``Path``, or a string that ends in .yaml or .yml).
        overrides: field name → value or its text; given by flags, and named as flags in messages.
        thing: what is configured; the first half of a preset's file name. By default `thing_of` the class.

    Raises:
        InputError: no such preset or file, not YAML, an unknown key, or a value of the wrong kind. The
            message names the file or flag, the key, what came and what is allowed.
    """
    hints = _hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]
    source, pairs = _read_preset(preset, thing or thing_of(cls))
    values: dict[str, Any] = {}
    for key, value in pairs.items():
        if key not in hints or not isinstance(key, str):
            raise input_error(f"{source}: unknown key {str(key)!r}{closest(str(key), fields)}")
        values[key] = _checked(value, hints[key], f"{source}: {key}")
    for key, value in (overrides or {}).items():
        if key not in hints:
            raise input_error(f"unknown flag {_flag(key)}{closest(_flag(key), map(_flag, fields))}")
        values[key] = _checked(value, hints[key], _flag(key))
    try:
        return cls(**values)
    except ValueError as error:  # a check of the dataclass itself, which begins with a field
        name, _, problem = str(error).partition(":")
        if name in (overrides or {}):
            raise input_error(f"{_flag(name)}:{problem}") from error
        raise input_error(f"{source}: {error}" if preset is not None else str(error)) from error


def add_config_flags(parser: argparse.ArgumentParser, cls: type, *, about: str = "each overrides the preset") -> None:
    """Add one flag per field of ``cls`` (``learning_rates`` → ``--learning-rates 1e-3 5e-4``).

    A flag that is not given leaves no trace in the namespace, so that only given ones override. Values
    stay text: ``load_config`` checks them with the same rules as a file's.

    Args:
        parser: gets the flags.
        cls: a dataclass of settings.
        about: a few words above them in the help.
    """
    group = parser.add_argument_group("settings", about)
    hints = _hints(cls)
    for field in dataclasses.fields(cls):
        kind = hints[field.name]
        text = str(field.metadata.get("help", "")).replace("%", "%%")
        options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": text, "dest": field.name}
        if _without_none(kind) is bool:
            group.add_argument(_flag(field.name), action=argparse.BooleanOptionalAction, **options)
        else:
            many = get_origin(_without_none(kind)) is tuple
            options["metavar"] = _metavar(kind)
            group.add_argument(_flag(field.name), nargs="+" if many else None, **options)


def given_flags(arguments: argparse.Namespace, cls: type) -> dict[str, Any]:
    """The fields of ``cls`` that were given on the command line: neither left out nor None; lists as tuples.

    Those of `add_config_flags` are ready for ``load_config``'s ``overrides``; those of flags of another kind for the
    class itself, whose defaults then hold for the rest.
    """
    given = {field.name: getattr(arguments, field.name, None) for field in dataclasses.fields(cls)}
    given = {name: value for name, value in given.items() if value is not None}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}


def thing_of(cls: type) -> str:
    """What a class of settings configures: ``"fit"`` for ``FitConfig``."""
    return cls.__name__.removesuffix("Config").lower()


def preset_names(thing: str) -> list[str]:
    """Names of the bundled presets of ``thing``, sorted."""
    files = (Path(file.name) for file in resources.files("mplicits.configs").iterdir())
    return sorted(file.stem.removeprefix(f"{thing}_") for file in files if file.match(f"{thing}_*.yaml"))


def closest(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'widths'?"``, or the known names where none is near."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(known)}"


def _read_preset(preset: str | Path | None, thing: str) -> tuple[str, Pairs]:
    """Name for messages, and the key-value pairs of a preset."""
    import yaml  # late, as all that --help can do without

    if preset is None:
        return thing, {}
    if isinstance(preset, Path) or preset.endswith((".yaml", ".yml")):
        source = str(preset)
        try:
            text = Path(preset).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            raise input_error(f"{source}: cannot read the configuration ({reason})") from error
    else:
        names = preset_names(thing)
        if preset not in names:
            raise input_error(f"no preset {preset!r} for {thing}{closest(preset, names)} (a file: --config FILE)")
        source = f"{thing}_{preset}.yaml"
        text = (resources.files("mplicits.configs") / source).read_text(encoding="utf-8")
    try:
        pairs = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise input_error(f"{source}{place}: not YAML ({problem})") from error
    except (RecursionError, ValueError) as error:  # a year of 400 digits, a date of the 45th of May
        reason = "nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())[:160]
        raise input_error(f"{source}: not settings ({reason}); expected lines of 'key: value'") from error
    if pairs is None:
        return source, {}
    if not isinstance(pairs, dict):
        raise input_error(f"{source}: expected lines of 'key: value', got a {type(pairs).__name__}")
    return source, pairs


def _checked(value: object, kind: Any, place: str) -> Any:
    try:
        return _convert(value, kind)
    except _MismatchError as error:
        shown = " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
        raise input_error(f"{place}: got {shown!r}, expected {error}") from error


def _convert(value: object, kind: Any) -> Any:
    """``value``, or the text of one, as an instance of the annotation ``kind``."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        if value in args:
            return value
        raise _MismatchError("one of " + ", ".join(map(str, args)))
    if origin is tuple:
        return _convert_tuple(value, kind)
    if origin is types.UnionType or origin is Union:
        if value is None or value in ("none", ["none"], ("none",)):
            return None
        try:
            return _convert(value, _without_none(kind))
        except _MismatchError as error:
            raise _MismatchError(f"{error}, or none") from error
    if kind in (int, float):
        return _convert_number(value, kind)
    if isinstance(value, kind):
        return value
    raise _MismatchError({bool: "true or false", str: "text"}[kind])


def _convert_number(value: object, kind: type[int] | type[float]) -> int | float:
    """Numbers, and their text: YAML itself reads ``1e-3``, which has no point, as text."""
    allowed = "a whole number" if kind is int else "a finite number"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise _MismatchError(allowed)
    if kind is int and isinstance(value, int):
        return value
    try:
        number = float(value)
    except ValueError as error:
        raise _MismatchError(allowed) from error
    if not math.isfinite(number) or (kind is int and not number.is_integer()):
        raise _MismatchError(allowed)
    return kind(number)


def _convert_tuple(value: object, kind: Any) -> tuple[Any, ...]:
    args = get_args(kind)
    count = _length(kind)
    allowed = f"a list of {'' if count is None else f'{count} '}{_plural(args[0])}"
    if not isinstance(value, list | tuple) or len(value) not in (count or len(value),):
        raise _MismatchError(allowed)
    try:
        return tuple(_convert(item, args[0] if count is None else args[i]) for i, item in enumerate(value))
    except _MismatchError as error:
        raise _MismatchError(allowed) from error


def _without_none(kind: Any) -> Any:
    """The X of ``X | None``; any other annotation as it is."""
    if get_origin(kind) is types.UnionType or get_origin(kind) is Union:
        (kind,) = (arg for arg in get_args(kind) if arg is not types.NoneType)
    return kind


def _length(kind: Any) -> int | None:
    """How many items ``tuple[X, Y]`` has; None for ``tuple[X, ...]`` and for what is no tuple."""
    args = get_args(kind)
    return len(args) if get_origin(kind) is tuple and args[-1] is not Ellipsis else None


def _plural(kind: Any) -> str:
    return {int: "whole numbers", float: "finite numbers", bool: "true or false"}.get(kind, "texts")


def _metavar(kind: Any) -> str:
    kind = _without_none(kind)
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, get_args(kind))) + "}"
    return {int: "N", float: "X"}.get(kind, "TEXT")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def input_error(message: str) -> Exception:
    """An ``InputError``, imported late: its package loads torch, and ``mplicits --help`` must not wait for that."""
    from ...neural_fields.backend.errors import InputError

    return InputError(message)
