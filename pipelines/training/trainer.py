"""The loop of every training: Adam and `Muon` on a schedule, reports, checkpoints, a time budget, a way to stop."""

from __future__ import annotations

import math
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from ...neural_fields import Siren
from ...neural_fields.backend.devices import graph_input, precise
from .progress import Progress, Report, silent

Rate = Callable[[float], float]


class Interrupted(Exception):  # noqa: N818  what happened is no error
    """Training was stopped by Ctrl-C, and a usable checkpoint was written.

    Attributes:
        directory: the run directory, for ``--resume``; None if the fit had none.
    """

    def __init__(self, directory: Path | None) -> None:
        super().__init__("interrupted" if directory is None else f"interrupted; checkpoint in {directory}")
        self.directory = directory


class StopFlag:
    """Whether somebody has asked the training to stop after the step under way."""

    def __init__(self) -> None:
        self.requested = False


@contextmanager
def stop_on_signals() -> Iterator[StopFlag]:
    """Turn the first Ctrl-C or SIGTERM into a flag that is read between two steps; a second one acts at once.

    Signals belong to the main thread. Elsewhere it is `SHARED_FLAG`, or one that is never raised.
    """
    if threading.current_thread() is not threading.main_thread():
        yield SHARED_FLAG.get() or StopFlag()
        return
    flag = StopFlag()
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in signals}

    def request(number: int, frame: FrameType | None) -> None:
        flag.requested = True
        for other in signals:
            signal.signal(other, before[other])

    for number in signals:
        signal.signal(number, request)
    try:
        yield flag
    finally:
        for number in signals:
            signal.signal(number, before[number])


# In a thread: the flag of the main thread, which hears the signals.
SHARED_FLAG: ContextVar[StopFlag | None] = ContextVar("shared", default=None)


def load_compiler() -> None:
    """Load PyTorch's compiler, as its first optimiser does, before any step is timed: it takes two seconds."""
    torch.optim.Adam([torch.zeros(1, requires_grad=True)])


def parameter_count(*modules: nn.Module) -> int:
    """How many numbers of them are trained, all together."""
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


_seeding = threading.RLock()


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """A block whose random numbers follow from ``seed``. Torch's state is put back; threads wait for each other."""
    with _seeding, torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def warm_cosine(peak: float) -> Rate:
    """Learning rates by the fraction of a schedule, in [0, 1]: a warm-up to ``peak`` over 2 %, then a cosine to 0."""
    return lambda done: peak * min(1.0, (done + 0.001) / 0.02) * 0.5 * (1 + math.cos(math.pi * done))


class Group(NamedTuple):
    """Parameters, and their learning rate for a schedule done to a fraction in [0, 1].

    They are ``matrices`` that `Muon` trains, or anything, for Adam.
    """

    parameters: Sequence[nn.Parameter]
    rate: Rate
    matrices: bool = False


def siren_groups(network: nn.Module, rate: float, turn: float) -> list[Group]:
    """What is trained of a network: hidden matrices of its SIRENs by `Muon`, at most at ``turn`` / ω, the rest by Adam.

    In a step, the norm of the change of a hidden layer's phases is then at most about ``turn`` times that of its input.
    Frequency and width do not matter; where all inputs are 1, that is ``turn`` radians. ``rate`` is Adam's peak rate.
    Without ``turn``, all are trained by Adam.
    """
    groups = []
    for siren in (part for part in network.modules() if turn and isinstance(part, Siren)):
        hidden = [matrix for matrix in siren.layers[1:].parameters() if matrix.requires_grad and matrix.ndim == 2]
        if hidden:
            groups.append(Group(hidden, warm_cosine(turn / siren.omega), matrices=True))
    taken = {id(matrix) for group in groups for matrix in group.parameters}
    others = [each for each in network.parameters() if each.requires_grad and id(each) not in taken]
    return [Group(others, warm_cosine(rate)), *groups]


