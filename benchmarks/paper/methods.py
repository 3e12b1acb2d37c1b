"""All methods, in the order of the tables' rows."""

from __future__ import annotations

from ..harness.jobs import Method, Registry
from .ablations import DeltaFactor, LossWeights
from .grids import BanfRecipe, InstantNgpRecipe
from .isolation import Isolation
from .jobs import PaperJob
from .judge import protocol_of
from .networks import BaconRecipe, IdfRecipe, SirenRecipe
from .ours import FromRecipe, Ours, Poisson
from .speed import MarchingCubes, Normals

# The first ones are those of `names.METHODS`; a test holds the two together.
METHODS: tuple[Method[PaperJob], ...] = (
    Ours(),
    FromRecipe(SirenRecipe()),
    FromRecipe(InstantNgpRecipe("coarse")),
    FromRecipe(InstantNgpRecipe("fine")),
    FromRecipe(IdfRecipe()),
    FromRecipe(BaconRecipe()),
    FromRecipe(BanfRecipe()),
    Poisson(),
    Poisson(trim=0.01),
    Poisson(smoothed=True),
    Isolation(),
    LossWeights(),
    DeltaFactor(),
    MarchingCubes(),
    Normals(),
)
REGISTRY = Registry(METHODS, lambda job: protocol_of(job.preset).as_dict())
