"""What stands under a picture: a colour bar, or what the colours and lines of a slice mean, and its scale."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.files import to_bytes
from .picture import Color, Image
from .slice import FINEST, STYLE, Floats, Slice, distance_color, level_color, round_step

NAMES = str.maketrans({"δ": "delta", "−": "-", "–": "-", "°": " deg", "·": " "})
STROKES = 30  # size of the type whose capitals are as high as those of the strokes at scale 1, 22 pixels


def text_width(words: str, size: int) -> int:
    """Pixels that words take, ``size`` pixels from the top of one line to the top of the next."""
    return int(cv2.getTextSize(_drawable(words), cv2.FONT_HERSHEY_SIMPLEX, size / STROKES, 1)[0][0])


def text_mask(shape: tuple[int, int], words: str, place: tuple[int, int], size: int) -> NDArray[np.float32]:
    """Coverage ``(rows, columns)`` in [0, 1] of one line of words; ``place`` is the middle of their left side."""
    mask = np.zeros(shape, np.uint8)
    base = (place[0], place[1] + round(0.36 * size))
    cv2.putText(mask, _drawable(words), base, cv2.FONT_HERSHEY_SIMPLEX, size / STROKES, 255, 1, cv2.LINE_AA)
    return mask.astype(np.float32) / np.float32(255)


def plain(words: str) -> str:
    """The words in ASCII: ``δ₁ = −2 mm⁻¹`` is ``delta1 = -2 mm-1``; what has no such form is left out."""
    folded = unicodedata.normalize("NFKD", words.translate(NAMES)).translate(NAMES)
    return folded.encode("ascii", "ignore").decode()


def _drawable(words: str) -> str:
    """Words that OpenCV can draw: from version 5 on all that we write; an environment with nerfstudio has 4.10."""
    return words if hasattr(cv2, "FontFace") else plain(words)


INK: Color = (0.20, 0.22, 0.27)  # ink on light paper
LIGHT: Color = (0.92, 0.93, 0.95)  # and on dark paper
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def with_color_bar(
    picture: Image,
    colors: NDArray[np.floating],
    limits: tuple[float, float],
    *,
    title: str,
    background: Sequence[float] | None = (1.0, 1.0, 1.0),
) -> Image:
    """The picture with a strip under it: a title, the bar, and round numbers.

    ``colors`` ``(K, 3)`` in [0, 1] run from the lower to the upper one of ``limits``, which are numbers as shown. A
    ``background`` of None is transparent.
    """
    height, width = picture.shape[:2]
    text = round(float(np.clip(min(width, 2 * height) / 48, 9, 64)))
    margin = text
    # Lengths are in text heights.
    length = max(2, min(width - 2 * margin, 36 * text))
    paper = (1.0, 1.0, 1.0) if background is None else background
    ink = INK if float(np.mean(paper)) > 0.5 else LIGHT
    strip = np.empty((round(5.4 * text), width, 4), np.float32)
    strip[..., :3] = ink if background is None else paper
    strip[..., 3] = background is not None

    top, bottom = round(2.1 * text), round(3.1 * text)
    index = np.rint(np.linspace(0, len(colors) - 1, length)).astype(np.int64)
    strip[top:bottom, margin : margin + length, :3] = colors[index, :3][: max(0, width - margin)]
    strip[top:bottom, margin : margin + length, 3] = 1
    _write(strip, title, (margin, round(1.2 * text)), text, ink)
    for value, label in _ticks(limits, max(2, length // (7 * text))):
        low, high = limits
        x = margin + round((value - low) / (high - low) * (length - 1))
        strip[bottom : bottom + text // 3, x : x + max(1, text // 8)] = (*ink, 1)
        half = text_width(label, text) // 2
        left = min(max(x - half, margin // 2), max(margin // 2, width - 2 * half - margin // 2))
        _write(strip, label, (left, round(4.3 * text)), text, ink)
    return np.concatenate((picture, to_bytes(strip[..., : picture.shape[2]])))


def _ticks(limits: tuple[float, float], count: int) -> list[tuple[float, str]]:
    """About ``count`` round numbers within the limits, with the digits that tell one from the next."""
    low, high = limits
    if not high > low:
        return []
    step = round_step((high - low) / count)
    numbers = np.arange(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [(float(n * step), f"{n * step:.{digits}f}".replace("-", "−")) for n in numbers]


class _Entry(NamedTuple):
    """Words, and before them a sample ``(rows, columns, 3)`` of what they name; ``least`` is the room it takes."""

    words: str
    sample: Floats
    least: int = 0


def with_legend(
    picture: Image, taken: Slice, *, caption: str, iso_step: float, unit: float = 1.0, bands: bool = True
) -> Image:
    """The picture of `draw_slice` with a strip under it that explains lines, colours and scale.

    ``caption`` names the plane. ``iso_step`` is in the field's units; ``unit`` input units are one of those, as shown.
    """
    width = picture.shape[1]
    text = round(float(np.clip(width / 48, 9, 40)))
    entries = _entries(taken, text, width, caption=caption, iso_step=iso_step, unit=unit, bands=bands)
    margin, gap, row = text, round(1.6 * text), round(1.9 * text)
    starts = [entry.sample.shape[1] + text // 2 if entry.sample.size else 0 for entry in entries]
    places, x, line = [], margin, 0
    for entry, start in zip(entries, starts, strict=True):
        needed = max(entry.least, start + text_width(entry.words, text))
        if x > margin and x + needed > width - margin:
            x, line = margin, line + 1
        places.append((x, line))
        x += needed + gap
    strip = np.ones((row * (line + 1) + text, width, 3), np.float32)
    for entry, start, (left, line) in zip(entries, starts, places, strict=True):
        height, columns = entry.sample.shape[:2]
        middle = text // 2 + line * row + row // 2
        shown = strip[middle - height // 2 :][:height, left : left + columns]
        shown[:] = entry.sample[:, : shown.shape[1]]
        _write(strip, entry.words, (left + start, middle), text, INK)
    return np.concatenate((picture, to_bytes(strip)))


def _entries(
    taken: Slice, text: int, width: int, *, caption: str, iso_step: float, unit: float, bands: bool
) -> list[_Entry]:
    height = taken.levels[-1].shape[0]
    bar = round_step(0.12 * width * taken.pixel * unit)
    reach = STYLE.fade * taken.pixel * height / 2
    far = np.linspace(-2.5 * reach, 2.5 * reach, 5 * text, dtype=np.float32)
    near = np.linspace(-1, 1, 2 * text, dtype=np.float32)
    gray = (0.45, 0.45, 0.45)
    entries = [
        # Wide enough for any number, so that nothing moves in an animation.
        _Entry(caption, _sample(0, 0, INK), least=round(9.5 * text)),
        _Entry(f"{bar:g}", _sample(2, max(1, round(bar / (taken.pixel * unit))), INK)),
        _Entry("inside, outside", _sample(text // 2, 5 * text, distance_color(far, reach=reach, slope=reach / text))),
        _Entry(f"iso-lines every {iso_step * unit:.6g}", _sample(round(STYLE.line * text / 16), 2 * text, gray)),
    ]
    count = len(taken.levels)
    for index in range(count):
        finest = index == count - 1 and taken.finest
        color = level_color(index)
        name = f"f{index}".translate(SUBSCRIPTS)
        entries.append(_Entry(f"{name} = 0", _sample(text // 6, 2 * text, FINEST if finest else color)))
        if bands and index < len(taken.deltas):
            words = f"|{name}| < {f'δ{index}'.translate(SUBSCRIPTS)} = {taken.deltas[index] * unit:.3g}"
            # A band as it looks: its tint over both sides of the surface.
            sides = distance_color(near, reach=20.0, slope=0.1)
            tinted = (1 - STYLE.tint) * sides + np.multiply(STYLE.tint, color)
            entries.append(_Entry(words, _sample(text, 2 * text, tinted)))
    return entries


def _sample(rows: int, columns: int, color: Floats | Color) -> Floats:
    """One colour, or one for each column, over a box at least a pixel high."""
    return np.broadcast_to(np.asarray(color, np.float32), (max(1, rows), columns, 3))


def _write(strip: Floats, words: str, place: tuple[int, int], text: int, ink: Color) -> None:
    """Words from ``place``, the middle of their left side."""
    cover = text_mask(strip.shape[:2], words, place, text)[..., None]
    strip += cover * (np.array((*ink, 1)[: strip.shape[2]], np.float32) - strip)
