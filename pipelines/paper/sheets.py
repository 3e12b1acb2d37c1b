"""Contact sheets: the input, every mesh of a shape with its Chamfer distance, and the reference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np

from ...datasets import orbit
from ..bench.cells import Cell, Record, Workplace
from ..render.rasterise import Image, contact_sheet, picture_of, write_picture
from ..surface.surface import from_cloud
from .judge import damaged_cloud, protocol_of, reference_of

__all__ = ["in_rows", "write_sheets"]

COLUMNS = 4
LEAST_METHODS = 2  # a sheet of one method compares nothing


def in_rows(tiles: list[tuple[str, Image]], columns: int = COLUMNS) -> Image:
    """Pictures of one size in rows of ``columns``, each under its label; the last row is filled up with white."""
    rows = [contact_sheet(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)


def write_sheets(name: str, records: Mapping[Cell, Record], out: Path) -> tuple[tuple[str, str], ...]:
    """Write one sheet for each shape and damage into ``out / "sheets"``.

    Args:
        name: of the table.
        records: of its cells; of one shape and damage, their outputs must have different names.
        out: folder of the bench.

    Returns:
        Files relative to ``out``, and titles.
    """
    groups: dict[tuple[Path, float, float, float], list[Cell]] = {}
    for cell in records:
        groups.setdefault((cell.shape, cell.noise, cell.outliers, cell.flipped), []).append(cell)
    written = []
    for cells in groups.values():
        if len(cells) < LEAST_METHODS:
            continue
        (out / "sheets").mkdir(exist_ok=True)
        damaged, *_ = cells[0].name.split(", ")
        file = f"sheets/{name}-{damaged.replace(' + ', '-').replace(' ', '-')}.jpg"
        write_picture(out / file, in_rows(_tiles({cell: records[cell] for cell in cells}, out)))
        written.append((file, f"{name}: {damaged}"))
    return tuple(written)


def _tiles(records: Mapping[Cell, Record], out: Path) -> list[tuple[str, Image]]:
    first = next(iter(records))
    size, reference = protocol_of(first.preset).tile, reference_of(first)
    camera = orbit(reference.vertices, width=size, height=size)
    tiles = [("input", picture_of(from_cloud(damaged_cloud(first)), camera))]
    for record in records.values():
        for output in record["outputs"]:
            file = Workplace(out, record["key"]).picture(output["name"])
            if output["chamfer"] is not None and file.is_file():
                picture = np.asarray(iio.imread(file))[..., :3].astype(np.uint8)
                if picture.shape[:2] != (size, size):
                    picture = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA).astype(np.uint8)
                tiles.append((f"{output['name']}  {output['chamfer']:.1e}", picture))
    return [*tiles, ("reference", picture_of(reference, camera))]
