"""One table of fields that the contract tests, and every consumer's tests, run over."""

from collections.abc import Callable

import mplicits.neural_fields as nf
import torch
from mplicits.neural_fields.fields.csg import Bounded, Placed
from mplicits.neural_fields.fields.field import SecondJet
from mplicits.neural_fields.fields.tiled import Split, Tile, TiledField
from mplicits.neural_fields.networks.encoded import EncodedField
from mplicits.neural_fields.networks.grids import HashEncoding
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.neural_fields.networks.siren import Siren, forward
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from mplicits.neural_fields.tracing.sphere import Hits
from torch import Tensor

from benchmarks.motion.figures import DeformingField, ShrinkingSphere, Twisting
from benchmarks.peers import BaconSDF, BandLimited, BanfSDF, HashGridSDF


def cube(*shape: int, dim: int = 3, dtype: torch.dtype = torch.float64) -> Tensor:
    """Random points of the cube [−1, 1]ᵈ, ``(*shape, d)``."""
    return 2 * torch.rand(*shape, dim, dtype=dtype) - 1


def sphere_depth(origins: Tensor, directions: Tensor, radius: float, center: Tensor | float = 0.0) -> Tensor:
    """Where rays of unit directions enter a sphere; infinite for those that miss it."""
    along = ((center - origins) * directions).sum(dim=-1)
    squared = radius**2 - (origins - center + along[..., None] * directions).square().sum(dim=-1)
    return torch.where(squared > 0, along - squared.clamp(min=0).sqrt(), torch.inf)


def assert_depths(hits: Hits, expected: Tensor | Hits, tolerance: float) -> None:
    """Rays hit where the expected depth is finite, or the expected hits are, and at that depth."""
    if not isinstance(expected, Tensor):
        expected = torch.where(expected.mask, expected.depth, torch.inf)
    assert torch.equal(hits.mask, expected.isfinite())
    assert bool(((hits.depth - expected)[hits.mask].abs() < tolerance).all())


SIZES = [(16, 2), (24, 2), (32, 1)]
SMALL = {"omegas": [3, 5, 8], "deltas": [0.3, 0.2], "num_features": 2, "residual_gain": 1.0}


def small_multiscale(taper: float = 0.0) -> nf.MultiscaleSDF:
    """Three untrained levels whose bands cut the unit cube into parts of comparable size."""
    return nf.MultiscaleSDF.from_widths(SIZES, taper=taper, **SMALL)


def two_levels() -> nf.MultiscaleSDF:
    """Level 1 refines a closed form, by a lot."""
    return nf.MultiscaleSDF(nf.Sphere(radius=0.5), [nf.Siren(16, 2, omega=5.0)], [0.1], taper=0.3)


def small_spacetime(taper: float = 0.0) -> nf.SpaceTimeSDF:
    """`small_multiscale` in space-time."""
    return nf.SpaceTimeSDF.from_widths(SIZES, taper=taper, **SMALL)


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


def small_tiled() -> TiledField:
    """Three tiles of different fields, whose blends and reach show, and one of them inside out."""
    parts = [small_multiscale(0.4), two_levels(), nf.Torus(major=0.5, minor=0.2)]
    signs = (1, -1, 1)
    tiles = [
        Tile(part, nf.Similarity((0.3 * k - 0.3, 0.1, 0.0), 0.9), sign)
        for k, (part, sign) in enumerate(zip(parts, signs, strict=True))
    ]
    splits = [Split(0, -0.2, 0.3, -1, 1), Split(1, 0.1, 0.2, -2, -3)]
    return TiledField(tiles.__getitem__, splits, deltas=(0.2, 0.1), reach=0.4, gap=0.05)


