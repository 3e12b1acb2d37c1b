"""Settings of ``fit``; every field is a key of the YAML presets and a flag of the command line.

Settings of ``texture``; every field is a key of the YAML presets and a flag of the command line.

Settings of ``reconstruct``; every field is a key of the YAML presets and a flag of the command line.

Settings of ``evolve``; every field is a key of the YAML files and a flag of the command line.

The shadings by name, and their settings; nothing heavy is imported, so that ``--help`` stays quick.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["SHADINGS", "EvolveConfig", "FitConfig", "ReconstructConfig", "ShadeOptions", "TextureConfig"]


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class FitConfig:
    """Settings of ``fit``; the defaults are the ``default`` preset.

    Raises:
        ValueError: lists of different lengths, or a number out of range; the message names the field.
    """

    widths: tuple[int, ...] = _setting((128, 256, 400), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _setting((2, 2, 2), "sine layers, one number per level")
    omegas: tuple[float, ...] = _setting((30.0, 80.0, 160.0), "SIREN frequency of each level (Eq. 2)")
    steps: tuple[int, ...] = _setting((1200, 800, 600), "training steps, one number per level")
    learning_rates: tuple[float, ...] = _setting((4e-3, 5e-4, 3e-4), "peak learning rate of each level")
    batch: int = _setting(8192, "samples per training step")
    levels: int | None = _setting(None, "train only this many levels, coarse to fine")
    data_weight: float = _setting(1e4, "level 0's weight of (f(x) - d)^2 where the distance d is known (Eq. 4)")
    residual_data_weight: float = _setting(
        1.0,
        "the other levels' weight of (f(x) - d)^2, in units of the mean square error of the level before, or of the "
        "variance of the noise that was smoothed off if that is larger",
    )
    normal_weight: float = _setting(300.0, "weight of 1 - cos(grad f, N) where the normal N is known (Eq. 4)")
    eikonal_weight: float = _setting(50.0, "weight of (|grad f| - 1)^2 (Eq. 4)")
    domain_weight: float = _setting(0.1, "factor on data_weight for level 0's distances away from the cloud")
    epsilon: float = _setting(0.3, "margin of the bands (Eq. 5)")
    quantile: float | None = _setting(
        None, "quantile of |f(x_j)| that a band must hold; 1 is the maximum of Eq. 5, none the maximum but for strays"
    )
    samples: int = _setting(400_000, "samples made per level and kind, drawn from at every step")
    normals: Literal["auto", "file", "estimate"] = _setting("auto", "where normals come from: auto, file or estimate")
    sensor_origin: tuple[float, float, float] | None = _setting(
        None, "x y z of the sensor, in input units: estimated normals face it"
    )
    isolation: float | None = _setting(
        30.0, "drop lone points whose 8th neighbour is this many times further away than is usual; none keeps them"
    )
    merge_above: int | None = _setting(
        1_000_000, "clouds of more points are merged, as they are read, to at most so many means of voxels; none: never"
    )
    drop_outliers: bool = _setting(
        True, "drop points that belong to no surface, by their neighbours and after level 0 by how far it passes them"
    )
    turn_normals: bool = _setting(
        True, "turn single normals round that point the other way than their neighbours' (not with --normals file)"
    )
    smooth_noise: bool = _setting(
        True, "move points along their normals to where their neighbours agree, if there is more noise than spacing"
    )
    time_budget: float | None = _setting(None, "end training after about this many seconds, all levels together")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        count = len(self.widths)
        if count == 0:
            raise ValueError("widths: expected at least one level")
        for name in ("depths", "omegas", "steps", "learning_rates"):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name}: {len(getattr(self, name))} entries for {count} widths; expected one for each"
                )
        for name in ("widths", "depths", "omegas", "steps", "learning_rates"):
            if min(getattr(self, name)) <= 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected numbers > 0")
        for name in ("batch", "samples", "epsilon", "time_budget", "merge_above"):
            number = getattr(self, name)
            if number is not None and number <= 0:
                raise ValueError(f"{name}: {number}; expected > 0")
        for name in ("data_weight", "residual_data_weight", "normal_weight", "eikonal_weight", "domain_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected ≥ 0")
        if self.isolation is not None and not self.isolation > 1:
            raise ValueError(f"isolation: {self.isolation}; expected a factor > 1, or none")
        if self.quantile is not None and not 0 < self.quantile <= 1:
            raise ValueError(f"quantile: {self.quantile}; expected a number in (0, 1]")
        if self.levels is not None and not 1 <= self.levels <= count:
            raise ValueError(f"levels: {self.levels}; expected 1 to {count}, the number of widths")

    @property
    def num_levels(self) -> int:
        """How many levels are trained."""
        return len(self.widths) if self.levels is None else self.levels

    def data_weight_after(self, mean_square: float, noise: float) -> float:
        """Weight of (f(x) − d)² at a level whose predecessor misses the points by this mean square.

        Errors shrink from level to level, their squares twice as fast, and angles hardly: a fixed weight would leave
        the finest level to its normals alone, and noise to the distances. In units of the error before, the balance
        stays what it was. Smoothed noise leaves waves behind, which the level before follows all too closely: its
        error is taken for no smaller than that ``noise``.
        """
        return self.residual_data_weight / max(mean_square, noise**2, 1e-10)

    def share_of_time(self, level: int) -> float:
        """The part of a time budget left before ``level`` that this level may use, by the cost of its steps."""
        cost = [
            steps * (width**2 * depth + 4096)
            for steps, width, depth in zip(self.steps, self.widths, self.depths, strict=True)
        ]
        return cost[level] / sum(cost[level : self.num_levels])


@dataclass(frozen=True)
class TextureConfig:
    """Settings of ``texture``; the defaults are the ``default`` preset.

    Raises:
        ValueError: a number out of range; the message names the field.
    """

    width: int = _setting(256, "neurons per layer")
    depth: int = _setting(3, "sine layers")
    omega: float = _setting(60.0, "SIREN frequency: higher takes up finer detail, and more of the noise")
    steps: int = _setting(500, "training steps")
    learning_rate: float = _setting(5e-4, "peak learning rate")
    batch: int = _setting(8192, "points with colours per training step")
    band_batch: int = _setting(2048, "points of the band per training step")
    tangential_weight: float = _setting(0.3, "weight of the change of colour along the normals")
    samples: int = _setting(400_000, "points sampled on a mesh, and half as many in the band, drawn from at every step")
    delta: float | None = _setting(
        None, "half-width of the band in units of the field; none is that of the coarsest level, but at least 0.02"
    )
    time_budget: float | None = _setting(None, "end training after about this many seconds")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        for name in ("width", "depth", "omega", "steps", "learning_rate", "batch", "band_batch", "samples"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected > 0")
        for name in ("delta", "time_budget"):
            number = getattr(self, name)
            if number is not None and not number > 0:
                raise ValueError(f"{name}: {number}; expected > 0, or none")
        if self.tangential_weight < 0:
            raise ValueError(f"tangential_weight: {self.tangential_weight}; expected ≥ 0")


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of ``reconstruct``; the defaults are the ``default`` preset.

    Raises:
        ValueError: lists of different lengths, or a number out of range; the message names the field.
    """

    geometry: Literal["multiscale", "neus"] = _setting(
        "multiscale", "multiscale (a coarse SIREN and residuals in bands) or neus (the 8 x 256 softplus network)"
    )
    widths: tuple[int, ...] = _setting((128, 256), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _setting((4, 5), "sine layers, one number per level")
    omegas: tuple[float, ...] = _setting((10.0, 25.0), "SIREN frequency of each level (Eq. 2)")
    starts: tuple[float, ...] = _setting((0.0, 0.25), "when each level is switched on, as shares of the training")
    features: int = _setting(32, "appearance features of every level of the multiscale geometry")
    taper: float = _setting(0.3, "share of a band over which the next level fades out")
    band: float = _setting(4.0, "half-width of the bands in units of the surface's uncertainty 1/s")
    least_delta: float = _setting(0.02, "half-width that a band keeps, in units of the region's radius")
    radius: float = _setting(0.5, "of the sphere that the geometry begins as, in units of the region's radius")
    color_width: int = _setting(256, "neurons per layer of the colour network")
    color_depth: int = _setting(4, "layers of the colour network")
    color_frequencies: int = _setting(6, "octaves of the position that the colour network sees; NeuS has 0")
    background: Literal["auto", "black", "white", "outside"] = _setting(
        "auto", "what is behind the object: black, white, or a learnt outside; auto is white with masks, else outside"
    )
    steps: int = _setting(5000, "training steps")
    rays: int = _setting(256, "rays per training step")
    uniform: int = _setting(32, "evenly spaced samples per ray")
    importance: int = _setting(32, "samples per ray near the surface")
    texture_steps: int = _setting(500, "training steps of the texture of the finished surface; 0 leaves it uncoloured")
    learning_rate: float = _setting(3e-4, "peak learning rate of the geometry")
    color_rate: float = _setting(6.0, "learning rate of the colours, in units of the geometry's")
    sharpening: float = _setting(8.0, "learning rate of the surface's uncertainty, in units of the others'")
    eikonal_weight: float = _setting(0.05, "weight of (|grad f| - 1)^2")
    mask_weight: float = _setting(0.1, "weight of the masks' cross-entropy, where there are masks")
    anneal: float = _setting(0.2, "share of the training in which slopes are annealed (cos_anneal)")
    least_weight: float = _setting(1e-4, "samples that contribute less to their pixel get no colour")
    width: int | None = _setting(None, "shrink the pictures to this many pixels across before training")
    test_every: int = _setting(8, "every n-th picture is held out and measured; 0 trains on all")
    time_budget: float | None = _setting(None, "end training after about this many seconds")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        count = len(self.widths)
        if count == 0:
            raise ValueError("widths: expected at least one level")
        for name in ("depths", "omegas", "starts"):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name}: {len(getattr(self, name))} entries for {count} widths; expected one for each"
                )
        if self.starts[0] != 0 or any(
            not 0 <= b < 1 or b < a for a, b in zip(self.starts, self.starts[1:], strict=False)
        ):
            raise ValueError(f"starts: {self.starts}; expected 0 first, then growing shares below 1")
        for name in (*("widths", "depths", "omegas"), *_POSITIVE):
            numbers = getattr(self, name)
            if not all(number > 0 for number in (numbers if isinstance(numbers, tuple) else (numbers,))):
                raise ValueError(f"{name}: {numbers}; expected > 0")
        for name in _NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected ≥ 0")
        for name in ("taper", "anneal"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: {getattr(self, name)}; expected a share from 0 to 1")
        for name in ("width", "time_budget"):
            number = getattr(self, name)
            if number is not None and not number > 0:
                raise ValueError(f"{name}: {number}; expected > 0, or none")
        if self.uniform < 2:
            raise ValueError(f"uniform: {self.uniform}; expected at least 2")


_NOT_NEGATIVE = (
    "features",
    "color_frequencies",
    "importance",
    "texture_steps",
    "eikonal_weight",
    "mask_weight",
    "least_weight",
    "test_every",
)
_POSITIVE = (
    "band",
    "least_delta",
    "radius",
    "color_width",
    "color_depth",
    "steps",
    "rays",
    "learning_rate",
    "color_rate",
    "sharpening",
)


@dataclass(frozen=True)
class EvolveConfig:
    """Settings of ``evolve``; the defaults are the ``default`` preset.

    Raises:
        ValueError: lists of different lengths, or a number out of range; the message names the field.
    """

    kind: Literal["morph", "transport", "smooth"] = _setting(
        "morph", "morph (from shape to shape), transport (by a vector field) or smooth (by mean curvature)"
    )
    shapes: tuple[str, ...] = _setting(
        (), "run directories, .safetensors files, or exact shapes such as sphere:0.4@0.2,0,0"
    )
    times: tuple[float, ...] = _setting((), "morph: when each shape is reached, from 0 to 1 (default: evenly spaced)")
    align: Literal["none", "center", "pca"] = _setting(
        "center", "morph: leave the shapes where they are, lay their unit spheres on each other, or turn them as well"
    )
    velocity: tuple[float, ...] = _setting((0.0, 0.0, 0.0), "transport: way per unit of time, three numbers per shape")
    axis: tuple[float, ...] = _setting((0.0, 0.0, 1.0), "transport: axis of rotation, three numbers per shape")
    center: tuple[float, ...] = _setting((0.0, 0.0, 0.0), "transport: a point on the axis, three numbers per shape")
    angle: tuple[float, ...] = _setting((0.0,), "transport: radians per unit of time, one number per shape")
    twist: tuple[float, ...] = _setting((0.0,), "transport: radians more per unit along the axis, one number per shape")
    alpha: float = _setting(0.02, "smooth: how fast; a sphere has r(t)^2 = r^2 - 4 alpha t, in units of the field")
    widths: tuple[int, ...] = _setting((128, 256), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _setting((2, 2), "sine layers, one number per level")
    omegas: tuple[float, ...] = _setting((15.0, 40.0), "SIREN frequency of each level (Eq. 2)")
    steps: tuple[int, ...] = _setting((1000, 500), "training steps, one number per level")
    learning_rates: tuple[float, ...] = _setting((4e-3, 5e-4), "peak learning rate of each level")
    data_weights: tuple[float, ...] = _setting((100.0, 1000.0), "weight of known values and gradients, per level")
    start_steps: int = _setting(300, "steps in which level 0 learns the first shape, before it learns to move")
    batch: int = _setting(4096, "samples per training step: half of them known ones, the others near the surface")
    samples: int = _setting(100_000, "known samples to draw from")
    near: float = _setting(0.1, "half-width of the band in which level 0 obeys the law, in units of the field")
    law_weight: float = _setting(1.0, "weight of the squared error of the normal speed")
    eikonal_weight: float = _setting(0.3, "weight of (|grad f| - 1)^2")
    bound_weight: float = _setting(10.0, "weight of values outside of known bounds")
    length: float = _setting(0.05, "what a known gradient counts beside a known value, as a length")
    time_gain: float = _setting(0.3, "initial weights of the time in a residual level, in units of the usual ones")
    epsilon: float = _setting(0.5, "room in the bands beyond the largest error of the level before (Eq. 5)")
    least_delta: float = _setting(0.01, "half-width that a band has at least, in units of the field")
    frames: int = _setting(21, "times at which the result is checked")
    resolution: int = _setting(96, "cells along each side of the meshes of those checks")
    time_budget: float | None = _setting(None, "end training after about this many seconds")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        self._check_shapes()
        self._check_levels()
        for name in _EVOLVE_POSITIVE:
            numbers = getattr(self, name)
            if not all(number > 0 for number in (numbers if isinstance(numbers, tuple) else (numbers,))):
                raise ValueError(f"{name}: {numbers}; expected > 0")
        for name in ("start_steps", "law_weight", "eikonal_weight", "bound_weight", "length", "epsilon"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected ≥ 0")
        if self.frames < 2 or self.resolution < 16:
            raise ValueError(f"frames: {self.frames}, resolution: {self.resolution}; expected at least 2 and 16")
        if self.time_budget is not None and not self.time_budget > 0:
            raise ValueError(f"time_budget: {self.time_budget}; expected > 0, or none")

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

    def _check_shapes(self) -> None:
        count = len(self.shapes)
        if self.times:
            if len(self.times) != count:
                raise ValueError(f"times: {len(self.times)} numbers for {count} shapes; expected one for each")
            if any(not a < b for a, b in itertools.pairwise(self.times)) or (self.times[0], self.times[-1]) != (0, 1):
                raise ValueError(f"times: {self.times}; expected growing numbers from 0 to 1")
        for name, size in _SIZES.items():
            if len(getattr(self, name)) not in (size, size * max(count, 1)):
                raise ValueError(f"{name}: {len(getattr(self, name))} numbers; expected {size}, or {size} per shape")
        if not all(any(self.per_shape("axis", index)) for index in range(max(count, 1))):
            raise ValueError(f"axis: {self.axis}; expected a vector of non-zero length")

    def _check_levels(self) -> None:
        count = len(self.widths)
        if count == 0:
            raise ValueError("widths: expected at least one level")
        for name in ("depths", "omegas", "steps", "learning_rates", "data_weights"):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name}: {len(getattr(self, name))} entries for {count} widths; expected one for each"
                )


_SIZES = {"velocity": 3, "axis": 3, "center": 3, "angle": 1, "twist": 1}
_EVOLVE_POSITIVE = (
    *("widths", "depths", "omegas", "steps", "learning_rates", "data_weights", "batch", "samples", "near"),
    *("time_gain", "least_delta"),
)


SHADINGS: dict[str, str] = {
    "lambert": "clay, or the surface's own colour, under a lamp above left of the camera",
    "headlight": "clay, or the surface's own colour, under a lamp at the camera",
    "normals": "the normal as a colour, (n + 1) / 2, in world axes",
    "depth": "distance from the camera, near light and far dark",
    "matcap": "the picture of a lit sphere wrapped over the normals",
    "curvature": "mean curvature: hollows blue, ridges red",
    "error": "distance to a reference cloud, small pale and large dark",
    "color": "the surface's own colour, unlit",
}


@dataclass(frozen=True)
class ShadeOptions:
    """Settings of `shade`; each one matters only to the shadings it names.

    Raises:
        ValueError: a number is out of range; the message names the field.
    """

    shadows: bool = _setting(False, "lambert: soft shadows, traced in the field")
    occlusion: bool = _setting(False, "lambert: darker hollows (ambient occlusion), traced in the field")
    light_level: int | None = _setting(
        0, "level in which shadows and occlusion are traced: a coarse one is fast; none is the one shown"
    )
    softness: float = _setting(0.15, "how fast shadows blur with the distance they fall; 0.001 is sharp")
    reach: float = _setting(0.12, "how far around a point occlusion looks, in units of the field")
    clay: tuple[float, float, float] = _setting((0.80, 0.78, 0.74), "r g b of a surface without colours, in [0, 1]")
    back_faces: bool = _setting(False, "tint what is seen from behind, so that holes and wrong normals show")
    detail: float = _setting(4e-3, "curvature: how wide a patch it is measured on, in units of the field")
    matcap: str = _setting("clay", "clay, chrome, or a PNG or JPEG of a sphere that fills it")
    limits: tuple[float, float] | None = _setting(
        None, "values at the ends of the colour map (depth, curvature, error); none fits them to what is seen"
    )
    quantile: float = _setting(0.95, "share of what is seen that fitted limits hold (curvature, error)")
    relief: float = _setting(0.35, "how much a headlight shades the colours of curvature and error, in [0, 1]")

    def __post_init__(self) -> None:
        for name in ("softness", "reach", "detail"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected > 0")
        if len(self.clay) != 3 or not all(0 <= c <= 1 for c in self.clay):
            raise ValueError(f"clay: {self.clay}; expected three numbers in [0, 1]")
        if self.limits is not None and not (len(self.limits) == 2 and self.limits[0] < self.limits[1]):
            raise ValueError(f"limits: {self.limits}; expected two numbers, the smaller first")
        if not 0 < self.quantile <= 1:
            raise ValueError(f"quantile: {self.quantile}; expected a number in (0, 1]")
        if not 0 <= self.relief <= 1:
            raise ValueError(f"relief: {self.relief}; expected a number in [0, 1]")
