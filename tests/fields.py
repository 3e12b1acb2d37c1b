"""One table of fields that the contract tests, and every consumer's tests, run over."""

from collections.abc import Callable

import torch
from mplicits.neural_fields import (
    Box,
    Capsule,
    Difference,
    Field,
    FunctionField,
    Intersection,
    Jet,
    Moving,
    MultiscaleSDF,
    Offset,
    Plane,
    RigidMotion,
    Shell,
    Similarity,
    Siren,
    SpaceTimeSDF,
    Sphere,
    TimeSlice,
    Torus,
    Union,
)
from mplicits.neural_fields.fields.csg import Bounded, Placed
from mplicits.neural_fields.fields.field import SecondJet
from mplicits.neural_fields.networks.encoded import EncodedField
from mplicits.neural_fields.networks.grids import HashEncoding
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.neural_fields.spacetime.moving import Keyframes, ShrinkingSphere
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from torch import Tensor

from benchmarks.motion.figures import DeformingField, Twisting
from benchmarks.peers import BaconSDF, BandLimited, BanfSDF, HashGridSDF


def small_multiscale(taper: float = 0.0) -> MultiscaleSDF:
    """Three untrained levels whose bands cut the unit cube into parts of comparable size."""
    return MultiscaleSDF.from_widths(
        [(16, 2), (24, 2), (32, 1)],
        omegas=[3, 5, 8],
        deltas=[0.3, 0.2],
        taper=taper,
        num_features=2,
        residual_gain=1.0,
    )


def two_levels() -> MultiscaleSDF:
    """Level 1 refines a closed form, by a lot."""
    return MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0)], [0.1], taper=0.3)


def small_spacetime(taper: float = 0.0) -> SpaceTimeSDF:
    """`small_multiscale` in space-time."""
    return SpaceTimeSDF.from_widths(
        [(16, 2), (24, 2), (32, 1)],
        omegas=[3, 5, 8],
        deltas=[0.3, 0.2],
        taper=taper,
        num_features=2,
        residual_gain=1.0,
    )


def small_hash_grid() -> HashGridSDF:
    """A dense level and a hashed one, with entries large enough to show, around a sphere."""
    field = HashGridSDF(levels=2, table_size=512, coarsest=4, finest=16, width=16, radius=0.5)
    for table in field.tables:
        torch.nn.init.uniform_(table, -0.2, 0.2)
    return field


def small_encoded() -> EncodedField:
    """Features of a network, and of a dense and a hashed grid whose entries are large enough to show."""
    field = EncodedField(small_multiscale(0.4), HashEncoding(levels=2, table_size=512, coarsest=4, finest=16), gain=2.0)
    torch.nn.init.uniform_(field.grid.table, -0.2, 0.2)
    return field


class Watched(Field):
    """A field that remembers at which points it was asked, for values or for jets."""

    def __init__(self, inner: Field) -> None:
        super().__init__()
        self.inner, self.in_dim, self.num_levels = inner, inner.in_dim, inner.num_levels
        self.register_buffer("deltas", inner.deltas)
        self.values: list[Tensor] = []
        self.jets: list[Tensor] = []

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        self.values.append(x)
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        self.jets.append(x)
        return self.inner.jet(x, level=level)

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        self.jets.append(x)
        return self.inner.second_jet(x, level=level, dims=dims)

    def counts(self) -> tuple[int, int]:
        """How many points so far, for values and for jets."""
        values, jets = (sum(x.shape[:-1].numel() for x in asked) for asked in (self.values, self.jets))
        return values, jets


class Scaled(Field):
    """``factor · f``, whose gradient is not of unit length."""

    def __init__(self, inner: Field, factor: float) -> None:
        super().__init__()
        self.inner, self.factor, self.in_dim, self.num_levels = inner, factor, inner.in_dim, inner.num_levels
        self.register_buffer("deltas", inner.deltas.clone())

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        return self.factor * self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        value, gradient, features = self.inner.jet(x, level=level)
        return Jet(self.factor * value, self.factor * gradient, features)


# Turns and travels, about an axis off the origin.
SCREW = RigidMotion(axis=(1.0, 2.0, -1.0), angle=1.5, center=(0.1, -0.2, 0.0), velocity=(0.3, 0.0, -0.2))

