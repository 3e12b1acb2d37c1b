"""From a run to the picture of a plane through its field, or to a film of the plane passing through the shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import Field, InputError, Similarity, load_field
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.meshing.extract import extract_mesh, surface_needed
from ..training.folder import chosen_level, find_field
from .film import ANIMATIONS, write_animation
from .legend import with_legend
from .picture import Image, write_picture
from .slice import draw_slice, plane_axes, round_step, take_slice


@dataclass(frozen=True)
class SliceOptions:
    """Which plane, and how it is drawn. Places are in input coordinates.

    Attributes:
        level: counted from 0, the coarsest; None is the finest.
        axis: the plane is across this one, "x", "y" or "z".
        at: place on that axis; None is the middle of the shape.
        percent: place on that axis instead, from 0 where the shape begins to 100 where it ends.
        up: "y" or "z", the axis that points up in the picture.
        size: width and height of the picture, without its legend.
        lines: about how many iso-lines fit between bottom and top.
        center: the middle of the picture (its nearest point on the plane); None is that of the shape.
    """

    level: int | None = None
    axis: str = "z"
    at: float | None = None
    percent: float | None = None
    up: str = "y"
    size: tuple[int, int] = (800, 800)
    lines: int = 40
    zoom: float = 1.0
    center: tuple[float, float, float] | None = None
    bands: bool = True
    frames: int = 96
    fps: float = 24.0


def slice_run(
    run: str | Path,
    out: str | Path,
    options: SliceOptions | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Draw a plane through the field of a run to a picture or film → what was drawn, in a few words.

    The plane of a film goes from the middle of the shape to both its ends and back, so that it can be repeated.
    ``progress`` is called with the number of frames so far, and of all. Raises an InputError if there is no such run or
    level, the plane misses the unit sphere, or the file cannot be written.
    """
    options, out = options or SliceOptions(), Path(out)
    file = find_field(run)
    field, similarity, _ = load_field(file)
    if field.in_dim != 3:
        raise InputError(f"{file}: a field of {field.in_dim} coordinates; slices are drawn of fields of 3")
    view = _View(file, field, similarity, chosen_level(field, file, options.level), options)
    if out.suffix.lower() not in ANIMATIONS:
        offset = view.offset()
        write_picture(out, view.draw(offset))
        return f"{view.caption(offset)}, iso-lines every {view.iso_step * similarity.scale:.6g}"
    turn = 2 * np.pi * np.arange(options.frames) / options.frames
    offsets = view.middle + 0.5 * (view.end - view.begin) * np.sin(turn)
    write_animation(out, _each_once(view.draw, offsets, progress), fps=options.fps)
    return f"{options.frames} slices, from {view.caption(view.begin)} to {view.caption(view.end)}"


class _View:
    """A family of parallel planes through a shape, all seen in one frame; an offset is a place along the normal."""

    def __init__(self, file: Path, field: Field, similarity: Similarity, level: int, options: SliceOptions) -> None:
        self.field, self.similarity, self.level, self.options = field, similarity, level, options
        self.normal = np.eye(3)["xyz".index(options.axis)]
        self.u, self.v = plane_axes(self.normal, up=options.up)
        with surface_needed(f"{file}: no surface to slice"):
            shape = extract_mesh(field, resolution=64, level=level).vertices
        axes = np.stack((self.u, self.v, self.normal), axis=1)
        low, high = (shape @ axes).min(axis=0), (shape @ axes).max(axis=0)  # (3,) right, up, towards the viewer
        self.begin, self.end = float(low[2]), float(high[2])
        self.middle = (self.begin + self.end) / 2
        half = (high - low) / 2
        width, height = options.size
        # The picture is larger than the shape by a margin.
        self.half_size = float(max(half[0] * height / width, half[1])) * 1.16 / options.zoom
        self.iso_step = round_step(2 * self.half_size * similarity.scale / options.lines) / similarity.scale
        center = (low + high)[:2] / 2
        if options.center is not None:
            center = similarity.to_unit(np.array(options.center)) @ axes[:, :2]
        self.center = center @ axes[:, :2].T  # on the plane of offset 0

    def offset(self) -> float:
        """Place of the plane along the normal; raises an InputError if it misses the unit sphere."""
        options = self.options
        offset = self.middle
        if options.percent is not None:
            offset = self.begin + (self.end - self.begin) * options.percent / 100
        elif options.at is not None:
            offset = float((self.similarity.to_unit(np.full(3, options.at)) * self.normal).sum())
        if not abs(offset) <= 1:
            begin, end = (self.position(place) for place in (self.begin, self.end))
            raise InputError(
                f"--at: the plane misses the shape, which reaches from {begin:.6g} to {end:.6g} along {options.axis} "
                "(coordinates of the input)"
            )
        return offset

    def position(self, offset: float) -> float:
        """The input coordinate along the normal of the plane at ``offset``."""
        return float(self.similarity.to_input(offset * self.normal) @ self.normal)

    def caption(self, offset: float) -> str:
        """Which plane, in words."""
        extent = (self.end - self.begin) * self.similarity.scale
        digits = max(0, 3 - math.floor(math.log10(extent))) if extent > 0 else 3
        place = f"{self.position(offset):.{digits}f}".replace("-", "−")
        return f"{self.options.axis} = {place}"

    def draw(self, offset: float) -> Image:
        """The picture of the plane at ``offset``, with its legend."""
        options = self.options
        taken = take_slice(
            self.field,
            origin=self.center + offset * self.normal,
            u=self.u,
            v=self.v,
            half_size=self.half_size,
            size=options.size,
            level=self.level,
        )
        picture = draw_slice(taken, iso_step=self.iso_step, bands=options.bands)
        return with_legend(
            picture,
            taken,
            caption=self.caption(offset),
            iso_step=self.iso_step,
            unit=self.similarity.scale,
            bands=options.bands,
        )


def _each_once(
    draw: Callable[[float], Image], offsets: Float64, progress: Callable[[int, int], None] | None
) -> Iterator[Image]:
    """The picture at each offset; it is kept, packed, for when the plane comes back."""
    packed: dict[float, NDArray[np.uint8]] = {}
    for place, offset in enumerate(np.round(offsets, 9).tolist()):
        if offset not in packed:
            packed[offset] = np.asarray(cv2.imencode(".png", draw(offset))[1], np.uint8)
        yield np.asarray(cv2.imdecode(packed[offset], cv2.IMREAD_COLOR), np.uint8)
        if progress is not None:
            progress(place + 1, len(offsets))
