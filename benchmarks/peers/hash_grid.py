"""Instant-NGP's multiresolution hash encoding with its small network (Müller et al. 2022), in plain PyTorch.

What `HashEncoding` says of grids and tables holds here too; a small network reads the features of all levels, and both
have derivatives in closed form.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from mplicits.neural_fields.backend.errors import at_least, positive
from mplicits.neural_fields.fields.field import Jet, OneLevelField
from mplicits.neural_fields.networks.grids import INITIAL, check_table, grid_resolutions, spatial_hash
from torch import Tensor, nn

from .trilinear import Place, interpolate, interpolate_jet, locate, vertices


class HashGridSDF(OneLevelField):
    """A signed distance read by a ReLU network from interpolated grids.

    The field is continuous; its gradient jumps at the faces of cells and at the creases of the network. Outside the
    cube features are those at the cube's nearest point.

    Args:
        levels: grids, L in the paper.
        table_size: most entries of a level, T; a power of two.
        features: numbers per entry, F.
        coarsest: cells along a side of the first grid, N_min.
        finest: cells along a side of the last grid, N_max.
        width: neurons per hidden layer.
        depth: hidden layers.
        extent: half-edge of the cube that the grids cover.
        radius: of a sphere whose distance is added, so that the field begins as one; None adds nothing, as published.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> from benchmarks.peers import HashGridSDF
        >>> sum(p.numel() for p in HashGridSDF(levels=3, finest=382).parameters())
        2049153
    """

    defined_by = ("resolutions", "table_size", "extent", "radius")

    def __init__(
        self,
        *,
        levels: int = 16,
        table_size: int = 1 << 19,
        features: int = 2,
        coarsest: int = 16,
        finest: int = 2048,
        width: int = 64,
        depth: int = 2,
        extent: float = 1.05,
        radius: float | None = None,
    ) -> None:
        super().__init__()
        at_least(1, levels=levels, features=features, width=width, depth=depth)
        check_table(table_size, coarsest, finest)
        positive(extent=extent)
        self.table_size, self.extent, self.radius = table_size, float(extent), radius
        self.resolutions = grid_resolutions(levels, coarsest, finest)
        sizes = [min((resolution + 1) ** 3, table_size) for resolution in self.resolutions]
        self.tables = nn.ParameterList(torch.empty(size, features).uniform_(-INITIAL, INITIAL) for size in sizes)
        widths = [levels * features, *[width] * depth, 1]
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        features = []
        for resolution, table in zip(self.resolutions, self.tables, strict=True):
            place = locate(rows, resolution, self.extent)
            features.append(interpolate(self._entries(table, place, resolution), place.within))
        output, _ = self._read(torch.cat(features, dim=1))
        return (output + self._sphere(rows)[0]).reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; one sweep back through the network, then the slopes of the interpolation."""
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        features, slopes = [], []
        for resolution, table in zip(self.resolutions, self.tables, strict=True):
            place = locate(rows, resolution, self.extent)
            feature, slope = interpolate_jet(self._entries(table, place, resolution), place)
            features.append(feature)
            slopes.append(slope)
        output, active = self._read(torch.cat(features, dim=1))
        *hidden, last = self.linear()
        g = last.weight.expand(len(rows), -1)
        for layer, mask in zip(reversed(hidden), reversed(active), strict=True):
            g = (g * mask) @ layer.weight
        sphere, outward = self._sphere(rows)
        gradient = (g[:, None] @ torch.cat(slopes, dim=1))[:, 0] + outward
        return Jet((output + sphere).reshape(x.shape[:-1]), gradient.reshape(x.shape), x.new_empty(*x.shape[:-1], 0))

    def _entries(self, table: Tensor, place: Place, resolution: int) -> Tensor:
        """The table's entries at the vertices of cells, ``(N, 2, 2, 2, F)``."""
        i, j, k = vertices(place.cell)
        if (resolution + 1) ** 3 <= self.table_size:
            index = (i * (resolution + 1) + j) * (resolution + 1) + k
        else:
            index = spatial_hash(i, j, k, self.table_size)
        return nn.functional.embedding(index, table)

    def _read(self, features: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The network's output ``(N,)``, and which neurons of each hidden layer are active ``(N, width)``."""
        *hidden, last = self.linear()
        h, active = features, []
        for layer in hidden:
            z = layer(h)
            active.append((z > 0).to(z.dtype))
            h = z.relu()
        return last(h)[:, 0], active

    def linear(self) -> list[nn.Linear]:
        """The layers of the network, first to last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def _sphere(self, x: Tensor) -> tuple[Tensor | float, Tensor | float]:
        """Distance to the sphere that is added ``(N,)``, and its gradient ``(N, 3)``; both 0 where there is none."""
        if self.radius is None:
            return 0.0, 0.0
        length = x.norm(dim=1)
        return length - self.radius, x / length.clamp(min=torch.finfo(x.dtype).tiny)[:, None]
