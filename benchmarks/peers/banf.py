"""BANF: band-limited neural fields (Shabanov et al. 2024), a cascade of networks evaluated at grid vertices only.

The values of a network at the vertices of a grid, interpolated linearly, hold no frequency that the grid cannot. So
each level's network is evaluated only there. Level k of the cascade is the sum of the first k + 1 interpolants.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from mplicits.neural_fields.backend.errors import at_least, positive
from mplicits.neural_fields.fields.field import Field, Jet, OneLevelField
from torch import Tensor, nn

from .trilinear import Place, interpolate, interpolate_jet, locate, vertices


class BandLimited(OneLevelField):
    """A field's trilinear interpolant on a cubic grid; outside its cube, the value at the cube's nearest point.

    Args:
        field: asked at vertices only; three-dimensional.
        resolution: cells along a side.
        extent: half-edge of the cube.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere
        >>> from benchmarks.peers import BandLimited
        >>> coarse = BandLimited(Sphere(radius=0.5), 2, extent=1.0)  # vertices at −1, 0 and 1
        >>> coarse.value(torch.tensor([[0.5, 0.0, 0.0]]))  # halfway between −0.5 and 0.5
        tensor([0.])
    """

    defined_by = ("resolution", "extent")

    def __init__(self, field: Field, resolution: int, *, extent: float = 1.05) -> None:
        super().__init__()
        if field.in_dim != 3:
            raise ValueError(f"field.in_dim={field.in_dim}: expected 3")
        at_least(1, resolution=resolution)
        positive(extent=extent)
        self.field, self.resolution, self.extent = field, resolution, float(extent)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.resolve_level(level)
        place = locate(self.check_points(x).reshape(-1, 3), self.resolution, self.extent)
        return interpolate(self._corners(place), place.within)[:, 0].reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the network's own gradient has no part in it."""
        self.resolve_level(level)
        place = locate(self.check_points(x).reshape(-1, 3), self.resolution, self.extent)
        value, gradient = interpolate_jet(self._corners(place), place)
        return Jet(value.reshape(x.shape[:-1]), gradient.reshape(x.shape), x.new_empty(*x.shape[:-1], 0))

    def _corners(self, place: Place) -> Tensor:
        """The field at the vertices of cells, ``(N, 2, 2, 2, 1)``; a vertex that cells share is evaluated once."""
        i, j, k = vertices(place.cell)
        side = self.resolution + 1
        keys, index = torch.unique((i * side + j) * side + k, return_inverse=True)
        at = torch.stack((keys // side**2, keys // side % side, keys % side), dim=1)
        values = self.field.value(at.to(place.within.dtype) * (2 * self.extent / self.resolution) - self.extent)
        return nn.functional.embedding(index, values[:, None])


class BanfSDF(Field):
    """The sum of interpolants on finer and finer grids.

    Finer levels change the field everywhere, not in a band: the half-widths ``deltas`` are infinite, so the band of
    each level is all of space, and consumers conclude nothing from a coarse level about a finer one.

    Args:
        networks: one per level; the first says a distance, the others what is missing.
        resolutions: cells along a side of each grid, coarse to fine; 32, 64, 128 and 256 in the paper.
        extent: half-edge of the cube that the grids cover.

    Raises:
        ValueError: no networks, or not as many as resolutions, or an argument is out of range.
    """

    def __init__(self, networks: Sequence[Field], resolutions: Sequence[int], *, extent: float = 1.05) -> None:
        super().__init__()
        if not networks or len(networks) != len(resolutions):
            raise ValueError(
                f"resolutions has {len(resolutions)} entries for {len(networks)} networks; "
                "expected one for each, and ≥ 1"
            )
        pairs = zip(networks, resolutions, strict=True)
        self.levels = nn.ModuleList(BandLimited(network, resolution, extent=extent) for network, resolution in pairs)
        self.in_dim, self.num_levels = 3, len(self.levels)
        self.register_buffer("deltas", torch.full((self.num_levels - 1,), torch.inf), persistent=False)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.level_values(x, level=level)[-1]

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`."""
        return list(itertools.accumulate(part.value(self.check_points(x)) for part in self._parts(level)))

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        value, gradient = torch.zeros_like(self.check_points(x)[..., 0]), torch.zeros_like(x)
        for part in self._parts(level):
            jet = part.jet(x)
            value, gradient = value + jet.value, gradient + jet.gradient
        return Jet(value, gradient, x.new_empty(*x.shape[:-1], 0))

    def _parts(self, level: int) -> Iterator[Field]:
        """The interpolants that make up a level."""
        for part in self.levels[: self.resolve_level(level) + 1]:
            assert isinstance(part, Field)
            yield part
