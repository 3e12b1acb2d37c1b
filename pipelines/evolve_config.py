"""Settings of ``evolve``; every field is a key of the YAML files and a flag of the command line."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["EvolveConfig"]


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


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
        for name in _POSITIVE:
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
_POSITIVE = (
    *("widths", "depths", "omegas", "steps", "learning_rates", "data_weights", "batch", "samples", "near"),
    *("time_gain", "least_delta"),
)