class Watched(nf.Field):
    """A field that records the points of its evaluations, of values and of jets."""

    def __init__(self, inner: nf.Field) -> None:
        super().__init__()
        self.inner, self.in_dim, self.num_levels = inner, inner.in_dim, inner.num_levels
        self.register_buffer("deltas", inner.deltas)
        self.values: list[Tensor] = []
        self.jets: list[Tensor] = []

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        self.values.append(x)
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> nf.Jet:
        self.jets.append(x)
        return self.inner.jet(x, level=level)

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        self.jets.append(x)
        return self.inner.second_jet(x, level=level, dims=dims)

    def counts(self) -> tuple[int, int]:
        return sum(x[..., 0].numel() for x in self.values), sum(x[..., 0].numel() for x in self.jets)


class Scaled(nf.Field):
    """``factor · f``, whose gradient is not of unit length."""

    def __init__(self, inner: nf.Field, factor: float) -> None:
        super().__init__()
        self.inner, self.factor, self.in_dim, self.num_levels = inner, factor, inner.in_dim, inner.num_levels
        self.register_buffer("deltas", inner.deltas.clone())

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        return self.factor * self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> nf.Jet:
        value, gradient, features = self.inner.jet(x, level=level)
        return nf.Jet(self.factor * value, self.factor * gradient, features)


# Turns and travels, about an axis off the origin.
SCREW = nf.RigidMotion(axis=(1.0, 2.0, -1.0), angle=1.5, center=(0.1, -0.2, 0.0), velocity=(0.3, 0.0, -0.2))

FIELDS: dict[str, Callable[[], nf.Field]] = {
    "sphere": lambda: nf.Sphere(radius=0.6, center=(0.1, 0.0, -0.1)),
    "plane": lambda: nf.Plane(normal=(1.0, 2.0, 2.0), offset=0.1),
    "torus": lambda: nf.Torus(major=0.5, minor=0.2),
    "box": lambda: nf.Box(half_size=(0.5, 0.3, 0.4)),
    "capsule": lambda: nf.Capsule(start=(-0.3, 0.0, 0.0), end=(0.3, 0.2, 0.1), radius=0.2),
    "union": lambda: nf.Union(nf.Sphere(radius=0.3, center=(-0.3, 0, 0)), nf.Sphere(radius=0.3, center=(0.3, 0, 0))),
    "union-of-moving": lambda: nf.Union(
        nf.Moving(nf.Sphere(radius=0.3), SCREW), ShrinkingSphere(radius=0.5, alpha=0.05)
    ),
    "smooth-union": lambda: nf.Union(nf.Sphere(radius=0.4), nf.Box(), nf.Torus(), smooth=0.3),
    "intersection": lambda: nf.Intersection(nf.Sphere(radius=0.6), nf.Box(half_size=(0.5, 0.5, 0.3)), nf.Plane()),
    "difference-of-multiscale": lambda: nf.Difference(small_multiscale(0.4), nf.Sphere(radius=0.4), small_multiscale()),
    "smooth-union-of-multiscale": lambda: nf.Union(two_levels(), small_multiscale(0.4), smooth=0.1),
    "offset": lambda: nf.Offset(small_multiscale(0.4), -0.05),
    "shell": lambda: nf.Shell(small_multiscale(0.4), inside=0.1, outside=0.05),
    "shell-of-moving": lambda: nf.Shell(nf.Moving(small_multiscale(), SCREW), inside=0.1),
    "placed": lambda: Placed(small_multiscale(0.4), nf.Similarity((0.2, 0.1, -0.1), 0.7)),
    "bounded": lambda: Bounded(small_multiscale(0.4), radius=0.8),
    "tiled": small_tiled,
    "function": lambda: nf.FunctionField(lambda x: x.norm(dim=-1) - 0.5),
    "siren": lambda: nf.Siren(24, 2, omega=4.0),
    "siren-deep-features": lambda: nf.Siren(16, 4, omega=4.0, num_features=3),
    "siren-one-layer-4d": lambda: nf.Siren(16, 1, omega=4.0, in_dim=4),
    "neus": lambda: NeusSDF(48, 4, num_features=3),
    "bacon": lambda: BaconSDF(12, bands=(1, 1, 2, 2), outputs=(3,)),
    "hash-grid": small_hash_grid,
    "band-limited": lambda: BandLimited(small_hash_grid(), 6),
    "banf": lambda: BanfSDF([nf.Torus(major=0.5, minor=0.2)], [12]),
    "multiscale": small_multiscale,
    "multiscale-tapered": lambda: small_multiscale(0.4),
    "multiscale-over-sphere": two_levels,
    "encoded": small_encoded,
    "spacetime": small_spacetime,
    "spacetime-tapered": lambda: small_spacetime(0.4),
    "slice": lambda: nf.TimeSlice(small_spacetime(0.4), 0.3),
    "slice-at": lambda: small_spacetime().at(0.3),
    "slice-of-moving": lambda: nf.TimeSlice(nf.Moving(nf.Torus(major=0.5, minor=0.2), SCREW), 0.7),
    "deforming": lambda: DeformingField(nf.Torus(major=0.5, minor=0.2), Twisting(angle=0.8, half=2.0)),
    "moving": lambda: nf.Moving(nf.Torus(major=0.5, minor=0.2), SCREW),
    "moving-multiscale": lambda: nf.Moving(small_multiscale(0.4), SCREW),
    "shrinking-sphere": lambda: ShrinkingSphere(radius=0.8, alpha=0.1),
    "growing-sphere-exact-law": lambda: ShrinkingSphere(radius=0.8, alpha=-0.001, exact_law=True),
    "keyframes": lambda: Keyframes([-0.4, 0.1, 0.5], [nf.Sphere(radius=0.3), small_multiscale(0.4), nf.Torus()]),
    "carried-keyframes": lambda: CarriedKeyframes(
        Keyframes([-0.4, 0.1, 0.5], [nf.Sphere(radius=0.3), small_multiscale(0.4), nf.Torus()]),
        VelocitySiren(16, 2, gain=0.5),
    ),
}
# Signed distances everywhere, not only signs.
EXACT = {name: FIELDS[name] for name in ("sphere", "plane", "torus", "box", "capsule", "slice-of-moving")}


