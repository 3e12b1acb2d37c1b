"""Settings of ``reconstruct``; every field is a key of the YAML presets and a flag of the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["ReconstructConfig"]


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of ``reconstruct``; the defaults are the ``default`` preset.

    Raises:
        ValueError: lists of different lengths, or a number out of range; the message names the field.
    """

    geometry: Literal["multiscale", "neus"] = _setting(
        "multiscale", "multiscale (a coarse SIREN and residuals in bands) or neus (the 8 x 256 softplus network)"
    )
    widths: tuple[int, ...] = _setting((128, 256), "neurons per layer, one number per level")
    depths: tuple[int, ...] = _setting((4, 5), "sine layers, one number per level")
    omegas: tuple[float, ...] = _setting((10.0, 25.0), "SIREN frequency of each level (Eq. 2)")
    starts: tuple[float, ...] = _setting((0.0, 0.25), "when each level is switched on, as shares of the training")
    features: int = _setting(32, "appearance features of every level of the multiscale geometry")
    taper: float = _setting(0.3, "share of a band over which the next level fades out")
    band: float = _setting(4.0, "half-width of the bands in units of the surface's uncertainty 1/s")
    least_delta: float = _setting(0.02, "half-width that a band keeps, in units of the region's radius")
    radius: float = _setting(0.5, "of the sphere that the geometry begins as, in units of the region's radius")
    color_width: int = _setting(256, "neurons per layer of the colour network")
    color_depth: int = _setting(4, "layers of the colour network")
    color_frequencies: int = _setting(6, "octaves of the position that the colour network sees; NeuS has 0")
    background: Literal["auto", "black", "white", "outside"] = _setting(
        "auto", "what is behind the object: black, white, or a learnt outside; auto is white with masks, else outside"
    )
    steps: int = _setting(5000, "training steps")
    rays: int = _setting(256, "rays per training step")
    uniform: int = _setting(32, "evenly spaced samples per ray")
    importance: int = _setting(32, "samples per ray near the surface")
    texture_steps: int = _setting(500, "training steps of the texture of the finished surface; 0 leaves it uncoloured")
    learning_rate: float = _setting(3e-4, "peak learning rate of the geometry")
    color_rate: float = _setting(6.0, "learning rate of the colours, in units of the geometry's")
    sharpening: float = _setting(8.0, "learning rate of the surface's uncertainty, in units of the others'")
    eikonal_weight: float = _setting(0.05, "weight of (|grad f| - 1)^2")
    mask_weight: float = _setting(0.1, "weight of the masks' cross-entropy, where there are masks")
    anneal: float = _setting(0.2, "share of the training in which slopes are annealed (cos_anneal)")
    least_weight: float = _setting(1e-4, "samples that contribute less to their pixel get no colour")
    width: int | None = _setting(None, "shrink the pictures to this many pixels across before training")
    test_every: int = _setting(8, "every n-th picture is held out and measured; 0 trains on all")
    time_budget: float | None = _setting(None, "end training after about this many seconds")
    seed: int = _setting(0, "random seed")
    device: str = _setting("auto", "torch device: auto, cpu, cuda, ...")

    def __post_init__(self) -> None:
        count = len(self.widths)
        if count == 0:
            raise ValueError("widths: expected at least one level")
        for name in ("depths", "omegas", "starts"):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name}: {len(getattr(self, name))} entries for {count} widths; expected one for each"
                )
        if self.starts[0] != 0 or any(
            not 0 <= b < 1 or b < a for a, b in zip(self.starts, self.starts[1:], strict=False)
        ):
            raise ValueError(f"starts: {self.starts}; expected 0 first, then growing shares below 1")
        for name in (*("widths", "depths", "omegas"), *_POSITIVE):
            numbers = getattr(self, name)
            if not all(number > 0 for number in (numbers if isinstance(numbers, tuple) else (numbers,))):
                raise ValueError(f"{name}: {numbers}; expected > 0")
        for name in _NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected ≥ 0")
        for name in ("taper", "anneal"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: {getattr(self, name)}; expected a share from 0 to 1")
        for name in ("width", "time_budget"):
            number = getattr(self, name)
            if number is not None and not number > 0:
                raise ValueError(f"{name}: {number}; expected > 0, or none")
        if self.uniform < 2:
            raise ValueError(f"uniform: {self.uniform}; expected at least 2")


_NOT_NEGATIVE = (
    "features",
    "color_frequencies",
    "importance",
    "texture_steps",
    "eikonal_weight",
    "mask_weight",
    "least_weight",
    "test_every",
)
_POSITIVE = (
    "band",
    "least_delta",
    "radius",
    "color_width",
    "color_depth",
    "steps",
    "rays",
    "learning_rate",
    "color_rate",
    "sharpening",
)