class Muon(torch.optim.Optimizer):
    """Descent along matrices that are made orthogonal: ``W ← W − lr · U Vᵀ`` for a gradient ``U S Vᵀ`` with momentum.

    All directions of a matrix are learnt at one speed, so a SIREN needs half of Adam's steps (Jordan et al., "Muon",
    2024). `torch.optim.Muon` multiplies in bfloat16, which takes longer than the step itself on CPUs without it.
    The momentum is Nesterov's: one step of it is looked ahead. ``matrices`` are groups of equal shapes ``(n, m)``. As
    of Adam, a step changes nothing where ``found_inf`` is 1.
    """

    momentum = 0.9
    found_inf: Tensor | float = 0.0

    def __init__(self, matrices: list[dict[str, Any]]) -> None:
        super().__init__(matrices, {"lr": 0.0})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step with the rate ``lr`` of each group: the largest change of a layer over the norm of its input."""
        taken = 1 - self.found_inf
        for group in self.param_groups:
            matrices, ahead = [matrix for matrix in group["params"] if matrix.grad is not None], []
            for matrix in matrices:
                mean = self.state[matrix].setdefault("momentum", torch.zeros_like(matrix))
                mean.lerp_(matrix.grad, taken * (1 - self.momentum))
                ahead.append(matrix.grad.lerp(mean, self.momentum))
            for matrix, way in zip(matrices, orthogonal(torch.stack(ahead)) if ahead else (), strict=True):
                matrix.sub_(taken * group["lr"] * way)


def orthogonal(matrices: Tensor) -> Tensor:
    """About ``U Vᵀ`` of matrices ``U S Vᵀ`` ``(k, n, m)``: odd polynomials take singular values to 0.7 to 1.2.

    The coefficients are those of Jordan et al. (2024), for the steepest slope at 0.
    """
    first, third, fifth = 3.4445, -4.7750, 2.0315
    found = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(matrices.dtype).tiny)
    for _ in range(5):
        square = found @ found.mT
        mixed = torch.baddbmm(square, square, square, beta=third, alpha=fifth)
        found = torch.baddbmm(found, mixed, found, beta=first)
    return found


class Objective(ABC):
    """What a `Trainer` minimises: a ``network``, saved whole, and ``groups`` of its parameters that are trained.

    The CPU ``generator`` draws the batches. ``kept`` are other tensors that later steps depend on, by name; saved too.
    """

    def __init__(
        self,
        network: nn.Module,
        groups: Sequence[Group],
        generator: torch.Generator,
        kept: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.network, self.groups, self.generator = network, groups, generator
        self.kept = dict(kept or {})

    @abstractmethod
    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """The terms of one fresh batch, unweighted and by name, and their weighted sum.

        ``step`` steps are done, and the fraction ``done`` of the schedule, in [0, 1).
        """


O = TypeVar("O", bound=Objective)  # noqa: E741
F = TypeVar("F", bound=nn.Module)


class Trainer(Generic[O]):
    """Minimises an objective with Adam, and `Muon` for groups of matrices; interruptible and resumable.

    Args:
        objective: what is minimised.
        stage: what progress displays call it.
        steps: how many.
        seconds: end the schedule after this long even if steps remain; None for no limit.
        clip: largest norm of the whole gradient; None for any.
        network_name: what the network is called in `state`.
        adam: other options of `torch.optim.Adam`.
    """

    def __init__(
        self,
        objective: O,
        *,
        stage: str,
        steps: int,
        seconds: float | None = None,
        clip: float | None = None,
        network_name: str = "network",
        **adam: Any,
    ) -> None:
        self.objective, self.stage, self.steps, self.seconds, self.clip = objective, stage, steps, seconds, clip
        self.trained = [parameter for group in objective.groups for parameter in group.parameters]
        groups = [{"params": list(group.parameters), "rate": group.rate} for group in objective.groups]
        matrices = [group for group, given in zip(groups, objective.groups, strict=True) if given.matrices]
        others = [group for group, given in zip(groups, objective.groups, strict=True) if not given.matrices]
        self.adam = torch.optim.Adam(others, fused=True, **{"betas": (0.9, 0.99), **adam})
        self.optimisers: dict[str, torch.optim.Optimizer] = {"adam": self.adam}  # by their names in `state`
        if matrices:
            self.optimisers["muon"] = Muon(matrices)
        self.step, self.elapsed = 0, 0.0
        self.losses: dict[str, float] = {}
        self._name = f"{network_name}."

    @property
    def fraction(self) -> float:
        """How much of the schedule is done, by steps or by time, whichever is further."""
        by_time = self.elapsed / self.seconds if self.seconds else 0.0
        return min(1.0, max(self.step / self.steps if self.steps else 1.0, by_time))

    @property
    def ended_early(self) -> bool:
        """Whether steps remain."""
        return self.step < self.steps

    @property
    def progress(self) -> Progress:
        """How far the training is, with the losses of the last report."""
        return Progress(self.stage, self.step, self.steps, self.fraction, self.losses)

    def run(
        self,
        flag: StopFlag | None = None,
        *,
        report: Report | None = None,
        save: Callable[[], None] | None = None,
        report_every: int = 20,
        report_seconds: float = 1.0,
        save_every: float = 20.0,
    ) -> bool:
        """Train until the schedule ends → True, or until the ``flag`` is raised → False.

        ``report`` is called at the beginning and, with fresh losses, every ``report_every`` steps (reading them makes a
        GPU wait), every ``report_seconds``, and at the end; ``save`` every ``save_every`` seconds, and before a stop.
        """
        flag, report, save = flag or StopFlag(), report or silent, save or (lambda: None)
        start, saved = time.monotonic() - self.elapsed, time.monotonic()
        told = saved
        device = self.trained[0].device
        if self.fraction < 1:
            report(self.progress)  # so that displays know when it began
        while self.fraction < 1:
            if flag.requested:
                save()
                return False
            terms = self._step()
            self.elapsed = time.monotonic() - start
            if self.step % report_every == 0 or self.fraction >= 1 or time.monotonic() - told > report_seconds:
                read = torch.stack([term.to(precise(device)) for term in terms.values()]).tolist()  # one wait for all
                self.losses = dict(zip(terms, read, strict=True))
                report(self.progress)
                told = time.monotonic()
            if time.monotonic() - saved > save_every:
                save()
                saved = time.monotonic()
        return True

    def _step(self) -> dict[str, Tensor]:
        done = self.fraction
        for optimiser in self.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = group["rate"](done)
        terms, total = self.objective.losses(self.step, done)
        self.descend(total)
        self.step += 1
        return {name: term.detach() for name, term in terms.items()}

    def descend(self, total: Tensor) -> None:
        """One step down the gradient of ``total``."""
        for optimiser in self.optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        total.backward()
        if self.clip is not None:
            nn.utils.clip_grad_norm_(self.trained, self.clip)
        for optimiser in self.optimisers.values():
            optimiser.step()

    def state(self) -> dict[str, Tensor]:
        """All that `restore` needs to continue as if nothing had happened."""
        objective = self.objective
        state = _prefixed(self._name, objective.network.state_dict())
        for index, parameter in enumerate(objective.network.parameters()):
            for name, optimiser in self.optimisers.items():
                state |= _prefixed(f"{name}.{index}.", optimiser.state.get(parameter, {}))
        state["generator"] = objective.generator.get_state()
        state["progress"] = torch.tensor([self.step, self.elapsed], dtype=torch.float64)
        return state | objective.kept

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what `state` returned."""
        objective = self.objective
        objective.network.load_state_dict(without_prefix(self._name, state))
        for index, parameter in enumerate(objective.network.parameters()):
            for name, optimiser in self.optimisers.items():
                # Adam counts its steps on the CPU, or beside the parameter where the kernel is fused.
                moments = without_prefix(f"{name}.{index}.", state)
                if moments:
                    optimiser.state[parameter] = {key: tensor.to(parameter.device) for key, tensor in moments.items()}
        objective.generator.set_state(state["generator"].cpu())
        # What an older version did not keep begins anew.
        objective.kept = {name: state.get(name, tensor).to(tensor) for name, tensor in objective.kept.items()}
        self.step, self.elapsed = int(state["progress"][0]), float(state["progress"][1])


