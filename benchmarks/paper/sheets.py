"""Contact sheets: the input, every mesh of a shape with its Chamfer distance, and the reference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
from mplicits.datasets import orbit
from mplicits.pipelines.render.picture import Image, contact_sheet, in_rows, write_picture
from mplicits.pipelines.render.rasterise import picture_of
from mplicits.pipelines.surface.surface import from_cloud

from ..harness.jobs import Context, Record
from .jobs import PaperJob
from .judge import damaged_cloud, protocol_of, reference_of

COLUMNS = 4
LEAST_METHODS = 2  # a sheet of one method compares nothing


def write_sheets(name: str, records: Mapping[PaperJob, Record], out: Path) -> tuple[tuple[str, str], ...]:
    """Write one sheet for each shape and damage into ``out / "sheets"``.

    Args:
        name: of the table.
        records: of its jobs; of one shape and damage, their outputs must have different names.
        out: folder of the bench.

    Returns:
        Files relative to ``out``, and titles.
    """
    groups: dict[tuple[Path, float, float, float], list[PaperJob]] = {}
    for job in records:
        groups.setdefault((job.shape, job.noise, job.outliers, job.flipped), []).append(job)
    written = []
    for jobs in groups.values():
        if len(jobs) < LEAST_METHODS:
            continue
        (out / "sheets").mkdir(exist_ok=True)
        damaged, *_ = jobs[0].name.split(", ")
        file = f"sheets/{name}-{damaged.replace(' + ', '-').replace(' ', '-')}.jpg"
        tiles = _tiles({job: records[job] for job in jobs}, out)
        write_picture(out / file, contact_sheet(*in_rows(tiles, COLUMNS)))
        written.append((file, f"{name}: {damaged}"))
    return tuple(written)


def _tiles(records: Mapping[PaperJob, Record], out: Path) -> list[tuple[str, Image]]:
    first = next(iter(records))
    size, reference = protocol_of(first.preset).tile, reference_of(first)
    camera = orbit(reference.vertices, width=size, height=size)
    tiles = [("input", picture_of(from_cloud(damaged_cloud(first)), camera))]
    for record in records.values():
        for output in record["outputs"]:
            file = Context(out, record["key"]).picture(output["name"])
            if output["chamfer"] is not None and file.is_file():
                picture = np.asarray(iio.imread(file))[..., :3].astype(np.uint8)
                if picture.shape[:2] != (size, size):
                    picture = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA).astype(np.uint8)
                tiles.append((f"{output['name']}  {output['chamfer']:.1e}", picture))
    return [*tiles, ("reference", picture_of(reference, camera))]
