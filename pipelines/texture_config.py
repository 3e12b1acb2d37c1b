"""Settings of ``texture``; every field is a key of the YAML presets and a flag of the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["TextureConfig"]


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class TextureConfig:
    """Settings of ``texture``; the defaults are the ``default`` preset.

    Raises:
        ValueError: a number out of range; the message names the field.
    """

    width: int = _setting(256, "neurons per layer")
    depth: int = _setting(3, "sine layers")
    omega: float = _setting(60.0, "SIREN frequency: higher takes up finer detail, and more of the noise")
    steps: int = _setting(500, "training steps")
    learning_rate: float = _setting(5e-4, "peak learning rate")
    batch: int = _setting(8192, "points with colours per training step")
    band_batch: int = _setting(2048, "points of the band per training step")
    tangential_weight: float = _setting(0.3, "weight of the change of colour along the normals")
    samples: int = _setting(400_000, "points sampled on a mesh, and half as many in the band, drawn from at every step")
    delta: float | None = _setting(
        None, "half-width of the band in units of the field; none is that of the coarsest level, but at least 0.02"
    )
    time_budget: float | None = _setting(None, "end training after about this many seconds")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        for name in ("width", "depth", "omega", "steps", "learning_rate", "batch", "band_batch", "samples"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected > 0")
        for name in ("delta", "time_budget"):
            number = getattr(self, name)
            if number is not None and not number > 0:
                raise ValueError(f"{name}: {number}; expected > 0, or none")
        if self.tangential_weight < 0:
            raise ValueError(f"tangential_weight: {self.tangential_weight}; expected ≥ 0")
