"""Pictures as arrays and files: ``(H, W, 3)`` uint8 RGB, first row on top, or ``(H, W, 4)`` with an alpha channel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np

from ...neural_fields import InputError
from ...neural_fields.backend.arrays import Image
from ...neural_fields.backend.files import check_place, write_whole

Color = tuple[float, float, float]
Titled = tuple[str, Image]


def contact_sheet(*rows: Sequence[Titled], gap: int = 12, strip: int = 40) -> Image:
    """Rows of titled pictures, each row of one height; shorter rows are filled up with white.

    ``gap`` and ``strip`` are the space between pictures and the height of titles, in pixels.
    """
    return stacked([_row(pictures, gap, strip) for pictures in rows])


def in_rows(pictures: Sequence[Titled], columns: int) -> list[Sequence[Titled]]:
    """Pictures in rows of ``columns``, for `contact_sheet`; the last row may be shorter."""
    return [pictures[first : first + columns] for first in range(0, len(pictures), columns)]


def stacked(rows: Sequence[Image], *, gap: int = 0) -> Image:
    """Pictures one under the other, on white as wide as the widest, with ``gap`` rows of pixels below each."""
    width = max(row.shape[1] for row in rows)
    return np.concatenate(
        [np.pad(row, ((0, gap), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    )


def _row(pictures: Sequence[Titled], gap: int, strip: int) -> Image:
    heights = {image.shape[0] for _, image in pictures}
    if len(heights) != 1:
        raise ValueError(f"pictures: expected at least one, all of one height; got heights {sorted(heights)}")
    tiles = []
    for title, image in pictures:
        tile = np.full((image.shape[0] + strip, image.shape[1] + gap, 3), 255, np.uint8)
        tile[strip:, gap // 2 : gap // 2 + image.shape[1]] = image
        scale = 0.6
        (width, _), _ = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        scale = min(scale, scale * (image.shape[1] - 2 * gap) / max(width, 1))
        cv2.putText(tile, title, (gap, strip - 14), cv2.FONT_HERSHEY_SIMPLEX, scale, (40, 40, 40), 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)


def check_picture_path(path: str | Path, *, transparent: bool = False) -> None:
    """Raise an InputError before any work if `write_picture` could not write a picture there."""
    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: pictures are written as .png or .jpg")
    if transparent and path.suffix.lower() != ".png":
        raise InputError(f"{path}: JPEG knows no transparency; write a .png, or give a background")
    check_place(path)


def picture_bytes(image: Image, suffix: str = ".png") -> bytes:
    """What a file of a picture holds; see `write_picture`."""
    return iio.imwrite("<bytes>", image, extension=suffix)


def write_picture(path: str | Path, image: Image) -> None:
    """Write a PNG ``(H, W, 3 | 4)`` or a JPEG ``(H, W, 3)``, whole or not at all; raises InputError."""
    path = Path(path)
    check_picture_path(path, transparent=image.shape[2] == 4)
    write_whole(path, picture_bytes(image, path.suffix.lower()))
