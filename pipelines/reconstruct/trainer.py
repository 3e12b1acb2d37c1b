"""Training of ``reconstruct``: render rays, compare, step Adam; levels join on schedule, bands follow 1/s."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ...neural_fields.losses import eikonal_loss
from ...neural_fields.volume_renderer import Sampling
from ..run.settings import ReconstructConfig
from ..run.trainer import StopFlag, set_rate
from .model import RayPool, SceneModel

__all__ = ["SceneTrainer"]


class SceneTrainer:
    """Trains a scene on the pixels of a pool; interruptible, resumable.

    Args:
        model: what is trained, on the pool's device.
        pool: the pixels.
        config: settings.
        seconds: end the schedule after this long even if steps remain; None for no limit.
    """

    def __init__(
        self, model: SceneModel, pool: RayPool, config: ReconstructConfig, *, seconds: float | None = None
    ) -> None:
        self.model, self.pool, self.config, self.seconds = model, pool, config, seconds
        self.generator = torch.Generator().manual_seed(config.seed)
        self.sampling = Sampling(uniform=config.uniform, importance=config.importance)
        colors = [*model.color.parameters(), *(model.outside.parameters() if model.outside else ())]
        groups = [
            {"params": list(model.geometry.parameters()), "share": 1.0},
            {"params": colors, "share": config.color_rate},
            {"params": [model.variance], "share": config.sharpening},
        ]
        self.adam = torch.optim.Adam(groups, lr=config.learning_rate, betas=(0.9, 0.99), fused=True)
        self.step, self.elapsed = 0, 0.0
        self.losses: dict[str, float] = {}

    @property
    def fraction(self) -> float:
        """How much of the schedule is done, by steps or by time, whichever is further."""
        by_time = self.elapsed / self.seconds if self.seconds else 0.0
        return min(1.0, max(self.step / self.config.steps, by_time))

    @property
    def level(self) -> int:
        """The finest level that is switched on by now."""
        started = sum(start <= self.fraction for start in self.config.starts)
        return min(started, self.model.geometry.num_levels) - 1

    def run(
        self,
        flag: StopFlag,
        *,
        report: Callable[[SceneTrainer], None],
        save: Callable[[SceneTrainer], None],
        report_every: int = 20,
        save_every: float = 60.0,
    ) -> bool:
        """Train until the schedule ends → True, or until ``flag`` asks to stop → False; see `LevelTrainer.run`."""
        start, saved = time.monotonic() - self.elapsed, time.monotonic()
        while self.fraction < 1:
            if flag.requested:
                return False
            terms = self._step()
            self.elapsed = time.monotonic() - start
            if self.step % report_every == 0 or self.fraction >= 1:
                self.losses = {name: float(term) for name, term in terms.items()}
                report(self)
            if time.monotonic() - saved > save_every:
                save(self)
                saved = time.monotonic()
        return True

    def _step(self) -> dict[str, Tensor]:
        set_rate(self.adam, self.config.learning_rate, self.fraction)
        for group in self.adam.param_groups:
            group["lr"] *= group["share"]
        self.model.widen(self.config.band, self.config.least_delta)
        terms, total = self._losses()
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        self.adam.step()
        self.step += 1
        return terms

    def _losses(self) -> tuple[dict[str, Tensor], Tensor]:
        """The terms of one batch, unweighted and by name, and their weighted sum."""
        config = self.config
        rays = self.pool.draw(config.rays, self.generator)
        seen = self.model.render(
            rays.origins,
            rays.directions,
            self.sampling,
            cos_anneal=min(1.0, self.fraction / config.anneal) if config.anneal else 1.0,
            level=self.level,
            least_weight=config.least_weight,
            generator=self.generator,
        )
        target = rays.color
        if self.pool.has_masks:
            target = torch.lerp(self.model.background.expand_as(target), target, rays.mask[:, None])
        color = (seen.color - target).abs().mean()
        eikonal = eikonal_loss(seen.jet.gradient).mean()
        terms = {"color": color, "eikonal": eikonal}
        total = color + config.eikonal_weight * eikonal
        if self.pool.has_masks and config.mask_weight:
            opacity = seen.opacity.clamp(1e-3, 1 - 1e-3)
            mask = torch.nn.functional.binary_cross_entropy(opacity, rays.mask)
            terms["mask"] = mask
            total = total + config.mask_weight * mask
        terms["uncertainty"] = 1 / self.model.inv_std
        return {name: term.detach() for name, term in terms.items()}, total

    def state(self) -> dict[str, Tensor]:
        """All that `restore` needs to continue as if nothing had happened."""
        state = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        for index, parameter in enumerate(self.model.parameters()):
            for name, tensor in self.adam.state.get(parameter, {}).items():
                state[f"adam.{index}.{name}"] = tensor
        state["generator"] = self.generator.get_state()
        state["progress"] = torch.tensor([self.step, self.elapsed], dtype=torch.float64)
        return state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what `state` returned."""
        prefix = "model."
        self.model.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        for index, parameter in enumerate(self.model.parameters()):
            prefix = f"adam.{index}."
            # Adam counts its steps on the CPU, or beside the parameter where the kernel is fused.
            found = {k.removeprefix(prefix): v.to(parameter.device) for k, v in state.items() if k.startswith(prefix)}
            if found:
                self.adam.state[parameter] = found
        self.generator.set_state(state["generator"].cpu())
        self.step, self.elapsed = int(state["progress"][0]), float(state["progress"][1])
