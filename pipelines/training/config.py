"""Typed settings: flat frozen dataclasses, filled from a YAML preset and then from flags by one mapping."""

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
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


def command_line(*words: object) -> str:
    """A command of ours that can be pasted into a shell: words with spaces or brackets are quoted."""
    return shlex.join(["mplicits", *map(str, words)])


_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text"}
_PLURALS = {bool: "true or false", int: "whole numbers", float: "finite numbers", str: "texts"}


def setting(
    default: Any,
    help: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    per_level: bool = False,
) -> Any:
    """A field of `Settings`, with its help text and its bounds as metadata.

    Args:
        default: its value where nothing else is said.
        help: what it is, for the help of its flag.
        above: the number, or every number of a list, must be larger; None, no number, is under no bound.
        at_least: it must not be smaller.
        at_most: it must not be larger.
        per_level: a list with an entry for each level; the first such field of a class says how many there are.
    """
    metadata = {"help": help, "above": above, "at_least": at_least, "at_most": at_most, "per_level": per_level}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of all settings: their fields are made by `setting` and checked when an instance is made.

    Attributes:
        gone: settings of earlier versions, each with what a user does instead.

    Raises:
        ValueError: lists of different lengths, a word that is no choice, or a number out of range; the message names
            the field, what came and what is allowed.
    """

    gone: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        first, count = "", 1
        for field in dataclasses.fields(self):
            name, value, kind = field.name, getattr(self, field.name), _hints(type(self))[field.name]
            if field.metadata["per_level"]:
                first, count = (first, count) if first else (name, len(value))
                if count == 0:
                    raise ValueError(f"{first}: expected at least one level")
                if len(value) != count:
                    raise ValueError(f"{name}: {len(value)} entries for {count} {first}; expected one for each")
            if value is not None and not _allows(value, _without_none(kind), field.metadata):
                raise ValueError(f"{name}: {value}; expected {_described(kind, field.metadata)}")


def _allows(value: Any, kind: Any, limits: Mapping[str, Any]) -> bool:
    """Whether a value is one of the choices, of the right length and within bounds."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    numbers, args = value if isinstance(value, list | tuple) else (value,), get_args(kind)
    above, least, most = limits["above"], limits["at_least"], limits["at_most"]
    return (not args or args[-1] is Ellipsis or len(numbers) == len(args)) and all(
        (above is None or number > above) and (least is None or number >= least) and (most is None or number <= most)
        for number in numbers
    )


def _described(kind: Any, limits: Mapping[str, Any] = types.MappingProxyType({})) -> str:
    """What values an annotation and the bounds of its field allow, in words."""
    inner, signs = _without_none(kind), {"above": ">", "at_least": "≥", "at_most": "≤"}
    args = get_args(inner)
    if get_origin(inner) is Literal:
        text = "one of " + ", ".join(map(str, args))
    elif get_origin(inner) is tuple:
        text = f"a list of {'' if args[-1] is Ellipsis else f'{len(args)} '}{_PLURALS[args[0]]}"
    else:
        text = _KINDS[inner]
    bounds = " and ".join(f"{sign} {limits[name]:g}" for name, sign in signs.items() if limits.get(name) is not None)
    return f"{text} {bounds}".rstrip() + ", or none" * (inner is not kind)


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
    hints, names = _hints(cls), _names(cls)
    source, pairs = _read_preset(preset, thing or thing_of(cls))
    values: dict[str, Any] = {}
    given = [(f"{source}: {key}", f"{source}: unknown key {str(key)!r}", key, value) for key, value in pairs.items()]
    given += [(_flag(key), f"unknown flag {_flag(key)}", key, value) for key, value in (overrides or {}).items()]
    for place, unknown, key, value in given:
        if key in getattr(cls, "gone", {}):
            raise input_error(f"{place}: is gone; {cls.gone[key]}")  # pyright: ignore[reportAttributeAccessIssue]
        if key not in names:
            near = closest(_flag(str(key)), map(_flag, names)) if place[0] == "-" else closest(str(key), names)
            raise input_error(unknown + near)
        try:
            values[key] = _convert(value, hints[key])
        except (ValueError, OverflowError) as error:
            shown = " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            raise input_error(f"{place}: got {shown!r}, expected {_described(hints[key])}") from error
    try:
        return cls(**values)
    except ValueError as error:  # a check of the dataclass itself, which begins with a field
        name, _, problem = str(error).partition(":")
        if name in (overrides or {}):
            raise input_error(f"{_flag(name)}:{problem}") from error
        raise input_error(f"{source}: {error}" if preset is not None else str(error)) from error


