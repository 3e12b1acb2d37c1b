"""From a run, a mesh or a cloud to a picture of it, or to a film around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...neural_fields import InputError, WorldField
from ..training.machine import choose_device
from .film import ANIMATIONS, write_animation
from .legend import with_color_bar
from .light import load_matcap
from .picture import Image, check_picture_path, contact_sheet, write_picture
from .shade import ShadeOptions, compose, default_shading, downsample, measure, shade, value_limits
from .subject import Orbit, Panel, Subject, open_subject, orbit_cameras, posed_cameras, reference_distance, subject_of
from .trace import Seen, fine_strips

__all__ = ["Painter", "RenderOptions", "render_run"]

Color = tuple[float, float, float]
Painter = Callable[[Camera, int], Image]
"""What a camera, in unit-sphere coordinates, sees of a level: a picture of its size."""

# What colours show, as the legend calls it, and the power of the input's unit it is measured in.
MEASURES = {
    "depth": ("distance from the camera", 1),
    "curvature": ("mean curvature, 1 / unit", -1),
    "error": ("distance to the reference", 1),
}


@dataclass(frozen=True)
class RenderOptions:
    """What is drawn, and how. Lengths and places are the input's.

    Attributes:
        size: width and height; of posed cameras only the width, the height follows. None is (640, 640), or that of
            the posed images.
        time: the moment, of a run that moves.
        level: of a field; None is the finest.
        normal_level: whose normals (neural normal mapping); None is ``level``.
        levels: all levels side by side, and the coarsest with the normals of the finest.
        sides: from so many directions side by side, evenly around the up axis from the orbit's azimuth on; each level
            then has a row of its own. Not of a film, nor from posed cameras.
        shading: one of `SHADINGS`; None is "lambert", or what a cloud without normals can show.
        shade: settings of the shading; ``limits`` in input units (curvature: in their inverse). Of a mesh or a cloud,
            shadows and occlusion are left out, as they are traced in a field.
        reference: cloud or mesh for the "error"; None is what the field was fitted to.
        orbit: where the camera stands.
        cameras: file of posed cameras instead, in input coordinates.
        frame: which of them, by name or index; of a film None, all.
        background: display RGB in [0, 1]; None is transparent.
        legend: whether a picture in a colour map's colours has a legend under it.
        samples: per pixel and direction.
        frames: of a turntable.
        fps: of a film.
        device: where to evaluate a field, "auto" is CUDA where there is one.
    """

    size: tuple[int, ...] | None = None
    time: float | None = None
    level: int | None = None
    normal_level: int | None = None
    levels: bool = False
    sides: int = 1
    shading: str | None = None
    shade: ShadeOptions = dataclasses.field(default_factory=lambda: ShadeOptions(shadows=True, occlusion=True))
    reference: str | Path | None = None
    orbit: Orbit = dataclasses.field(default_factory=Orbit)
    cameras: str | Path | None = None
    frame: str | None = None
    background: Color | None = (1.0, 1.0, 1.0)
    legend: bool = True
    samples: int = 2
    frames: int = 96
    fps: float = 24.0
    device: str = "auto"


def render_run(
    source: str | Path,
    out: str | Path,
    options: RenderOptions | None = None,
    *,
    painter: Painter | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Draw a run, a mesh or a cloud.

    A film goes once around the shape, or through the posed cameras in their order.

    Args:
        source: run directory, .safetensors file, mesh or cloud.
        out: a .png or .jpg picture, or an .mp4 or .gif film.
        options: what, and how.
        painter: draws in place of the shadings, background included; the subject then says where to look from.
        progress: called with how many parts are drawn, and of how many.

    Returns:
        What was drawn, in a few words.

    Raises:
        InputError: something cannot be read, is not there, or does not go together; or ``out`` cannot be written.
    """
    options, out = options or RenderOptions(), Path(out)
    film = out.suffix.lower() in ANIMATIONS
    if not film:
        check_picture_path(out, transparent=options.background is None)
    elif options.background is None:
        raise InputError(f"{out}: films know no transparency; write a .png, or give a background")
    if options.sides > 1 and (film or options.cameras is not None):
        raise InputError("--sides: goes with a picture of the orbit, not with a film or --cameras; leave it out")
    subject = open_subject(
        source,
        time=options.time,
        level=options.level,
        normal_level=options.normal_level,
        levels=options.levels,
        device=choose_device(options.device),
    )
    artist = _Artist(subject, options, painter)
    cameras = _cameras(subject, options, film=film)
    artist.fit_limits(cameras)
    if film:
        write_animation(out, artist.pictures([[camera] for camera in cameras], progress), fps=options.fps)
    else:
        write_picture(out, next(artist.pictures([cameras], progress)))
    return artist.caption(cameras)


