"""What one step of a training does to the slopes of a field while it moves its values: NeuS's network, SIRENs by depth.

    python -m benchmarks.hosts.slopes --neus path/to/NeuS

Adam's first step at NeuS's rate follows random errors of the values at 256 points in the ball. Root mean squares of
what changes are compared; the quotient is a frequency, in radians per unit, which the eikonal loss has to correct.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from mplicits.neural_fields import MultiscaleSDF, NeuSGeometry, Siren, fit_sphere
from torch import Tensor, nn

from .host_common import in_ball

RATE = 5e-4  # NeuS's
DRAWS, ERRORS, POINTS = 4, 256, 2000
RADIUS, SCALE = 0.35, 0.7  # of the sphere, and of the points, as in docs/drop-in.md
SINES = [(128, 1, 10), (128, 2, 10), (128, 3, 10), (128, 4, 10), (256, 2, 10), (128, 2, 5), (128, 2, 20)]


def moved(network: Any, x: Tensor) -> tuple[float, float]:
    """Root mean squares over ``x`` ``(N, 3)`` of what a step changes: of the values, of the slopes."""
    parameters = list(network.parameters())
    kept = [parameter.detach().clone() for parameter in parameters]
    squares = torch.zeros(2)
    for draw in range(DRAWS):
        generator = torch.Generator().manual_seed(draw)
        at = torch.randperm(len(x), generator=generator)[:ERRORS]
        before = network.sdf(x)[:, 0].detach(), network.gradient(x.clone())[:, 0].detach()
        adam = torch.optim.Adam(parameters, lr=RATE, eps=1e-30)
        adam.zero_grad()
        (network.sdf(x[at])[:, 0] * torch.randn(ERRORS, generator=generator)).sum().backward()
        adam.step()
        after = network.sdf(x)[:, 0].detach(), network.gradient(x.clone())[:, 0].detach()
        squares += torch.stack([(new - old).square().sum() for old, new in zip(before, after, strict=True)])
        with torch.no_grad():
            for parameter, old in zip(parameters, kept, strict=True):
                parameter.copy_(old)
    value, slope = (squares / DRAWS / len(x)).sqrt().tolist()
    return value, slope


def sine_network(width: int, depth: int, omega: float) -> nn.Module:
    """A coarse level in NeuS's shell, begun as a sphere."""
    base = Siren(width, depth, omega=omega, num_features=256)
    fit_sphere(base, radius=RADIUS)
    return NeuSGeometry(MultiscaleSDF(base, [], []), scale=SCALE, learning_rate=RATE)


def main() -> None:
    """Print a row for each network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--neus", type=Path, required=True, help="clone of NeuS")
    sys.path.insert(0, str(parser.parse_args().neus))
    from models.fields import SDFNetwork  # pyright: ignore[reportMissingImports]

    rows: list[tuple[str, Callable[[], nn.Module]]] = [
        ("NeuS", lambda: SDFNetwork(3, 257, 256, 8, skip_in=(4,), multires=6, bias=0.5))
    ]
    rows += [(f"({w}, {d}), omega {o}", lambda w=w, d=d, o=o: sine_network(w, d, o)) for w, d, o in SINES]
    x = in_ball()[:POINTS]
    for label, build in rows:
        torch.manual_seed(0)
        value, slope = moved(build(), x)
        print(f"{label:20} value {value:.3f} slope {slope:.3f} quotient {slope / value:.1f}", flush=True)


if __name__ == "__main__":
    main()
