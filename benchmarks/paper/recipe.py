"""What every peer is: a `Recipe`, which trains fields on a cloud as its own paper says, and what recipes share."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Generic, NamedTuple, TypeVar

import torch
from mplicits.datasets import OrientedCloud
from mplicits.neural_fields import Field
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.samples import DOMAIN
from mplicits.pipelines.training.trainer import Group, Objective, Report, Trainer
from torch import Tensor, nn

from .jobs import Preset

F = TypeVar("F", bound=Field)
S = TypeVar("S")


class Output(NamedTuple):
    """One surface that a method gives.

    Attributes:
        name: as in the tables, e.g. "IDF".
        field: in unit-sphere coordinates, on the CPU.
        level: of the field, whose zero set it is.
        parameters: trained numbers that this level needs.
    """

    name: str
    field: Field
    level: int
    parameters: int


class Trained(NamedTuple):
    """What a recipe returns.

    Attributes:
        outputs: coarse to fine.
        seconds: of sampling and training together.
        steps: optimisation steps, of all stages together.
    """

    outputs: tuple[Output, ...]
    seconds: float
    steps: int


class Recipe(ABC, Generic[S]):
    """A method: its network, its losses, its schedule and its sampling; S is what its settings are.

    Attributes:
        name: as in the command, e.g. "idf".
        source: the paper, and what it says.
        differs: what differs here.
        presets: size and schedule at each preset; what they print as tells two settings apart.
    """

    name: str
    source: str
    differs: str
    presets: Mapping[Preset, S]

    def train(
        self,
        cloud: OrientedCloud,
        preset: Preset,
        *,
        seed: int = 0,
        device: str = "cpu",
        progress: Report | None = None,
    ) -> Trained:
        """Fit the method to a cloud.

        Args:
            cloud: clean oriented points in the unit sphere; all that any method learns from.
            preset: how large and how long.
            seed: of the weights, the samples and the batches.
            device: a torch device.
            progress: called now and then with how far the training is.
        """
        started = time.perf_counter()
        outputs, steps = self.learn(cloud, self.presets[preset], seed=seed, device=device, progress=progress)
        return Trained(outputs, time.perf_counter() - started, steps)

    @abstractmethod
    def learn(
        self, cloud: OrientedCloud, settings: S, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """What `train` does with the settings of its preset → outputs and steps, as in `Trained`."""


def descend(
    parameters: Iterable[nn.Parameter],
    loss: Callable[[int], Tensor],
    *,
    steps: int,
    rate: Callable[[float], float],
    stage: str,
    progress: Report | None = None,
    also: Sequence[tuple[Iterable[nn.Parameter], Callable[[float], float]]] = (),
    clip: float | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
    amsgrad: bool = False,
    report_every: int = 20,
) -> None:
    """Minimise ``loss`` with Adam.

    Args:
        parameters: what is trained.
        loss: of one fresh batch; called with the number of steps done.
        steps: how many.
        rate: learning rate for a schedule done to a fraction in [0, 1).
        stage: name for ``progress``.
        progress: told the loss every ``report_every`` steps and at the end.
        also: more that is trained, with rates of their own.
        clip: largest norm of the whole gradient, or None.
        betas: of Adam.
        eps: of Adam.
        amsgrad: of Adam: second moments never fall.
        report_every: steps between reports; reading the loss makes a GPU wait.
    """
    groups = [Group(list(chosen), schedule) for chosen, schedule in ((parameters, rate), *also)]
    Trainer(_Descent(loss, groups), stage=stage, steps=steps, clip=clip, betas=betas, eps=eps, amsgrad=amsgrad).run(
        report=progress, report_every=report_every
    )


class _Descent(Objective):
    """A loss that draws its own batches."""

    def __init__(self, loss: Callable[[int], Tensor], groups: Sequence[Group]) -> None:
        trained = nn.ParameterList(parameter for group in groups for parameter in group.parameters)
        super().__init__(trained, groups, torch.Generator())
        self.loss = loss

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        total = self.loss(step)
        return {"loss": total}, total


def cosine(first: float, last: float, done: float) -> float:
    """From ``first`` to ``last`` along half a cosine, at a fraction ``done`` in [0, 1]."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * done))


def finished(field: F) -> F:
    """A trained field, frozen and on the CPU."""
    return field.requires_grad_(False).cpu().eval()


class SignedPools:
    """Cloud points, points near them and uniform ones, with signed distances to the cloud."""

    def __init__(self, cloud: OrientedCloud, near: int, uniform: int, spread: float, *, seed: int, device: str) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        on = torch.from_numpy(cloud.points)
        index = CloudDistance(on, torch.from_numpy(cloud.normals))
        anchors = on[torch.randint(len(on), (near,), generator=self.generator)]
        # Steps shorter than the cloud's spacing would leave unsaid what is between its points.
        scale = max(spread, index.spacing)
        steps = scale * torch.logit(torch.rand(near, 3, generator=self.generator), eps=1e-6)
        by = (anchors + steps).clamp(-DOMAIN, DOMAIN)
        anywhere = (2 * torch.rand(uniform, 3, generator=self.generator) - 1) * DOMAIN
        known = ((on, torch.zeros(len(on))), (by, index.signed(by)), (anywhere, index.signed(anywhere)))
        self.pools = [(points.to(device), distance.to(device)) for points, distance in known]

    def draw(self, count: int, shares: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
        """About ``count`` points ``(N, 3)`` in random order, with their distances ``(N,)``."""
        points, distances = [], []
        for (pool, distance), share in zip(self.pools, shares, strict=True):
            number = count * share // sum(shares)
            chosen = torch.randint(len(pool), (number,), generator=self.generator).to(pool.device)
            points.append(pool[chosen])
            distances.append(distance[chosen])
        order = torch.randperm(sum(len(part) for part in points), generator=self.generator).to(points[0].device)
        return torch.cat(points)[order], torch.cat(distances)[order]


def mape_loss(value: Tensor, distance: Tensor, *, epsilon: float = 0.01) -> Tensor:
    """``|f − d| / (|d| + ε)``, Instant-NGP's loss for distances. ``(...,)`` twice → ``(...,)``.

    The nearer to the surface, the dearer an error: on it, a hundred times as dear as at distance 1.
    """
    return (value - distance).abs() / (distance.abs() + epsilon)


def stencil(x: Tensor, step: float) -> Tensor:
    """Each point and its six neighbours along the axes, ``(N, 3)`` → ``(N, 7, 3)``: x, x + h e₁, x − h e₁, ...."""
    unit = torch.eye(3, dtype=x.dtype, device=x.device)
    moves = torch.stack((unit, -unit), dim=1).reshape(6, 3)
    return x[:, None] + step * torch.cat((torch.zeros_like(moves[:1]), moves))


def differences(values: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Gradient ``(N, 3)`` and Laplacian ``(N,)`` by central differences of ``(N, 7)`` values on a `stencil`."""
    ahead, behind = values[:, 1::2], values[:, 2::2]
    return (ahead - behind) / (2 * step), (values[:, 1:].sum(dim=1) - 6 * values[:, 0]) / step**2
