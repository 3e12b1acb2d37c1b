"""Fields with a learnt encoding of the position among their features: colour detail that the surface need not carry."""

from __future__ import annotations

import torch
from torch import Tensor

from ..backend.errors import positive
from ..fields.field import FieldLike, Jet, SecondJet, Wrapper, solid
from .grids import HashEncoding


class EncodedField(Wrapper):
    """A three-dimensional field whose features are its own, followed by ``gain · e(x)`` of a hash encoding e.

    A colour network of a NeuS-style host gets positional detail from these features, so that the surface need not bend
    for it: value, gradient, levels and bands stay those of the field.

    Args:
        field: a part of this module.
        grid: the encoding e; one of 24 features over the cube ±1 by default.
        gain: factor on e. Hosts have one rate for all, too low for a table: Instant-NGP (Müller et al. 2022, Sec. 4)
            learns them at 0.01. With 64, entries learn as if at 0.03 beside networks at 5e-4, as Adam's steps have a
            fixed size.

    Raises:
        ValueError: the field is not three-dimensional, or the gain not positive.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import MultiscaleSDF
        >>> from mplicits.neural_fields.networks.encoded import EncodedField
        >>> sdf = MultiscaleSDF.from_widths([(128, 2), (256, 3)], omegas=[10, 20], num_features=8)
        >>> EncodedField(sdf).jet(torch.zeros(5, 3)).features.shape
        torch.Size([5, 32])
    """

    defined_by = ("gain",)

    def __init__(self, field: FieldLike, grid: HashEncoding | None = None, *, gain: float = 64.0) -> None:
        super().__init__()
        positive(gain=gain)
        self.field = solid(field)
        self.gain, self.num_levels = float(gain), self.field.num_levels
        if grid is None:
            grid = HashEncoding()
            with torch.no_grad():  # features begin as small as those of an encoding without a gain
                grid.table.div_(gain)
        self.grid = grid

    def value_features(self, x: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """See `Field.value_features`."""
        value, features = self.field.value_features(x, level=level)
        return value, self._joined(features, x)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        jet = self.field.jet(x, level=level)
        return jet._replace(features=self._joined(jet.features, x))

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`."""
        jet = self.field.second_jet(x, level=level, dims=dims)
        return jet._replace(features=self._joined(jet.features, x))

    def _joined(self, features: Tensor, x: Tensor) -> Tensor:
        return torch.cat((features, self.gain * self.grid(x)), dim=-1)