def add_config_flags(parser: argparse.ArgumentParser, cls: type, *, about: str = "each overrides the preset") -> None:
    """Add one flag per field of ``cls`` (``learning_rates`` → ``--learning-rates 1e-3 5e-4``).

    A flag that is not given leaves no trace in the namespace, so that only given ones override. Values stay text:
    `load_config` checks them with the same rules as a file's. Settings that are gone have hidden flags, which it
    refuses.

    Args:
        parser: gets the flags.
        cls: a dataclass of settings.
        about: a few words above them in the help.
    """
    group = parser.add_argument_group("settings", about)
    for field in dataclasses.fields(cls):
        kind = _without_none(_hints(cls)[field.name])
        text = str(field.metadata.get("help", "")).replace("%", "%%")
        options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": text, "dest": field.name}
        item = get_args(kind)[0] if get_origin(kind) is tuple else kind
        if kind is bool:
            options["action"] = argparse.BooleanOptionalAction
        elif get_origin(item) is Literal:
            options["metavar"] = "{" + ",".join(map(str, get_args(item))) + "}"
        else:
            options |= {"metavar": {int: "N", float: "X"}.get(item, "TEXT"), "nargs": None if item is kind else "+"}
        group.add_argument(_flag(field.name), **options)
    for name in getattr(cls, "gone", {}):
        group.add_argument(_flag(name), dest=name, nargs="*", default=argparse.SUPPRESS, help=argparse.SUPPRESS)


def given_flags(arguments: argparse.Namespace, cls: type) -> dict[str, Any]:
    """The fields of ``cls`` that were given on the command line: neither left out nor None; lists as tuples.

    Those of `add_config_flags` are ready for ``load_config``'s ``overrides``; those of flags of another kind for the
    class itself, whose defaults then hold for the rest.
    """
    given = {name: getattr(arguments, name, None) for name in (*_names(cls), *getattr(cls, "gone", {}))}
    return {name: tuple(x) if isinstance(x, list) else x for name, x in given.items() if x is not None}


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


def _read_preset(preset: str | Path | None, thing: str) -> tuple[str, Mapping[Any, object]]:
    """Name for messages, and the key-value pairs of a preset."""
    import yaml  # late, as all that --help can do without

    if preset is None:
        return thing, {}
    if isinstance(preset, Path) or preset.endswith((".yaml", ".yml")):
        source, file = str(preset), Path(preset)
    elif preset in (names := preset_names(thing)):
        source = f"{thing}_{preset}.yaml"
        file = resources.files("mplicits.configs") / source
    else:
        raise input_error(f"no preset {preset!r} for {thing}{closest(preset, names)} (a file: --config FILE)")
    try:
        pairs = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise input_error(f"{source}: cannot read the configuration ({reason})") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise input_error(f"{source}{place}: not YAML ({getattr(error, 'problem', None) or 'unreadable'})") from error
    except (RecursionError, ValueError) as error:  # a year of 400 digits, a date of the 45th of May
        reason = "nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())[:160]
        raise input_error(f"{source}: not settings ({reason}); expected lines of 'key: value'") from error
    if pairs is not None and not isinstance(pairs, dict):
        raise input_error(f"{source}: expected lines of 'key: value', got a {type(pairs).__name__}")
    return source, pairs or {}


def _convert(value: object, kind: Any) -> Any:
    """``value``, or the text of one, as an instance of the annotation ``kind``; ValueError if it is none.

    Numbers may be text: YAML itself reads ``1e-3``, which has no point, as text.
    """
    args, inner = get_args(kind), _without_none(kind)
    if inner is not kind:
        return None if value in (None, "none", ["none"], ("none",)) else _convert(value, inner)
    if get_origin(kind) is Literal and value in args:
        return value
    if get_origin(kind) is tuple and isinstance(value, list | tuple):
        kinds = args[:1] * len(value) if args[-1] is Ellipsis else args
        return tuple(_convert(item, part) for item, part in zip(value, kinds, strict=True))
    if kind in (bool, str) and isinstance(value, kind):
        return value
    if kind in (int, float) and isinstance(value, int | float | str) and not isinstance(value, bool):
        number = value if kind is int and isinstance(value, int) else float(value)
        if isinstance(number, int) or (math.isfinite(number) and (kind is float or number.is_integer())):
            return kind(number)
    raise ValueError


def _names(cls: type) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)]


def _without_none(kind: Any) -> Any:
    """The X of ``X | None``; any other annotation as it is."""
    if get_origin(kind) is types.UnionType or get_origin(kind) is Union:
        (kind,) = (arg for arg in get_args(kind) if arg is not types.NoneType)
    return kind


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def input_error(message: str) -> Exception:
    """An ``InputError``, imported late: its package loads torch, and ``mplicits --help`` must not wait for that."""
    from ...neural_fields.backend.errors import InputError

    return InputError(message)