def checkpoint_of(frozen: nn.Module | None, trainer: Trainer[Any] | None) -> dict[str, Tensor]:
    """What a training level by level keeps: the levels that are done, and the one under way."""
    tensors = {} if trainer is None else _prefixed("trainer.", trainer.state())
    return tensors if frozen is None else tensors | _prefixed("frozen.", frozen.state_dict())


def restore_frozen(field: F, tensors: Mapping[str, Tensor]) -> F:
    """Give ``field`` the levels that are done, of what `checkpoint_of` kept; they are not trained any more."""
    field.load_state_dict(without_prefix("frozen.", tensors))
    return field.requires_grad_(False)


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors, with ``prefix`` before every name."""
    return {prefix + name: tensor for name, tensor in tensors.items()}


def without_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Those whose names begin with ``prefix``, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


class ErrorWeightedSampler:
    """Draws pixels of a pool uniformly, or in proportion to the mean error of their strip of neighbours.

    Of N pixels, one of the n in a strip with the error e has the probability ``(1 - share) / N + share · e / (n Σ e)``.
    Uniform samples alone learn late what few photographs show. A ``share`` below 1 leaves every pixel some probability.
    Errors are running means that begin with 1. A ``strip`` is a number of neighbouring pixels on a line; it is 1 for
    samples that are no neighbours. All but the random numbers is on the device.
    """

    def __init__(self, pixels: int, share: float, device: torch.device, *, strip: int = 16) -> None:
        self.pixels, self.share, self.strip, self.device = pixels, share, strip, device
        self.errors = torch.ones(-(-pixels // strip) if share else 0, device=device)
        self.bounds = torch.zeros_like(self.errors, dtype=precise(device))
        self.refresh()

    @property
    def kept(self) -> Mapping[str, Tensor]:
        """State of the sampler, for `Objective.kept`."""
        return {"errors": self.errors, "bounds": self.bounds}

    def at_step(self, step: int, kept: MutableMapping[str, Tensor]) -> ErrorWeightedSampler:
        """The sampler with the state in an objective's ``kept``, refreshed every 16 steps."""
        if len(kept["errors"]) != len(self.errors):  # an older version had other strips
            kept.update(self.kept)
        self.errors, self.bounds = kept["errors"], kept["bounds"]
        if step % 16 == 0:
            self.refresh()
        return self

    def refresh(self) -> None:
        """Update the probabilities to the current errors, in the memory that recorded steps read."""
        torch.cumsum(self.errors, 0, dtype=self.bounds.dtype, out=self.bounds)

    def rows(self, count: int, generator: torch.Generator) -> Tensor:
        """``(count,)`` numbers of pixels, with replacement."""
        if not self.share:
            return graph_input(lambda: torch.randint(self.pixels, (count,), generator=generator), self.device)
        kind = precise(self.device)
        place, within = graph_input(lambda: torch.rand(2, count, generator=generator, dtype=kind), self.device)
        # The first (1 - share) of the unit interval stands for even draws, and the rest for those by errors.
        by_error = ((place - (1 - self.share)) / self.share).clamp_min(0) * self.bounds[-1]
        strips = torch.searchsorted(self.bounds, by_error, right=True).clamp_max(len(self.bounds) - 1)
        length = (self.pixels - strips * self.strip).clamp_max(self.strip)  # the last one may be shorter
        rows = strips * self.strip + (within * length).long()
        return torch.where(place < 1 - self.share, (within * self.pixels).long(), rows)

    def learn(self, rows: Tensor, errors: Tensor) -> None:
        """Average ``errors`` ``(R,)`` of pixels ``rows`` ``(R,)`` into the errors of their strips."""
        if self.share:
            self.errors.scatter_reduce_(0, rows // self.strip, errors, "mean", include_self=True)