@torch.no_grad()
def solve_sphere(network: Siren, radius: float = 0.5) -> None:
    """A SIREN of units 1 becomes |x| − radius on the unit ball by one linear solve, and no random numbers.

    The first layer is scaled to low phases. The output's weights w and bias b minimise the sum over n points of
    (w·h(x) + b − |x| + r)² + 0.1 |Jᵀw − x / |x||², and 1e-6 n |w|². Here h are the last sines, and J is their Jacobian.
    At (128, 4) and ω₀ = 10 the values are off by 0.01 and the slopes by 0.1.
    """
    first, width, generator = network.layers[0], network.width, torch.Generator().manual_seed(0)
    first.weight.mul_(1.7 / (3**0.5 * network.omega) / first.weight.double().square().mean().sqrt())
    direction = torch.randn(8 * (width + 1), network.in_dim, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(direction, dim=1)
    lengths = 1.05 * torch.rand(len(direction), 1, generator=generator, dtype=torch.float64).sqrt()
    direction, lengths = direction.to(first.weight.device), lengths.to(first.weight.device)
    parameters = network.folded()
    _, sines, phases = forward((direction * lengths).to(first.weight), parameters)
    tangents = torch.eye(network.in_dim).to(first.weight)[:, None]
    for weight, phase in zip(parameters[0:-2:2], phases, strict=True):
        tangents = (tangents @ weight.t()) * phase.cos()
    slopes = torch.nn.functional.pad(tangents.double(), (0, 1))  # of the bias: 0
    rows = torch.cat((torch.nn.functional.pad(sines[-1].double(), (0, 1), value=1.0), *0.1**0.5 * slopes))
    target = torch.cat((lengths[:, 0] - radius, *(0.1**0.5 * direction.t())))
    damping = torch.full((width + 1,), 1e-6 * len(lengths), dtype=rows.dtype, device=rows.device)
    damping[-1] = 0  # the bias is not damped
    solved = torch.linalg.solve(rows.t() @ rows + damping.diag(), rows.t() @ target).to(first.weight)
    network.output.weight[0], network.output.bias[0] = solved[:-1], solved[-1]
