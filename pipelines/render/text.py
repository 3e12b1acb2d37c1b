"""Words in a picture: with OpenCV 5's own font, or by the strokes that every OpenCV has, in plain letters."""

from __future__ import annotations

import functools
import unicodedata

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["plain", "text_mask", "text_width"]

NAMES = str.maketrans({"δ": "delta", "−": "-", "–": "-", "°": " deg", "·": " "})
STROKES = 30  # size of the type whose capitals are as high as those of the strokes at scale 1, 22 pixels


def text_width(words: str, size: int) -> int:
    """Pixels that words take, ``size`` pixels from the top of one line to the top of the next."""
    if _has_fonts():
        return int(cv2.getTextSize((0, 0), words, (0, 0), _font(), size)[2])
    return int(cv2.getTextSize(plain(words), cv2.FONT_HERSHEY_SIMPLEX, size / STROKES, 1)[0][0])


def text_mask(shape: tuple[int, int], words: str, place: tuple[int, int], size: int) -> NDArray[np.float32]:
    """How much of each pixel words cover.

    Args:
        shape: rows and columns of the picture.
        words: one line.
        place: column and row of the middle of their left side.
        size: see `text_width`.

    Returns:
        ``(rows, columns)`` in [0, 1].
    """
    mask = np.zeros((*shape, 3), np.uint8)
    base = (place[0], place[1] + round(0.36 * size))
    white = (255, 255, 255)
    if _has_fonts():
        cv2.putText(mask, words, base, white, _font(), size)
    else:
        cv2.putText(mask, plain(words), base, cv2.FONT_HERSHEY_SIMPLEX, size / STROKES, white, 1, cv2.LINE_AA)
    return mask[..., 0].astype(np.float32) / np.float32(255)


def plain(words: str) -> str:
    """The words in ASCII: ``δ₁ = −2 mm⁻¹`` is ``delta1 = -2 mm-1``; what has no such form is left out."""
    folded = unicodedata.normalize("NFKD", words.translate(NAMES)).translate(NAMES)
    return folded.encode("ascii", "ignore").decode()


def _has_fonts() -> bool:
    """Whether OpenCV is 5 or later; an environment with nerfstudio has 4.10."""
    return hasattr(cv2, "FontFace")


@functools.cache
def _font() -> cv2.FontFace:
    """OpenCV's own sans-serif, which has all of Unicode that we write."""
    return cv2.FontFace("uni")
