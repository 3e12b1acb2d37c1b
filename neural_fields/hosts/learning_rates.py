"""Learning rates for SIRENs in trainers that were made for softplus networks.

In a layer z = ω₀ (W h + b) weights are about ω₀ times smaller than in a softplus layer of the same effect, but Adam
moves every weight by the learning rate. At one rate for both, a SIREN takes steps about ω₀ times as long; at NeuS's
5e-4 its surface breaks while colours are learnt. `parameter_groups` has a rate for each layer. For trainers with one
rate, as NeuS's, `rescale_parameters` keeps the parameters in units in which one rate fits all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from ..backend.errors import positive
from ..fields.field import Field
from ..networks.multiscale import MultiscaleSDF
from ..networks.siren import Siren

# Factors on the rates below, for each level from the coarsest; the last is for all finer levels, one number for all.
Pace = float | Sequence[float]

HOST_RATE = 5e-4  # of Adam for the softplus networks of NeuS, sdfstudio and nerfstudio
SINE_RATE = 3e-3  # of sine layers, divided by ω₀; found beside HOST_RATE
OUTPUT_RATE = 1e-4  # of outputs; found beside HOST_RATE


def parameter_groups(field: Field, lr: float = HOST_RATE, *, pace: Pace = 1.0) -> list[dict[str, Any]]:
    """The parameters of a field as groups for an optimiser: dicts with ``params`` and ``lr``.

    Args:
        field: SIRENs anywhere in it get rates of their own; all else gets ``lr``.
        lr: the host's rate of its own geometry; all rates are in proportion to it.
        pace: share of these rates at which SIRENs learn; see `Pace`.

    Raises:
        ValueError: a rate or a pace is not positive.

    Example:
        >>> from mplicits.neural_fields import MultiscaleSDF
        >>> from mplicits.neural_fields.hosts.learning_rates import parameter_groups
        >>> sdf = MultiscaleSDF.from_widths([(128, 4), (256, 5)], omegas=[10, 30])
        >>> [f"{group['lr']:.1e}" for group in parameter_groups(sdf, 5e-4)]
        ['3.0e-04', '1.0e-04', '1.0e-04', '1.0e-04']
    """
    positive(lr=lr)
    groups, taken = [], set()
    for siren, rates in _siren_rates(field, pace):
        parts = list(siren.layers.parameters()), list(siren.output.parameters())
        for params, rate, unit in zip(parts, rates, siren.units, strict=True):
            groups.append({"params": params, "lr": lr / HOST_RATE * rate / unit})
            taken.update(map(id, params))
    rest = [parameter for parameter in field.parameters() if id(parameter) not in taken]
    return [*groups, {"params": rest, "lr": lr}] if rest else groups


def rescale_parameters(field: Field, lr: float = HOST_RATE, *, pace: Pace = 1.0) -> None:
    """Keep a field's parameters, in place, in units in which one rate suits all; the field stays the same function.

    Units are powers of two (`Siren.set_units`), so values and jets stay the same bit for bit; steps are those of
    `parameter_groups` within a factor of √2. To be called before an optimiser is made.

    Args:
        field: changed in place.
        lr: the host's rate, at the peak of its schedule.
        pace: see `Pace`.

    Raises:
        ValueError: a rate or a pace is not positive.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Siren
        >>> from mplicits.neural_fields.hosts.learning_rates import rescale_parameters
        >>> siren, x = Siren(16, 2, omega=30.0), torch.rand(5, 3)
        >>> before = siren.value(x)
        >>> rescale_parameters(siren, 5e-4)
        >>> siren.units, torch.equal(siren.value(x), before)
        ((0.25, 0.25), True)
    """
    positive(lr=lr)
    for siren, rates in _siren_rates(field, pace):
        sines, output = (2.0 ** round(math.log2(rate / lr)) for rate in rates)
        siren.set_units(sines, output)


def _siren_rates(field: Field, pace: Pace) -> Iterator[tuple[Siren, tuple[float, float]]]:
    """Each SIREN with Adam's rates for its sine layers and for its output."""
    paces = [pace] if isinstance(pace, float | int) else list(pace)
    for share in paces:
        positive(pace=share)
    if not paces:
        raise ValueError("pace: there is none")
    level = {
        part: number
        for module in field.modules()
        if isinstance(module, MultiscaleSDF)
        for number, siren in enumerate(module.levels)
        for part in siren.modules()
    }
    for module in field.modules():
        if isinstance(module, Siren):
            share = paces[min(level.get(module, 0), len(paces) - 1)]
            yield module, (share * SINE_RATE / module.omega, share * OUTPUT_RATE)
