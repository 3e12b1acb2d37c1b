"""Settings of ``fit``, ``texture``, ``reconstruct``, ``evolve`` and of shading; each is a key of presets and a flag.

Nothing heavy is imported, so that ``--help`` stays quick.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import functools
import itertools
import math
import shlex
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


def command_line(*words: object) -> str:
    """A command of ours that can be pasted into a shell: words with spaces or brackets are quoted."""
    return shlex.join(["mplicits", *map(str, words)])


_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text"}


def setting(
    default: Any,
    help: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    per_level: bool = False,
) -> Any:
    """A field of `Settings`, with its help text and its bounds, which hold for every number of a list, as metadata.

    With ``per_level`` it is a list with an entry for each level; the first such field of a class says how many there
    are.
    """
    metadata = {"help": help, "above": above, "at_least": at_least, "at_most": at_most, "per_level": per_level}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of all settings: their fields are made by `setting` and checked when an instance is made.

    Raises:
        ValueError: lists of different lengths, a word that is no choice, or a number out of range; the message names
            the field, what came and what is allowed.
    """

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
        plural = _KINDS[args[0]].removeprefix("a ") + "s"
        text = f"a list of {'' if args[-1] is Ellipsis else f'{len(args)} '}{plural}"
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
) -> T:
    """Build a ``cls`` from its defaults, then a preset, then overrides.

    Args:
        cls: a flat dataclass: bool, int, float, str, Literal, ``tuple[X, ...]`` and ``X | None``.
        preset: the name of a preset in ``mplicits.configs`` (``"fast"`` is ``<thing>_fast.yaml``), or
            the path of a YAML file (a ``Path``, or a string that ends in .yaml or .yml).
        overrides: field name → value or its text; given by flags, and named as flags in messages.

    Raises:
        InputError: no such preset or file, not YAML, an unknown key, or a value of the wrong kind. The
            message names the file or flag, the key, what came and what is allowed.
    """
    hints, names = _hints(cls), _names(cls)
    source, pairs = _read_preset(preset, thing_of(cls))
    values: dict[str, Any] = {}
    given = [(f"{source}: {key}", f"{source}: unknown key {str(key)!r}", key, value) for key, value in pairs.items()]
    given += [(_flag(key), f"unknown flag {_flag(key)}", key, value) for key, value in (overrides or {}).items()]
    for place, unknown, key, value in given:
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
    """Add one flag per field of ``cls`` (``learning_rates`` → ``--learning-rates 1e-3 5e-4``) to a parser.

    A flag that is not given leaves no trace in the namespace. Values stay text, which `load_config` checks like a
    file's.
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


def given_flags(arguments: argparse.Namespace, cls: type) -> dict[str, Any]:
    """The fields of ``cls`` that were given on the command line: neither left out nor None; lists as tuples.

    They are ready for ``load_config``'s ``overrides``, or for the class itself.
    """
    given = {name: getattr(arguments, name, None) for name in _names(cls)}
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
        if not isinstance(pairs, dict | None):
            raise TypeError(f"it is a {type(pairs).__name__}")
    except FileNotFoundError:
        raise input_error(f"{source}: no such file; check the path") from None
    except Exception as error:  # YAML raises errors of many kinds, as for a date of the 45th of May
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())[:160]
        raise input_error(f"{source}: cannot be read as lines of 'key: value' ({reason})") from error
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
    """The X of ``X | None``; any other annotation unchanged."""
    if get_origin(kind) is types.UnionType or get_origin(kind) is Union:
        (kind,) = (arg for arg in get_args(kind) if arg is not types.NoneType)
    return kind


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def input_error(message: str) -> Exception:
    """An ``InputError``, imported late: its package loads torch, and ``mplicits --help`` must not wait for that."""
    from ...neural_fields.backend.errors import InputError

    return InputError(message)


_per_level = functools.partial(setting, above=0, per_level=True)
_share = functools.partial(setting, at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(Settings):
    """Settings of every training."""

    time_budget: float | None = setting(None, "end training after about this many seconds", above=0)
    seed: int = setting(0, "random seed")
    device: str = setting("auto", "torch device: auto, cpu, cuda, ...")


@dataclass(frozen=True)
class FitConfig(TrainingSettings):
    """Settings of ``fit``; the defaults are the ``default`` preset."""

    widths: tuple[int, ...] = _per_level((128, 256, 400), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _per_level((2, 2, 2), "sine layers, one number per level")
    omegas: tuple[float, ...] = _per_level((30.0, 80.0, 160.0), "SIREN frequency of each level (Eq. 2)")
    steps: tuple[int, ...] = _per_level((700, 400, 300), "training steps, one number per level")
    learning_rates: tuple[float, ...] = _per_level((4e-3, 2.5e-4, 1e-4), "peak learning rate of each level")
    turn: float = setting(0.25, "peak change of hidden phases in a step, radians; 0: Adam trains all", at_least=0)
    batch: int = setting(8192, "samples per training step", above=0)
    levels: int | None = setting(None, "train only this many levels, coarse to fine")
    data_weight: float = setting(1e4, "level 0: weight of (f(x) - d)^2, the distance d known (Eq. 4)", at_least=0)
    residual_data_weight: float = setting(1.0, "the same of other levels, over the mean square before", at_least=0)
    normal_weight: float = setting(300.0, "weight of 1 - cos(grad f, N), the normal N known (Eq. 4)", at_least=0)
    robust_normals: bool = setting(True, "residual levels of sparse clouds: large errors of normals count linearly")
    eikonal_weight: float = setting(50.0, "weight of (|grad f| - 1)^2 (Eq. 4)", at_least=0)
    domain_weight: float = setting(0.1, "factor on data_weight for level 0's distances away from the cloud", at_least=0)
    epsilon: float = setting(0.3, "margin of the bands (Eq. 5)", above=0)
    quantile: float | None = setting(
        None,
        "quantile of |f(x_j)| that a band holds; 1: the maximum (Eq. 5), none: the maximum but for strays",
        above=0,
        at_most=1,
    )
    samples: int = setting(400_000, "samples made per level and kind, drawn from at every step", above=0)
    columns: str | None = setting(
        None, "names of all columns of a table that has no names, - for one to ignore, such as x,y,z,nx,ny,nz,r,g,b,-"
    )
    drop_noise: bool = setting(False, "leave out points of LAS and LAZ files that are classified as noise")
    normals: Literal["auto", "file", "estimate", "none"] = setting(
        "auto", "where normals come from; none: level 0 learns from points alone, and orients their normals"
    )
    sensor_origin: tuple[float, float, float] | None = setting(None, "x y z of the sensor, which normals face")
    isolation: float | None = setting(
        30.0, "drop points whose 8th neighbour is this many times further away than usual; none keeps them", above=1
    )
    merge_above: int | None = setting(1_000_000, "merge larger clouds to so many voxel means; none: never", above=0)
    drop_outliers: bool = setting(True, "drop points that belong to no surface, by neighbours and distance to level 0")
    turn_normals: bool = setting(True, "turn single normals that oppose their neighbours' (not with --normals file)")
    smooth_noise: bool = setting(True, "move points along their normals to where neighbours agree, if noise is large")
    between: bool = setting(True, "learn between the points too, where neighbours and normals agree on the surface")
    hold_out: float = setting(
        0.01,
        "share of the points held out to choose the best step of a level, and whether to keep it; 0: none",
        at_least=0,
        at_most=0.1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels is not None and not 1 <= self.levels <= len(self.widths):
            raise ValueError(f"levels: {self.levels}; expected 1 to {len(self.widths)}, the number of widths")

    @property
    def num_levels(self) -> int:
        """How many levels are trained."""
        return len(self.widths) if self.levels is None else self.levels

    def data_weight_after(self, mean_square: float, noise: float) -> float:
        """Weight of (f(x) − d)² at a level whose predecessor misses the points by this mean square.

        In units of that error the balance with the other terms stays what it was. It is taken for no smaller than the
        square of the ``noise``, whose waves the level before follows all too closely.
        """
        return self.residual_data_weight / max(mean_square, noise**2, 1e-10)


@dataclass(frozen=True)
class TextureConfig(TrainingSettings):
    """Settings of ``texture``; the defaults are the ``default`` preset."""

    columns: str | None = setting(None, "names of all columns of a table that has no names; see fit")
    width: int = setting(256, "neurons per layer", above=0)
    depth: int = setting(3, "sine layers", above=0)
    omega: float = setting(60.0, "SIREN frequency: higher takes up finer detail, and more of the noise", above=0)
    steps: int = setting(500, "training steps", above=0)
    learning_rate: float = setting(5e-4, "peak learning rate", above=0)
    turn: float = setting(0.25, "peak change of hidden phases in a step, radians; 0: Adam trains all", at_least=0)
    batch: int = setting(8192, "points with colours per training step", above=0)
    band_batch: int = setting(2048, "points of the band per training step", above=0)
    tangential_weight: float = setting(0.3, "weight of the change of colour along the normals", at_least=0)
    samples: int = setting(400_000, "points on a mesh, and half as many in the band, to draw from", above=0)
    delta: float | None = setting(None, "half-width of the band; none: the coarsest level's, at least 0.02", above=0)


@dataclass(frozen=True)
class ReconstructConfig(TrainingSettings):
    """Settings of ``reconstruct``; the defaults are the ``default`` preset."""

    geometry: Literal["multiscale", "neus"] = setting("multiscale", "SIRENs in bands, or 8 x 256 softplus layers")
    widths: tuple[int, ...] = _per_level((128, 256), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _per_level((4, 3), "sine layers, one number per level")
    omegas: tuple[float, ...] = _per_level((10.0, 30.0), "SIREN frequency of each level (Eq. 2)")
    starts: tuple[float, ...] = setting((0.0, 0.25), "share of the training before each level starts", per_level=True)
    features: int = setting(32, "appearance features of every level of the multiscale geometry", at_least=0)
    taper: float = _share(0.3, "share of a band over which the next level fades out")
    band: float = setting(4.0, "half-width of the bands in units of the surface's uncertainty 1/s", above=0)
    least_delta: float = setting(0.02, "half-width that a band keeps, in units of the region's radius", above=0)
    start: Literal["auto", "hull", "depths", "sphere"] = setting(
        "auto",
        "initial geometry: hull of the masks, what no measured ray passes, or a sphere; auto: the first there is",
    )
    radius: float = setting(0.5, "initial sphere, in units of the region's radius", above=0)
    color_width: int = setting(128, "neurons per layer of the colour network", above=0)
    color_depth: int = setting(2, "layers of the colour network", above=0)
    color_frequencies: int = setting(4, "octaves of the colour network's position; NeuS has 0", at_least=0)
    color_grid: int = setting(512, "cells along the finest grid of the colours' hash encoding; 0: none", at_least=0)
    background: Literal["auto", "black", "white", "outside"] = setting(
        "auto", "what is behind the object; outside is learnt; auto: white with masks, else outside"
    )
    allow_missing: bool = setting(False, "go on without photographs that are missing, or have no camera")
    depth_maps: str | None = setting(None, "folder with a depth map for each photograph; none: the data set's")
    depth_kind: Literal["metric", "relative", "disparity"] = setting(
        "metric", "depths in the units of the cameras; of unknown scale and shift; or inverse ones of that kind"
    )
    depth_scale: float | None = setting(
        None, "numbers of the depth maps per unit of the cameras; by default 1000 for integers, else 1", above=0
    )
    exposure: Literal["off", "affine"] = setting("off", "affine: learn gain and offset of each photograph and colour")
    cameras: Literal["given", "refined"] = setting("given", "refined: learn a small rotation and shift of each camera")
    steps: int = setting(5000, "training steps", above=0)
    rays: int = setting(256, "rays per training step", above=0)
    jets: int = setting(3072, "samples per step, about, by fewer rays while the surface is unsure; 0: any", at_least=0)
    focus: float = _share(0.5, "share of the rays drawn by the error of their pixels; 0: all evenly")
    uniform: int = setting(48, "evenly spaced samples per ray", at_least=2)
    importance: int = setting(8, "samples per ray near the surface", at_least=0)
    texture_steps: int = setting(500, "training steps of the surface's texture; 0: uncoloured", at_least=0)
    learning_rate: float = setting(1e-4, "peak learning rate of the geometry", above=0)
    turn: float = setting(0.01, "peak change of hidden phases in a step, radians; 0: Adam trains all", at_least=0)
    color_rate: float = setting(36.0, "learning rate of the colours, over the geometry's", above=0)
    grid_rate: float = setting(2.5, "learning rate of the hash encoding, over the colours'", above=0)
    sharpening: float = setting(24.0, "learning rate of the surface's uncertainty, over the geometry's", above=0)
    eikonal_weight: float = setting(0.05, "weight of (|grad f| - 1)^2", at_least=0)
    mask_weight: float = setting(0.1, "weight of the masks' cross-entropy, where there are masks", at_least=0)
    depth_weight: float = setting(0.5, "weight of measured depths (depth maps, COLMAP's points); 0: unused", at_least=0)
    consistency: float = setting(
        0.0,
        "weight of how photographs differ on the surface (1 - NCC), and its bends where they are plain; 0: none",
        at_least=0,
    )
    anneal: float = _share(0.2, "share of the training with annealed slopes")
    least_weight: float = setting(1e-4, "samples that contribute less to their pixel get no colour", at_least=0)
    skip: float = _share(1e-3, "samples of smaller estimated weight are not evaluated; 0: all are")
    skip_share: float = _share(0.03, "share of the skipped samples evaluated for the eikonal term")
    march_grid: int = setting(64, "cells along the SDF grid that places samples; 0: the network does", at_least=0)
    graphs: bool = setting(True, "on a GPU, record each kind of step once, and replay it as one CUDA graph")
    width: int | None = setting(None, "shrink the pictures to this many pixels across before training", above=0)
    test_every: int = setting(8, "every n-th picture is held out and measured; 0 trains on all", at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.starts[0] != 0 or any(not 0 <= b < 1 or b < a for a, b in itertools.pairwise(self.starts)):
            raise ValueError(f"starts: {self.starts}; expected 0 first, then growing shares below 1")


@dataclass(frozen=True)
class EvolveConfig(TrainingSettings):
    """Settings of ``evolve``; the defaults are the ``default`` preset."""

    kind: Literal["morph", "deform", "transport", "smooth"] = setting(
        "morph", "from shape to shape along normals, or by a learnt motion; by a vector field; by mean curvature"
    )
    shapes: tuple[str, ...] = setting((), "runs, .safetensors files, or exact shapes such as sphere:0.4@0.2,0,0")
    times: tuple[float, ...] = setting((), "morph, deform: when each shape is reached, 0 to 1 (evenly spaced)")
    align: Literal["none", "center", "pca"] = setting(
        "center", "morph, deform: leave shapes in place, lay their unit spheres on each other, or turn them too"
    )
    velocity: tuple[float, ...] = setting((0.0, 0.0, 0.0), "transport: way per unit of time, three numbers per shape")
    axis: tuple[float, ...] = setting((0.0, 0.0, 1.0), "transport: axis of rotation, three numbers per shape")
    center: tuple[float, ...] = setting((0.0, 0.0, 0.0), "transport: a point on the axis, three numbers per shape")
    angle: tuple[float, ...] = setting((0.0,), "transport: radians per unit of time, one number per shape")
    twist: tuple[float, ...] = setting((0.0,), "transport: radians more per unit along the axis, one number per shape")
    alpha: float = setting(0.02, "smooth: how fast; a sphere has r(t)^2 = r^2 - 4 alpha t, in units of the field")
    landmarks: tuple[str, ...] = setting(
        (), "deform: a file for each two shapes of matching points; a line is x y z of one, x y z of the next"
    )
    landmark_weight: float = setting(2.0, "deform: weight of the landmarks' squared distances", at_least=0)
    motion_steps: int = setting(600, "deform: steps in which the motion is learnt, for each two shapes", above=0)
    motion_width: int = setting(64, "deform: neurons in each of the motion's two sine layers", above=0)
    motion_omega: float = setting(3.0, "deform: frequency of the motion; a low one keeps it smooth", above=0)
    motion_rate: float = setting(5e-3, "deform: peak learning rate of the motion", above=0)
    guide_weight: float = setting(1.0, "deform: weight of the matched points, which fades", at_least=0)
    rigid_weight: float = setting(0.01, "deform: weight of the Killing energy, as rigid as possible", at_least=0)
    volume_weight: float = setting(0.0, "deform: weight of the squared divergence, as even in volume", at_least=0)
    widths: tuple[int, ...] = _per_level((128, 256), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _per_level((2, 2), "sine layers, one number per level")
    omegas: tuple[float, ...] = _per_level((15.0, 40.0), "SIREN frequency of each level (Eq. 2)")
    steps: tuple[int, ...] = _per_level((700, 350), "training steps, one number per level")
    learning_rates: tuple[float, ...] = _per_level((4e-3, 5e-4), "peak learning rate of each level")
    turn: float = setting(0.15, "peak change of hidden phases in a step, radians; 0: Adam trains all", at_least=0)
    data_weights: tuple[float, ...] = _per_level((100.0, 1000.0), "weight of known values and gradients, per level")
    start_steps: int = setting(300, "steps in which level 0 learns the first shape alone", at_least=0)
    batch: int = setting(4096, "samples per step: half known ones, half near the surface", above=0)
    samples: int = setting(100_000, "known samples to draw from", above=0)
    near: float = setting(0.1, "half-width of the band of level 0's law, in units of the field", above=0)
    law_weight: float = setting(1.0, "weight of the squared error of the normal speed", at_least=0)
    eikonal_weight: float = setting(0.3, "weight of (|grad f| - 1)^2", at_least=0)
    bound_weight: float = setting(10.0, "weight of values outside of known bounds", at_least=0)
    length: float = setting(0.05, "what a known gradient counts beside a known value, as a length", at_least=0)
    time_gain: float = setting(0.3, "initial weights of time in a residual level, over the usual ones", above=0)
    epsilon: float = setting(0.5, "margin of the bands over the largest error before (Eq. 5)", at_least=0)
    least_delta: float = setting(0.01, "half-width that a band has at least, in units of the field", above=0)
    frames: int = setting(21, "times at which the result is checked", at_least=2)
    resolution: int = setting(96, "cells along each side of the meshes of those checks", at_least=16)

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.shapes)
        if self.times:
            if len(self.times) != count:
                raise ValueError(f"times: {len(self.times)} numbers for {count} shapes; expected one for each")
            if any(not a < b for a, b in itertools.pairwise(self.times)) or (self.times[0], self.times[-1]) != (0, 1):
                raise ValueError(f"times: {self.times}; expected growing numbers from 0 to 1")
        if self.landmarks and (self.kind != "deform" or len(self.landmarks) != count - 1):
            files = f"{len(self.landmarks)} files for {count} shapes, kind {self.kind}"
            raise ValueError(f"landmarks: {files}; expected kind deform, and one file for each two shapes")
        for name, size in _SIZES.items():
            if len(getattr(self, name)) not in (size, size * max(count, 1)):
                raise ValueError(f"{name}: {len(getattr(self, name))} numbers; expected {size}, or {size} per shape")
        if not all(any(self.per_shape("axis", index)) for index in range(max(count, 1))):
            raise ValueError(f"axis: {self.axis}; expected a vector of non-zero length")

    @property
    def num_levels(self) -> int:
        """How many levels are trained."""
        return len(self.widths)

    def key_times(self) -> tuple[float, ...]:
        """When each shape of a morph is reached."""
        if self.times:
            return self.times
        last = max(1, len(self.shapes) - 1)
        return tuple(index / last for index in range(len(self.shapes)))

    def per_shape(self, name: str, index: int) -> tuple[float, ...]:
        """The numbers of one shape; those that were given once hold for all."""
        numbers, size = getattr(self, name), _SIZES[name]
        start = index * size if len(numbers) > size else 0
        return numbers[start : start + size]


_SIZES = {"velocity": 3, "axis": 3, "center": 3, "angle": 1, "twist": 1}


SHADINGS: dict[str, str] = {
    "lambert": "clay, or the surface's own colour, under a lamp above left of the camera",
    "headlight": "clay, or the surface's own colour, under a lamp at the camera",
    "raking": "clay, or the surface's own colour, under a lamp at the left that grazes what faces the camera",
    "normals": "the normal as a colour, (n + 1) / 2, in world axes",
    "depth": "distance from the camera, near light and far dark",
    "curvature": "mean curvature: hollows blue, ridges red",
    "error": "distance to a reference cloud, small pale and large dark",
    "color": "the surface's own colour, unlit",
}


@dataclass(frozen=True)
class ShadeOptions(Settings):
    """Settings of `shade`; each one matters only to the shadings it names."""

    shadows: bool = setting(False, "lambert: soft shadows, traced in the field")
    occlusion: bool = setting(False, "lambert: darker hollows (ambient occlusion), traced in the field")
    light_level: int | None = setting(0, "level in which shadows and occlusion are traced; none: the one shown")
    softness: float = setting(0.15, "how fast shadows blur with the distance they fall; 0.001 is sharp", above=0)
    reach: float = setting(0.12, "how far around a point occlusion looks, in units of the field", above=0)
    clay: tuple[float, float, float] = _share((0.80, 0.78, 0.74), "r g b of a surface without colours, in [0, 1]")
    back_faces: bool = setting(False, "tint what is seen from behind, so that holes and wrong normals show")
    detail: float = setting(4e-3, "curvature: how wide a patch it is measured on, in units of the field", above=0)
    limits: tuple[float, float] | None = setting(None, "values at the ends of the colour map; none: fitted")
    quantile: float = setting(0.95, "share of pixels within fitted limits (curvature, error)", above=0, at_most=1)
    relief: float = _share(0.35, "shading of the colours of curvature and error by a headlight")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError(f"limits: {self.limits}; expected two numbers, the smaller first")
