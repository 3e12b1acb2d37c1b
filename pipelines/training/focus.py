"""Where a training looks: pixels or samples at random, and more of them where it was wrong of late."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping

import torch
from torch import Tensor


class Focus:
    """Pixels of a pool, drawn evenly or by the errors of their strips.

    The chance of a pixel, one of the n in a strip with the error e, is ``(1 - share) / N + share · e / (n Σ e)`` of N
    pixels. What few photographs show, and fine detail, is learnt late from even samples, because most of those show
    what is learnt long since. With ``share`` below one no pixel is forgotten, and none that is always wrong (a person
    who walked by) has all.

    Args:
        pixels: how many there are, line after line.
        share: of the draws that go by errors, from 0 to 1.
        device: of the errors.
        strip: how many neighbouring pixels of a line share an error; 1 for samples that are no neighbours.

    Attributes:
        errors: ``(S,)`` of the strips, running means; 1 in the beginning.
        bounds: ``(S,)`` their running sums when `refresh` was called last, in float64 on the CPU.
    """

    def __init__(self, pixels: int, share: float, device: torch.device, *, strip: int = 16) -> None:
        self.pixels, self.share, self.strip = pixels, share, strip
        self.errors = torch.ones(-(-pixels // strip), device=device)
        self.refresh()

    @property
    def kept(self) -> Mapping[str, Tensor]:
        """What later steps depend on, for `Objective.kept`."""
        return {"errors": self.errors, "bounds": self.bounds}

    def watched(self, step: int, kept: MutableMapping[str, Tensor]) -> Focus:
        """This one at a step of a training, which may be resumed, brought up to date now and then.

        Args:
            step: number of the step.
            kept: the objective's, with what `kept` has put there.
        """
        self.errors, self.bounds = kept["errors"], kept["bounds"]
        if step % 16 == 0:
            self.refresh()
            kept["bounds"] = self.bounds
        return self

    def refresh(self) -> None:
        """Draw by the errors as they are now; a GPU is waited for."""
        self.bounds = self.errors.double().cumsum(0).cpu()

    def rows(self, count: int, generator: torch.Generator) -> Tensor:
        """``(count,)`` numbers of pixels on the CPU, with replacement."""
        if not self.share:
            return torch.randint(self.pixels, (count,), generator=generator)
        place, within = torch.rand(2, count, generator=generator, dtype=torch.float64)
        # The first (1 - share) of the unit interval stands for even draws, and the rest for those by errors.
        by_error = ((place - (1 - self.share)) / self.share).clamp_min(0) * self.bounds[-1]
        strips = torch.searchsorted(self.bounds, by_error, right=True).clamp_max(len(self.bounds) - 1)
        length = (self.pixels - strips * self.strip).clamp_max(self.strip)  # the last one may be shorter
        rows = strips * self.strip + (within * length).long()
        return torch.where(place < 1 - self.share, (within * self.pixels).long(), rows)

    def learn(self, rows: Tensor, errors: Tensor) -> None:
        """Take note of how wrong pixels were: the mean of what is said and of what was known, for each strip.

        Args:
            rows: ``(R,)`` numbers of the pixels, on the device of the errors.
            errors: ``(R,)``, not negative.
        """
        if self.share:
            self.errors.scatter_reduce_(0, rows // self.strip, errors, "mean", include_self=True)
