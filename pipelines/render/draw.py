"""From a run, a mesh or a cloud to a picture of it, or to a film around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.cameras import Camera, Float64, turntable
from ...datasets.textured.mesh import TexturedMesh
from ...datasets.views.images import read_cameras
from ...neural_fields import Field, InputError, Similarity, WorldField
from ...neural_fields.backend.devices import choose_device
from ...neural_fields.meshing.extract import extract_mesh, surface_needed
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS
from ..fit.cloud import CloudDistance
from ..surface.surface import read_surface, sample_points
from ..texture.transport import Colors, colors_of_run
from ..training.folder import chosen_level, find_field, fitted_cloud, is_field, load_still
from .film import ANIMATIONS, write_animation
from .legend import with_color_bar
from .picture import Color, Image, check_picture_path, contact_sheet, write_picture
from .rasterise import cloud_view, mesh_view, read_painted
from .shade import SCALES, ShadeOptions, compose, default_shading, downsample, measure, shade, value_limits
from .trace import Seen, fine_strips, trace_view

FRAME_RESOLUTION = 128  # of the mesh that says what the camera has to look at


@dataclass(frozen=True)
class Panel:
    """One of the pictures side by side: its title, the level that is visible, and the level of the normals."""

    label: str
    level: int = 0
    normal_level: int = 0


@dataclass(frozen=True)
class Subject:
    """What is drawn, in unit-sphere coordinates.

    Attributes:
        similarity: from input coordinates to those.
        field: what is traced; None for a mesh or a cloud.
        colored: whether it has colours of its own.
        oriented: whether it has normals.
        outline: points ``(N, 3)`` that a camera has to have in view.
        view: what the pixels of a camera see.
        fitted_to: finds the fitted cloud, or raises an InputError; None for a mesh or a cloud.
    """

    name: Path
    similarity: Similarity
    panels: tuple[Panel, ...]
    field: Field | None
    colored: bool
    oriented: bool
    outline: Callable[[], Float64]
    view: Callable[[Camera, Panel], Seen]
    fitted_to: Callable[[], Path] | None = None


def open_subject(source: str | Path, options: RenderOptions | None = None) -> Subject:
    """Open a run, a .safetensors file, a mesh or a cloud, at the time and with the levels of the ``options``.

    Raises an InputError if it cannot be read or there is no such level.
    """
    options = options or RenderOptions()
    if is_field(source):
        return _field_subject(find_field(source), options)
    given = {"--level": options.level, "--normal-level": options.normal_level, "--levels": options.levels or None}
    for flag in (flag for flag, value in given.items() if value is not None):
        raise InputError(f"{flag}: {source} has no levels; render the run that it was made from")
    if options.time is not None:
        raise InputError(f"--time {options.time:g}: {source} does not move; leave it out")
    return _surface_subject(Path(source))


def _field_subject(file: Path, options: RenderOptions) -> Subject:
    field, similarity, metadata = load_still(file, options.time, device=choose_device(options.device))
    finest = field.num_levels - 1
    level = chosen_level(field, file, options.level)
    normal_level = chosen_level(field, file, options.normal_level, otherwise=level, flag="--normal-level")
    panels = [_panel(level, normal_level)]
    if options.levels:
        panels = [_panel(index, index) for index in range(finest + 1)] + ([_panel(0, finest)] if finest else [])
    subject = subject_of(field, similarity, name=file, panels=panels, colors=colors_of_run(file, field, options.time))
    source = lambda: fitted_cloud(file, metadata, remedy="name it with --reference FILE")  # noqa: E731
    return dataclasses.replace(subject, fitted_to=source)


def subject_of(
    field: Field, similarity: Similarity, *, name: Path, panels: Sequence[Panel], colors: Colors | None = None
) -> Subject:
    """A three-dimensional field to draw, evaluated on its own device; ``name`` is for messages."""

    def view(camera: Camera, panel: Panel) -> Seen:
        return trace_view(
            field, camera, level=panel.level, normal_level=panel.normal_level, colors=colors, device=field.like.device
        )

    return Subject(
        name=name,
        similarity=similarity,
        panels=tuple(panels),
        field=field,
        colored=colors is not None,
        oriented=True,
        outline=lambda: _outline(name, field),
        view=view,
    )


def _panel(level: int, normal_level: int) -> Panel:
    mapped = "" if normal_level == level else f" + normals of level {normal_level}"
    return Panel(f"level {level}{mapped}", level, normal_level)


def _outline(file: Path, field: Field) -> Float64:
    """Points of the finest level, whichever is drawn, so that one camera serves all levels and a mesh of them."""
    with surface_needed(f"{file}: no surface to render"):
        return traced_part(extract_mesh(field, resolution=FRAME_RESOLUTION).vertices)


def traced_part(points: Float64) -> Float64:
    """The points ``(N, 3)`` of a mesh inside the ball in which rays are traced; all if none are."""
    inside = np.linalg.norm(points, axis=1) <= BOUNDING_RADIUS
    return points[inside] if inside.any() else points


def _surface_subject(file: Path) -> Subject:
    surface = read_painted(file)
    solid = bool(len(surface.faces))
    used = surface.vertices[np.unique(surface.faces)] if solid else surface.vertices
    try:
        similarity = Similarity.to_unit_sphere(used)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    moved = dataclasses.replace(surface, vertices=similarity.to_unit(surface.vertices))
    disc = 0.0 if solid else disc_size(moved.vertices)

    def view(camera: Camera, _panel: Panel) -> Seen:
        if isinstance(moved, TexturedMesh) or solid:
            return mesh_view(moved, camera)
        distance = max(float(camera.eye.norm()), 1e-3)
        size = disc * float(camera.intrinsics[1, 1]) / distance
        return cloud_view(moved, camera, point_size=max(size, 1.0))

    return Subject(
        name=file,
        similarity=similarity,
        panels=(Panel("mesh" if solid else "cloud"),),
        field=None,
        colored=isinstance(surface, TexturedMesh) or surface.colors is not None,
        oriented=isinstance(surface, TexturedMesh) or solid or surface.normals is not None,
        outline=lambda: similarity.to_unit(used),
        view=view,
    )


def disc_size(points: NDArray[np.floating]) -> float:
    """The diameter of the discs that stand for points ``(N, 3)``: 2.2 times the distance of most neighbours."""
    chosen = points[:: max(1, len(points) // 20_000)]
    return 2.2 * float(np.quantile(KDTree(points).query(chosen, k=2)[0][:, 1], 0.9))


def reference_distance(subject: Subject, reference: str | Path | None) -> Callable[[Tensor], Tensor]:
    """A function from points ``(P, 3)`` to their distances ``(P,)`` from a cloud or mesh, in the subject's coordinates.

    Without a reference, it is the fitted cloud. Points with normals stand for discs (`CloudDistance`), so a surface
    through them has no error; the distance to bare points is never below their spacing. Raises InputError.
    """
    if reference is None:
        if subject.fitted_to is None:
            raise InputError(
                f"{subject.name}: --shading error needs a cloud to measure from; name it with --reference FILE"
            )
        reference = subject.fitted_to()
    surface = read_surface(reference)
    points, normals = surface.vertices, surface.normals
    if len(surface.faces):
        points, normals = sample_points(surface, 500_000, np.random.default_rng(0))
    points = subject.similarity.to_unit(points)
    if normals is None:
        tree = KDTree(points)
        return lambda places: torch.as_tensor(tree.query(places.cpu().double().numpy(), workers=-1)[0]).to(places)
    known = np.linalg.norm(normals, axis=1) > 0.5
    if known.sum() < 2:
        raise InputError(f"{reference}: fewer than two points with normals; nothing can be measured from it")
    cloud = CloudDistance(torch.from_numpy(points[known]), torch.from_numpy(normals[known]))
    # Wider discs leave no gaps between points that are spread at random.
    cloud.radii *= 2.0
    return lambda places: cloud.signed(places).abs().to(places)


@dataclass(frozen=True)
class Orbit:
    """A camera on a sphere around the shape; see `datasets.cameras.orbit` for what the numbers mean."""

    azimuth: float = 30.0
    elevation: float = 15.0
    up: str = "y"
    fov: float = 25.0
    zoom: float = 1.0


def orbit_cameras(outline: Float64, orbit: Orbit, *, size: tuple[int, int], frames: int) -> list[Camera]:
    """Cameras once around the points ``(N, 3)``, all at one distance."""
    return turntable(outline, frames, width=size[0], height=size[1], **vars(orbit))


def posed_cameras(
    file: str | Path, frame: str | None, similarity: Similarity, *, width: int | None, film: bool
) -> list[Camera]:
    """The cameras of a transforms.json or cameras_sphere.npz, in unit-sphere coordinates, for a ``width`` in pixels.

    A film takes all cameras, a picture the one that ``frame`` names. Raises an InputError if the file cannot be read,
    has no such frame, or its images differ in size.
    """
    named = read_cameras(file)
    if film and frame is not None:
        raise InputError("--frame: a film goes through all the cameras; leave it out, or write a picture (.png)")
    chosen = named if film else [choose_frame(file, named, frame)]
    cameras = [camera.moved(similarity) for _, camera in chosen]
    if width is not None:
        cameras = [part.resized(width, max(1, round(part.height * width / part.width))) for part in cameras]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}×{height}" for width, height in sizes[:3])
        raise InputError(f"{file}: the images have {len(sizes)} sizes ({shown}); a film needs one; choose a --frame")
    return cameras


def choose_frame(file: str | Path, named: Sequence[tuple[str, Camera]], frame: str | None) -> tuple[str, Camera]:
    """One camera by name (with or without folder and extension) or index from 0; the only one for None."""
    names = [name for name, _ in named]
    some = f"has {len(names)} cameras, {names[0]} to {names[-1]}"
    if frame is None:
        if len(named) > 1:
            raise InputError(f"{file}: {some}; choose one with --frame NAME or an index from 0")
        return named[0]
    for key in (str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem):
        found = [pair for pair in named if key(pair[0]) == frame]
        if len(found) == 1:
            return found[0]
    if frame.isdecimal() and int(frame) < len(named):
        return named[int(frame)]
    raise InputError(f"--frame {frame}: {file} {some}; none, or more than one, is called that")


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
        size: width and height; the width alone for posed cameras. None is (640, 640), or that of the posed images.
        time: the moment, for a run that moves.
        level: of a field; None is the finest.
        normal_level: the level of the normals (neural normal mapping); None is ``level``.
        levels: all levels side by side, and the coarsest with the normals of the finest.
        sides: number of directions side by side, evenly around the up axis; not for films or posed cameras.
        shading: one of `SHADINGS`; None is "lambert", or what a cloud without normals can show.
        shade: settings of the shading; ``limits`` in input units (curvature: their inverse). Meshes and clouds have no
            shadows or occlusion.
        reference: cloud or mesh for the "error"; None is what the field was fitted to.
        cameras: file of posed cameras, in place of ``orbit``, in input coordinates.
        frame: which of them, by name or index; None takes all for a film.
        background: display RGB in [0, 1]; None is transparent.
        legend: whether a picture in a colour map's colours has a legend under it.
        samples: per pixel and direction.
        frames: of a turntable.
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
    """Draw a run, a mesh or a cloud; a film goes once around the shape, or through the posed cameras in order.

    ``painter`` draws in place of the shadings, background included; ``progress`` is called with the number of parts
    drawn, and their total. Returns what was drawn, in a few words. Raises an InputError if something cannot be read or
    does not go together, or ``out`` cannot be written.
    """
    options, out = options or RenderOptions(), Path(out)
    film = out.suffix.lower() in ANIMATIONS
    if not film:
        check_picture_path(out, transparent=options.background is None)
    elif options.background is None:
        raise InputError(f"{out}: films know no transparency; write a .png, or give a background")
    if options.sides > 1 and (film or options.cameras is not None):
        raise InputError("--sides: goes with a picture of the orbit, not with a film or --cameras; leave it out")
    subject = open_subject(source, options)
    artist = _Artist(subject, options, painter)
    cameras = _cameras(subject, options, film=film)
    artist.fit_limits(cameras)
    if film:
        write_animation(out, artist.pictures([[camera] for camera in cameras], progress), fps=options.fps)
    else:
        write_picture(out, next(artist.pictures([cameras], progress)))
    return artist.caption(cameras)


def render_shape(
    shape: WorldField, path: str | Path | None = None, *, size: int | tuple[int, int], level: int, **orbit: Any
) -> Image:
    """Draw a field that need not be in a file; see `WorldField.render`."""
    if path is not None:
        check_picture_path(path)
    level = shape.field.resolve_level(level)
    panels = [Panel(f"level {level}", level, level)]
    subject = subject_of(shape.field, shape.similarity, name=Path(path or "shape"), panels=panels)
    options = RenderOptions(size=size if isinstance(size, tuple) else (size,), orbit=Orbit(**orbit))
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
        """Check that the subject can be drawn so, and read what that needs; raises InputError."""
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
                    azimuth = self.options.orbit.azimuth + 360 * index / len(cameras)
                    turned = f"{panel.label}, {(azimuth + 180) % 360 - 180:.4g}°"
                    lines[-1].append((turned if len(cameras) > 1 else panel.label, np.concatenate(parts)))
            if len(cameras) == 1:
                lines = [[tile for line in lines for tile in line]]
            alone = len(lines) == len(lines[0]) == 1
            yield self._with_legend(lines[0][0][1] if alone else contact_sheet(*lines), alone=alone)

    def caption(self, cameras: Sequence[Camera]) -> str:
        """What was drawn, in a few words."""
        first, count, several = cameras[0], len(cameras), "sides" if self.options.sides > 1 else "frames"
        what = ", ".join(panel.label for panel in self.panels)
        shading = "radiance" if self.painter else self.shading
        words = [what, shading, f"{first.width}×{first.height}" + (f", {count} {several}" if count > 1 else "")]
        if self.shading in MEASURES and self.shade_options.limits is not None:
            low, high = (limit * self.unit for limit in self.shade_options.limits)
            words[1] += f" from {low:.4g} to {high:.4g}"
        return ", ".join(words) + ("" if self.anything else "; nothing of it is in view")

    def _strips(self, camera: Camera) -> list[Camera]:
        """What is drawn at a time; little by little, where each ray costs as much as a painter's."""
        # Pixels that a painter draws between two reports.
        return fine_strips(camera, self.options.samples, pixels=1 << 14 if self.painter else None)

    def _draw(self, camera: Camera, panel: Panel) -> Image:
        if self.painter is not None:
            self.anything = True
            return downsample(self.painter(camera, panel.level), self.options.samples)
        seen = self.subject.view(camera, panel)
        rgb = seen.position
        if len(seen.pixel):
            self.anything = True
            rgb = shade(
                seen,
                self.shading,
                camera=camera,
                field=self.subject.field,
                level=panel.level,
                options=self.shade_options,
                values=self._measure(seen, panel) if self.shading in MEASURES else None,
            )
        return downsample(compose(seen, rgb, background=self.options.background), self.options.samples)

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

    def _with_legend(self, picture: Image, *, alone: bool) -> Image:
        limits = self.shade_options.limits
        if not self.options.legend or self.shading not in MEASURES or limits is None:
            return picture
        title = MEASURES[self.shading][0]
        shown = (limits[0] * self.unit, limits[1] * self.unit)
        paper = self.options.background if alone else (1.0, 1.0, 1.0)
        return with_color_bar(picture, SCALES[self.shading], shown, title=title, background=paper)
