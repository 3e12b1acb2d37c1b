"""Settings of ``fit``; every field is a key of the YAML presets and a flag of the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["FitConfig"]


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
