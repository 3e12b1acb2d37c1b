"""A lattice of cells over a box, and a field sampled at its points: the mesher's only way to the field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..fields.field import Field

__all__ = ["Bounds", "Lattice", "Progress", "Sampler"]

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Lattice:
    """Cubic cells of edge ``step`` from ``low`` upwards; ``shape`` counts cells, so there are ``shape + 1`` points."""

    low: tuple[float, float, float]
    step: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, bounds: Bounds, resolution: int) -> Lattice:
        """The lattice with ``resolution`` cells along the longest axis of a box; other axes round up to whole cells.

        Raises:
            ValueError: the box is empty or not finite, or there are fewer than two cells.
        """
        low, high = (np.asarray(corner, np.float64) for corner in bounds)
        if low.shape != (3,) or high.shape != (3,) or not np.isfinite([low, high]).all() or not (low < high).all():
            raise ValueError(
                f"bounds={bounds}: expected two corners of three finite numbers, the first below the second"
            )
        if resolution < 2:
            raise ValueError(f"resolution={resolution}: expected at least 2 cells along the longest axis")
        step = float((high - low).max()) / resolution
        # A millionth of a cell is rounding, not a reason for another layer.
        x, y, z = (max(1, math.ceil(extent / step - 1e-6)) for extent in high - low)
        return cls((float(low[0]), float(low[1]), float(low[2])), step, (x, y, z))

    def positions(self, index: NDArray[np.integer] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of points ``(N, 3)`` counted in cells, whole or not."""
        return np.asarray(index, np.float64) * self.step + np.asarray(self.low)

    def __str__(self) -> str:
        """The box, for messages."""
        high = self.positions(np.asarray(self.shape))
        return " × ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(self.low, high, strict=True))


class Sampler:
    """Evaluates a field in batches, checks what comes back, and counts.

    Args:
        field: what is sampled, on the device and in the dtype of its first parameter (or of ``deltas``).
        lattice: where.
        batch: rows per call of the field.
        progress: told ``(stage, done, total)`` after every batch.

    Attributes:
        counts: points sent to each level so far.
    """

    def __init__(self, field: Field, lattice: Lattice, batch: int, progress: Progress | None = None) -> None:
        self.field, self.lattice, self.batch, self.progress = field, lattice, batch, progress
        self.counts = [0] * field.num_levels
        self._like = field.like

    def _points(self, positions: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(positions).to(self._like)

    @torch.inference_mode()
    def values(
        self, count: int, points: Callable[[slice], NDArray[np.integer]], *, level: int, stage: str
    ) -> NDArray[np.floating]:
        """Values at ``count`` lattice points → ``(count,)``, in the field's dtype.

        ``points`` gives a part of them, ``(n, 3)``, when it is needed, so that they never exist all at once.

        Raises:
            ValueError: the field gave NaN or an infinity.
        """
        parts = [np.empty(0, np.float32)]
        for start in range(0, count, self.batch):
            positions = self.lattice.positions(points(slice(start, start + self.batch)))
            part = self.field.value(self._points(positions), level=level).cpu().numpy()
            self._check(part, positions, level)
            self._report(level, stage, start + len(part), count, len(part))
            parts.append(part)
        return np.concatenate(parts[1:] or parts)

    @torch.inference_mode()
    def jets(
        self, positions: NDArray[np.float64], *, level: int, stage: str
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Values ``(N,)`` and gradients ``(N, 3)`` at any positions ``(N, 3)``.

        Raises:
            ValueError: the field gave NaN or an infinity.
        """
        values = [np.empty(0, np.float32)]
        gradients = [np.empty((0, 3), np.float32)]
        for start in range(0, len(positions), self.batch):
            batch = positions[start : start + self.batch]
            jet = self.field.jet(self._points(batch), level=level)
            values.append(jet.value.cpu().numpy())
            gradients.append(jet.gradient.cpu().numpy())
            self._check(values[-1] + gradients[-1].sum(axis=1), batch, level)
            self._report(level, stage, start + len(batch), len(positions), len(batch))
        return np.concatenate(values[1:] or values), np.concatenate(gradients[1:] or gradients)

    def _check(self, values: NDArray[np.floating], positions: NDArray[np.float64], level: int) -> None:
        bad = ~np.isfinite(values)
        if bad.any():
            where = ", ".join(f"{c:.4g}" for c in positions[bad.argmax()])
            raise ValueError(
                f"field: level {level} is not finite at {bad.sum()} of {len(values)} points, first at ({where}); "
                "its parameters have probably diverged"
            )

    def _report(self, level: int, stage: str, done: int, total: int, count: int) -> None:
        self.counts[level] += count
        if self.progress is not None:
            self.progress(stage, done, total)