def render_shape(
    shape: WorldField,
    path: str | Path | None = None,
    *,
    size: int | tuple[int, int] = 640,
    level: int = -1,
    up: str = "y",
    azimuth: float = 30.0,
    elevation: float = 15.0,
) -> Image:
    """Draw a field that need not be in any file; see `WorldField.render`.

    Raises:
        InputError: there is no surface, or the file cannot be written.
        ValueError: there is no such level.
    """
    if path is not None:
        check_picture_path(path)
    level = shape.field.resolve_level(level)
    panels = [Panel(f"level {level}", level, level)]
    subject = subject_of(shape.field, shape.similarity, name=Path(path or "shape"), panels=panels)
    orbit = Orbit(azimuth=azimuth, elevation=elevation, up=up)
    options = RenderOptions(size=size if isinstance(size, tuple) else (size,), orbit=orbit)
    picture = next(_Artist(subject, options).pictures([_cameras(subject, options, film=False)], None))
    if path is not None:
        write_picture(path, picture)
    return picture


def _cameras(subject: Subject, options: RenderOptions, *, film: bool) -> list[Camera]:
    if options.cameras is not None:
        if options.size is not None and len(options.size) != 1:
            raise InputError("--size: with --cameras give the width alone; the height follows from the images")
        width = None if options.size is None else options.size[0]
        return posed_cameras(options.cameras, options.frame, subject.similarity, width=width, film=film)
    if options.frame is not None:
        raise InputError(f"--frame {options.frame}: goes with --cameras FILE")
    size = (640,) if options.size is None else options.size
    return orbit_cameras(
        subject.outline(), options.orbit, size=(size[0], size[-1]), frames=options.frames if film else options.sides
    )


