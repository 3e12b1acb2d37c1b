"""The shadings by name, and their settings; nothing heavy is imported, so that ``--help`` stays quick."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["SHADINGS", "ShadeOptions"]

SHADINGS: dict[str, str] = {
    "lambert": "clay, or the surface's own colour, under a lamp above left of the camera",
    "headlight": "clay, or the surface's own colour, under a lamp at the camera",
    "normals": "the normal as a colour, (n + 1) / 2, in world axes",
    "depth": "distance from the camera, near light and far dark",
    "matcap": "the picture of a lit sphere wrapped over the normals",
    "curvature": "mean curvature: hollows blue, ridges red",
    "error": "distance to a reference cloud, small pale and large dark",
    "color": "the surface's own colour, unlit",
}


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class ShadeOptions:
    """Settings of `shade`; each one matters only to the shadings it names.

    Raises:
        ValueError: a number is out of range; the message names the field.
    """

    shadows: bool = _setting(False, "lambert: soft shadows, traced in the field")
    occlusion: bool = _setting(False, "lambert: darker hollows (ambient occlusion), traced in the field")
    light_level: int | None = _setting(
        0, "level in which shadows and occlusion are traced: a coarse one is fast; none is the one shown"
    )
    softness: float = _setting(0.15, "how fast shadows blur with the distance they fall; 0.001 is sharp")
    reach: float = _setting(0.12, "how far around a point occlusion looks, in units of the field")
    clay: tuple[float, float, float] = _setting((0.80, 0.78, 0.74), "r g b of a surface without colours, in [0, 1]")
    back_faces: bool = _setting(False, "tint what is seen from behind, so that holes and wrong normals show")
    detail: float = _setting(4e-3, "curvature: how wide a patch it is measured on, in units of the field")
    matcap: str = _setting("clay", "clay, chrome, or a PNG or JPEG of a sphere that fills it")
    limits: tuple[float, float] | None = _setting(
        None, "values at the ends of the colour map (depth, curvature, error); none fits them to what is seen"
    )
    quantile: float = _setting(0.95, "share of what is seen that fitted limits hold (curvature, error)")
    relief: float = _setting(0.35, "how much a headlight shades the colours of curvature and error, in [0, 1]")

    def __post_init__(self) -> None:
        for name in ("softness", "reach", "detail"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}; expected > 0")
        if len(self.clay) != 3 or not all(0 <= c <= 1 for c in self.clay):
            raise ValueError(f"clay: {self.clay}; expected three numbers in [0, 1]")
        if self.limits is not None and not (len(self.limits) == 2 and self.limits[0] < self.limits[1]):
            raise ValueError(f"limits: {self.limits}; expected two numbers, the smaller first")
        if not 0 < self.quantile <= 1:
            raise ValueError(f"quantile: {self.quantile}; expected a number in (0, 1]")
        if not 0 <= self.relief <= 1:
            raise ValueError(f"relief: {self.relief}; expected a number in [0, 1]")
