"""What work costs, predicted: multiply-adds of networks, and of points in units of those.

A prediction only has to be near enough for the first minute of a progress bar, and for a time budget to be shared out:
what is measured on the way corrects it (:mod:`.schedule`). Its unit is the floating-point operation of a matrix
product, of which `machine.speed` measures how many a second this machine does. Of networks, and of sines beside them,
the numbers were fitted to steps of SIRENs of 17 to 162 thousand parameters; of points, to clouds of 10 to 200 thousand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = [
    "Net",
    "Speed",
    "densifying",
    "jets",
    "preparation",
    "queries",
    "reading_seconds",
    "training",
    "values",
    "windings",
]

# FLOPs per parameter and per neuron (a sine, its derivatives, and the memory they go through) of a point:
# a value, a value with its gradient, and these in a training step, forward, backward and Adam.
VALUE, JET, STEP = (2.0, 190.0), (3.7, 400.0), (14.0, 1260.0)
# Of one nearest-neighbour query in a cloud of 10,000 points; it grows with this power of the number of points.
QUERY, QUERY_GROWTH = 180e3, 0.7
WINDING = 330.0  # of one dipole at one point
PREPARED = 1.0e6  # of one point, from its file to the unit sphere
DENSIFIED = 1.2e6  # of one place tried between the points of a sparse cloud
BYTES_PER_SECOND = 2e7  # of a file that is read


@dataclass(frozen=True)
class Speed:
    """What a machine does.

    Attributes:
        cpu: FLOP/s of its CPU, in matrix products.
        device: FLOP/s of the device that trains, likewise.
        step: seconds that a training step takes at least, however small the networks.
    """

    cpu: float
    device: float
    step: float

    def points(self, work: float) -> float:
        """Seconds of work on points, done on the CPU."""
        return work / self.cpu

    def networks(self, work: float, *, steps: int = 0) -> float:
        """Seconds of work of networks, where it is that of ``steps`` training steps."""
        return work / self.device + steps * self.step


@dataclass(frozen=True)
class Net:
    """The size of a network.

    Attributes:
        parameters: weights and biases.
        neurons: of all hidden layers.
    """

    parameters: int
    neurons: int

    @classmethod
    def siren(cls, width: int, depth: int, *, inputs: int = 3) -> Net:
        """A SIREN of ``depth`` sine layers, of one output.

        Example:
            >>> Net.siren(128, 2)  # 3·128 + 128 + 128·128 + 128 + 128 + 1
            Net(parameters=17153, neurons=256)
        """
        return cls((inputs + 1) * width + (depth - 1) * (width + 1) * width + width + 1, width * depth)

    @classmethod
    def about(cls, parameters: int) -> Net:
        """A network of so many parameters and two layers, or thereabouts."""
        return cls(parameters, round(2 * parameters**0.5))


def values(points: float, nets: Sequence[Net]) -> float:
    """FLOPs of values at so many points."""
    return points * _of(nets, VALUE)


def jets(points: float, nets: Sequence[Net]) -> float:
    """FLOPs of values with gradients at so many points."""
    return points * _of(nets, JET)


def training(steps: float, batch: float, nets: Sequence[Net]) -> float:
    """FLOPs of training steps, each on a batch of jets."""
    return steps * batch * _of(nets, STEP)


def queries(count: float, cloud: int) -> float:
    """FLOPs that take as long as so many nearest-neighbour queries in a cloud of ``cloud`` points."""
    return count * QUERY * (max(cloud, 1) / 10_000) ** QUERY_GROWTH


def windings(count: float, dipoles: int) -> float:
    """FLOPs that take as long as winding numbers of so many points."""
    return count * dipoles * WINDING


def preparation(cloud: int) -> float:
    """FLOPs that take as long as the cleaning of a cloud."""
    return cloud * PREPARED


def densifying(places: float) -> float:
    """FLOPs that take as long as looking for the surface at places between the points of a sparse cloud."""
    return places * DENSIFIED


def reading_seconds(size: int) -> float:
    """Seconds to read a file of ``size`` bytes."""
    return size / BYTES_PER_SECOND


def _of(nets: Sequence[Net], cost: tuple[float, float]) -> float:
    return sum(net.parameters * cost[0] + net.neurons * cost[1] for net in nets)