class _Artist:
    """Draws a subject in one manner, with one scale of colours for all pictures."""

    def __init__(self, subject: Subject, options: RenderOptions, painter: Painter | None = None) -> None:
        """Check that the subject can be drawn so, and read what that needs.

        Raises:
            InputError: it cannot.
        """
        self.subject, self.options, self.painter = subject, options, painter
        self.shading = options.shading or default_shading(oriented=subject.oriented, colored=subject.colored)
        # Normals do not show in depths and errors: another level's would only repeat a picture.
        mapped = self.shading not in ("depth", "error")
        self.panels = [
            panel for panel in subject.panels if mapped or panel.level == panel.normal_level
        ] or subject.panels[:1]
        self.unit = subject.similarity.scale ** MEASURES.get(self.shading, ("", 0))[1]
        if self.shading == "color" and not subject.colored:
            raise InputError(f"{subject.name}: has no colours for --shading color; leave it out")
        if self.shading == "curvature" and subject.field is None:
            raise InputError(f"{subject.name}: --shading curvature needs a field; render the run, not its mesh")
        shading_options = options.shade
        if subject.field is None:
            back = subject.panels[0].label == "mesh"
            shading_options = dataclasses.replace(shading_options, shadows=False, occlusion=False, back_faces=back)
        if options.shade.limits is not None:
            low, high = options.shade.limits
            shading_options = dataclasses.replace(shading_options, limits=(low / self.unit, high / self.unit))
        self.shade_options = shading_options
        self.matcap = load_matcap(options.shade.matcap) if self.shading == "matcap" else None
        self.reference = reference_distance(subject, options.reference) if self.shading == "error" else None
        self.anything = False

    def fit_limits(self, cameras: Sequence[Camera]) -> None:
        """Set the limits of the colour map, the same for all pictures, from small ones of some of them."""
        if self.shading not in MEASURES or self.shade_options.limits is not None:
            return
        values = []
        # Limits come from at most 12 small pictures, of 160 pixels on the longer side.
        for camera in cameras[:: math.ceil(len(cameras) / 12)]:
            share = min(1.0, 160 / max(camera.width, camera.height))
            small = camera.resized(math.ceil(share * camera.width), math.ceil(share * camera.height))
            values += [self._measure(self.subject.view(small, panel), panel) for panel in self.panels]
        limits = value_limits(torch.cat(values), self.shading, self.shade_options)
        if limits[0] < limits[1]:  # else all pixels show one number, and any limits will do
            self.shade_options = dataclasses.replace(self.shade_options, limits=limits)

    def pictures(
        self, views: Sequence[Sequence[Camera]], progress: Callable[[int, int], None] | None
    ) -> Iterator[Image]:
        """Each picture, from the cameras that are to be on it: one, or several of one size, side by side."""
        done = 0
        total = len(self.panels) * sum(len(self._strips(camera)) for cameras in views for camera in cameras)
        for cameras in views:
            lines: list[list[tuple[str, Image]]] = []
            for panel in self.panels:
                lines.append([])
                for index, camera in enumerate(cameras):
                    parts = []
                    for strip in self._strips(camera):
                        parts.append(self._draw(strip, panel))
                        done += 1
                        if progress is not None:
                            progress(done, total)
                    turned = f"{panel.label}, {self._azimuth(index, len(cameras)):.4g}°"
                    lines[-1].append((turned if len(cameras) > 1 else panel.label, np.concatenate(parts)))
            if len(cameras) == 1:
                lines = [[tile for line in lines for tile in line]]
            alone = len(lines) == len(lines[0]) == 1
            yield self._with_legend(lines[0][0][1] if alone else contact_sheet(*lines), cameras[0], alone=alone)

    @property
    def _views(self) -> str:
        """What several cameras are called."""
        return "sides" if self.options.sides > 1 else "frames"

    def _azimuth(self, index: int, sides: int) -> float:
        """Of one of the sides, in degrees from -180 to 180."""
        return (self.options.orbit.azimuth + 360 * index / sides + 180) % 360 - 180

    def caption(self, cameras: Sequence[Camera]) -> str:
        """What was drawn, in a few words."""
        first, count = cameras[0], len(cameras)
        what = ", ".join(panel.label for panel in self.panels)
        shading = "radiance" if self.painter else self.shading
        words = [what, shading, f"{first.width}×{first.height}" + (f", {count} {self._views}" if count > 1 else "")]
        if self.shading in MEASURES and self.shade_options.limits is not None:
            low, high = (limit * self.unit for limit in self.shade_options.limits)
            words[1] += f" from {low:.4g} to {high:.4g}"
        return ", ".join(words) + ("" if self.anything else "; nothing of it is in view")

    def _strips(self, camera: Camera) -> list[Camera]:
        """What is drawn at a time; little by little, where each ray costs as much as a painter's."""
        # A painter gets so many pixels between two reports.
        return fine_strips(camera, self.options.samples, pixels=1 << 14 if self.painter else None)

    def _draw(self, camera: Camera, panel: Panel) -> Image:
        if self.painter is not None:
            self.anything = True
            return downsample(self.painter(camera, panel.level), self.options.samples)
        seen = self.subject.view(camera, panel)
        rgb = seen.position
        if len(seen.pixel):
            self.anything = True
            rgb = self._colors(seen, camera, panel)
        return downsample(compose(seen, rgb, background=self.options.background), self.options.samples)

    def _colors(self, seen: Seen, camera: Camera, panel: Panel) -> Tensor:
        return shade(
            seen,
            self.shading,
            camera=camera,
            field=self.subject.field,
            level=panel.level,
            options=self.shade_options,
            matcap=self.matcap,
            values=self._measure(seen, panel) if self.shading in MEASURES else None,
        )

    def _measure(self, seen: Seen, panel: Panel) -> Tensor:
        if not len(seen.pixel):
            return seen.depth
        if self.reference is not None:
            return self.reference(seen.position)
        return measure(
            seen,
            self.shading,
            field=self.subject.field,
            level=panel.normal_level,  # a curvature is how the normals turn
            detail=self.shade_options.detail,
        )

    def _with_legend(self, picture: Image, camera: Camera, *, alone: bool) -> Image:
        limits = self.shade_options.limits
        if not self.options.legend or self.shading not in MEASURES or limits is None:
            return picture
        title = MEASURES[self.shading][0]
        shown = (limits[0] * self.unit, limits[1] * self.unit)
        paper = self.options.background if alone else (1.0, 1.0, 1.0)
        return with_color_bar(picture, self._scale(camera, limits), shown, title=title, background=paper)

    def _scale(self, camera: Camera, limits: tuple[float, float]) -> NDArray[np.float32]:
        """The colours ``(256, 3)`` of the map, as a surface that faces the eye shows them."""
        values = torch.linspace(*limits, 256)
        forward = camera.forward.float().expand(256, 3)
        facing = Seen((256, 1), torch.arange(256), values, forward, -forward, forward)
        return shade(facing, self.shading, camera=camera, options=self.shade_options, values=values).numpy()