FIELDS: dict[str, Callable[[], Field]] = {
    "sphere": lambda: Sphere(radius=0.6, center=(0.1, 0.0, -0.1)),
    "plane": lambda: Plane(normal=(1.0, 2.0, 2.0), offset=0.1),
    "torus": lambda: Torus(major=0.5, minor=0.2),
    "box": lambda: Box(half_size=(0.5, 0.3, 0.4)),
    "capsule": lambda: Capsule(start=(-0.3, 0.0, 0.0), end=(0.3, 0.2, 0.1), radius=0.2),
    "union": lambda: Union(Sphere(radius=0.3, center=(-0.3, 0, 0)), Sphere(radius=0.3, center=(0.3, 0, 0))),
    "union-of-moving": lambda: Union(Moving(Sphere(radius=0.3), SCREW), ShrinkingSphere(radius=0.5, alpha=0.05)),
    "smooth-union": lambda: Union(Sphere(radius=0.4), Box(), Torus(), smooth=0.3),
    "intersection": lambda: Intersection(Sphere(radius=0.6), Box(half_size=(0.5, 0.5, 0.3)), Plane()),
    "difference-of-multiscale": lambda: Difference(small_multiscale(0.4), Sphere(radius=0.4), small_multiscale()),
    "smooth-union-of-multiscale": lambda: Union(two_levels(), small_multiscale(0.4), smooth=0.1),
    "offset": lambda: Offset(small_multiscale(0.4), -0.05),
    "shell": lambda: Shell(small_multiscale(0.4), inside=0.1, outside=0.05),
    "shell-of-moving": lambda: Shell(Moving(small_multiscale(), SCREW), inside=0.1),
    "placed": lambda: Placed(small_multiscale(0.4), Similarity((0.2, 0.1, -0.1), 0.7)),
    "bounded": lambda: Bounded(small_multiscale(0.4), radius=0.8),
    "function": lambda: FunctionField(lambda x: x.norm(dim=-1) - 0.5),
    "siren": lambda: Siren(24, 2, omega=4.0),
    "siren-deep-features": lambda: Siren(16, 4, omega=4.0, num_features=3),
    "siren-one-layer-4d": lambda: Siren(16, 1, omega=4.0, in_dim=4),
    "neus": lambda: NeusSDF(48, 4, num_features=3),
    "bacon": lambda: BaconSDF(12, bands=(1, 1, 2, 2), outputs=(3,)),
    "hash-grid": small_hash_grid,
    "band-limited": lambda: BandLimited(small_hash_grid(), 6),
    "banf": lambda: BanfSDF([Torus(major=0.5, minor=0.2)], [12]),
    "multiscale": small_multiscale,
    "multiscale-tapered": lambda: small_multiscale(0.4),
    "multiscale-over-sphere": two_levels,
    "encoded": small_encoded,
    "spacetime": small_spacetime,
    "spacetime-tapered": lambda: small_spacetime(0.4),
    "slice": lambda: TimeSlice(small_spacetime(0.4), 0.3),
    "slice-at": lambda: small_spacetime().at(0.3),
    "slice-of-moving": lambda: TimeSlice(Moving(Torus(major=0.5, minor=0.2), SCREW), 0.7),
    "deforming": lambda: DeformingField(Torus(major=0.5, minor=0.2), Twisting(angle=0.8, half=2.0)),
    "moving": lambda: Moving(Torus(major=0.5, minor=0.2), SCREW),
    "moving-multiscale": lambda: Moving(small_multiscale(0.4), SCREW),
    "shrinking-sphere": lambda: ShrinkingSphere(radius=0.8, alpha=0.1),
    "growing-sphere-exact-law": lambda: ShrinkingSphere(radius=0.8, alpha=-0.001, exact_law=True),
    "keyframes": lambda: Keyframes([-0.4, 0.1, 0.5], [Sphere(radius=0.3), small_multiscale(0.4), Torus()]),
    "carried-keyframes": lambda: CarriedKeyframes(
        Keyframes([-0.4, 0.1, 0.5], [Sphere(radius=0.3), small_multiscale(0.4), Torus()]),
        VelocitySiren(16, 2, gain=0.5),
    ),
}
EXACT = {
    name: FIELDS[name] for name in ("sphere", "plane", "torus", "box", "capsule", "slice-of-moving")
}  # signed distances everywhere, not only signs
