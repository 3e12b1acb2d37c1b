"""One table of fields that the contract tests, and every consumer's tests, run over."""

from collections.abc import Callable

from mplicits.neural_fields import Box, Capsule, Field, MultiscaleSDF, Plane, Siren, Sphere, Torus, Union


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


FIELDS: dict[str, Callable[[], Field]] = {
    "sphere": lambda: Sphere(radius=0.6, center=(0.1, 0.0, -0.1)),
    "plane": lambda: Plane(normal=(1.0, 2.0, 2.0), offset=0.1),
    "torus": lambda: Torus(major=0.5, minor=0.2),
    "box": lambda: Box(half_size=(0.5, 0.3, 0.4)),
    "capsule": lambda: Capsule(start=(-0.3, 0.0, 0.0), end=(0.3, 0.2, 0.1), radius=0.2),
    "union": lambda: Union(Sphere(radius=0.3, center=(-0.3, 0, 0)), Sphere(radius=0.3, center=(0.3, 0, 0))),
    "siren": lambda: Siren(24, 2, omega=4.0),
    "siren-deep-features": lambda: Siren(16, 4, omega=4.0, num_features=3),
    "siren-one-layer-4d": lambda: Siren(16, 1, omega=4.0, in_dim=4),
    "multiscale": small_multiscale,
    "multiscale-tapered": lambda: small_multiscale(0.4),
    "multiscale-over-sphere": lambda: MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0)], [0.1], taper=0.3),
}
EXACT = {
    name: FIELDS[name] for name in ("sphere", "plane", "torus", "box", "capsule")
}  # signed distances everywhere, not only signs
