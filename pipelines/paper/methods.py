"""All methods, in the order of the tables' rows."""

from __future__ import annotations

from ..config import closest
from .ablations import DeltaFactor, LossWeights
from .isolation import Isolation
from .method import Method
from .ours import Ours
from .peers import FromRecipe, Poisson
from .recipes_grids import BanfRecipe, InstantNgpRecipe
from .recipes_networks import BaconRecipe, IdfRecipe, SirenRecipe
from .speed_tables import MarchingCubes, Normals

__all__ = ["METHODS", "method_named"]

# The first ones are those of `names.METHODS`; a test holds the two together.
METHODS: tuple[Method, ...] = (
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


def method_named(name: str) -> Method:
    """The method that a cell asks for.

    Raises:
        ValueError: there is none.
    """
    for method in METHODS:
        if method.name == name:
            return method
    raise ValueError(f"method {name!r}: there is none{closest(name, [method.name for method in METHODS])}")
