"""What a level of the fit learns from: the domain for level 0, the band around the level before for the others."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..neural_fields import Field, InputError
from .cloud_distance import CloudDistance
from .run.settings import FitConfig
from .sampling import Samples, Source, band_samples, distance_samples, empty_samples, offset_samples, with_previous

__all__ = ["Weights", "banded_sources", "first_sources", "surface_samples"]

# So few places that the level before gets wrong far from the cloud are not worth a share of the batch.
FEWEST = 32


@dataclass(frozen=True)
class Weights:
    """Weights of the three terms of Eq. 4, as they stand; None is what the fit would take.

    Attributes:
        data: of (f(x) − d)²; the fit's own is `FitConfig.data_weight_after`.
        normal: of 1 − cos(∇f, N).
        eikonal: of (|∇f| − 1)².
    """

    data: float | None = None
    normal: float | None = None
    eikonal: float | None = None

    def resolved(self, config: FitConfig, errors: Tensor, noise: float) -> tuple[float, float, float]:
        """Data, normal and eikonal weight, where the levels before miss the surface samples by ``errors`` ``(n,)``."""
        data = config.data_weight_after(float(errors.square().mean()), noise)
        given = (self.data, self.normal, self.eikonal)
        usual = (data, config.normal_weight, config.eikonal_weight)
        return tuple(u if g is None else g for g, u in zip(given, usual, strict=True))  # pyright: ignore[reportReturnType]


def surface_samples(index: CloudDistance) -> Samples:
    """The cloud itself: distance 0, and its normals."""
    points = torch.from_numpy(index.points)
    return Samples(points, distance=torch.zeros(len(points)), normal=torch.from_numpy(index.normals))


def first_sources(
    index: CloudDistance, config: FitConfig, *, generator: torch.Generator, device: torch.device
) -> list[Source]:
    """Level 0's: the cloud, and distances in the whole domain."""
    domain = distance_samples(index, config.samples, generator=generator).to(device)
    near, far = config.data_weight, config.data_weight * config.domain_weight
    half = config.batch // 2
    return [
        Source("surface", surface_samples(index).to(device), half, near, config.normal_weight, config.eikonal_weight),
        Source("domain", domain, half, far, 0.0, config.eikonal_weight),
    ]


def banded_sources(
    index: CloudDistance,
    previous: Field,
    delta: float,
    config: FitConfig,
    *,
    generator: torch.Generator,
    weights: Weights | None = None,
    name: str = "cloud",
) -> list[Source]:
    """A residual level's: the cloud, its offsets and dithered points, inside the band (Sec. 3.2); and empty places.

    Args:
        index: the cloud.
        previous: the frozen levels.
        delta: half-width of the band around the finest of them.
        config: weights, batch and number of samples.
        generator: draws the samples.
        weights: other weights than the fit's own.
        name: what messages call the cloud.

    Raises:
        InputError: one kind of samples is empty.
    """
    device = previous.like.device
    offset = offset_samples(index, delta, config.samples, generator=generator)
    band = band_samples(index, delta, config.samples, generator=generator)
    kept = {
        kind: with_previous(samples, previous, delta, device=device)
        for kind, samples in (("surface", surface_samples(index)), ("offset", offset), ("band", band))
    }
    for kind, samples in kept.items():
        if not len(samples):
            raise InputError(
                f"{name}: no {kind} samples within {delta:.2g} of the level before; train it longer "
                "(--steps) or widen the band (--epsilon)"
            )
    before = kept["surface"].value
    assert before is not None
    terms = (weights or Weights()).resolved(config, before, index.noise)
    third = config.batch // 3
    sources = [Source(kind, samples, third, *terms) for kind, samples in kept.items()]
    # Of its own generator: a cloud without such places is fitted as if nobody had looked for them.
    own = torch.Generator().manual_seed(generator.initial_seed() + 1)
    empty = empty_samples(index, previous, delta, config.samples, generator=own, device=device)
    if len(empty) >= FEWEST:
        sources.append(Source("empty", empty, third // 4, terms[0], 0.0, 0.0))
    return sources
