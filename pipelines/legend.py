"""A colour bar under a picture: what the colours of its map mean."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .slice import round_step

__all__ = ["with_color_bar"]

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

DARK, LIGHT = (0.20, 0.22, 0.27), (0.92, 0.93, 0.95)
LONGEST = 36  # of the bar, in text heights
LABEL = 7  # room for the number under a tick, in text heights


def with_color_bar(
    picture: Image,
    colors: NDArray[np.floating],
    limits: tuple[float, float],
    *,
    title: str,
    background: Sequence[float] | None = (1.0, 1.0, 1.0),
) -> Image:
    """The picture with a strip under it: a title, the bar, and round numbers.

    Args:
        picture: ``(H, W, 3 | 4)``.
        colors: ``(K, 3)`` of the map in [0, 1], from the lower limit to the upper one.
        limits: the values at both ends, as they are to be shown.
        title: what the numbers are.
        background: of the strip, in [0, 1]; None is transparent, for a picture with an alpha channel.
    """
    height, width = picture.shape[:2]
    text = round(float(np.clip(min(width, 2 * height) / 48, 9, 64)))
    margin = text
    length = max(2, min(width - 2 * margin, LONGEST * text))
    paper = (1.0, 1.0, 1.0) if background is None else background
    ink = DARK if float(np.mean(paper)) > 0.5 else LIGHT
    strip = np.empty((round(5.4 * text), width, 4), np.float32)
    strip[..., :3] = ink if background is None else paper
    strip[..., 3] = background is not None

    top, bottom = round(2.1 * text), round(3.1 * text)
    index = np.rint(np.linspace(0, len(colors) - 1, length)).astype(np.int64)
    strip[top:bottom, margin : margin + length, :3] = colors[index, :3][: max(0, width - margin)]
    strip[top:bottom, margin : margin + length, 3] = 1
    font = cv2.FontFace("uni")
    _write(strip, title, (margin, round(1.2 * text)), font, text, ink)
    for value, label in _ticks(limits, max(2, length // (LABEL * text))):
        low, high = limits
        x = margin + round((value - low) / (high - low) * (length - 1))
        strip[bottom : bottom + text // 3, x : x + max(1, text // 8)] = (*ink, 1)
        half = _text_width(label, font, text) // 2
        left = min(max(x - half, margin // 2), max(margin // 2, width - 2 * half - margin // 2))
        _write(strip, label, (left, round(4.3 * text)), font, text, ink)
    strip = (strip.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    return np.concatenate((picture, strip[..., : picture.shape[2]]))


def _ticks(limits: tuple[float, float], count: int) -> list[tuple[float, str]]:
    """About ``count`` round numbers within the limits, with the digits that tell one from the next."""
    low, high = limits
    if not high > low:
        return []
    step = round_step((high - low) / count)
    numbers = np.arange(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [(float(n * step), f"{n * step:.{digits}f}".replace("-", "−")) for n in numbers]


def _text_width(words: str, font: cv2.FontFace, text: int) -> int:
    return int(cv2.getTextSize((0, 0), words, (0, 0), font, text)[2])


def _write(
    strip: Floats, words: str, place: tuple[int, int], font: cv2.FontFace, text: int, ink: tuple[float, float, float]
) -> None:
    """Words from ``place``, the middle of their left side; cv2 draws them on bytes, which serve as a mask."""
    mask = np.zeros((*strip.shape[:2], 3), np.uint8)
    cv2.putText(mask, words, (place[0], place[1] + round(0.36 * text)), (255, 255, 255), font, text)
    cover = mask[..., :1].astype(np.float32) / 255
    strip += cover * (np.array((*ink, 1), np.float32) - strip)
