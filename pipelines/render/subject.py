"""What ``mplicits render`` draws, and from where: a fitted field or the mesh or cloud of a file, and its cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.cameras import Camera, turntable
from ...datasets.textured.mesh import TexturedMesh
from ...datasets.views.images import read_cameras
from ...neural_fields import Field, InputError, Similarity
from ...neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS
from ..fit.cloud import CloudDistance
from ..surface.surface import read_surface, sample_points
from ..texture.transport import Colors, colors_of_run
from ..training.folder import chosen_level, find_field, fitted_cloud, is_field, load_still
from .rasterise import cloud_view, mesh_view, read_painted
from .trace import Seen, trace_view

__all__ = [
    "Orbit",
    "Panel",
    "Subject",
    "choose_frame",
    "disc_size",
    "open_subject",
    "orbit_cameras",
    "posed_cameras",
    "reference_distance",
    "traced_part",
]

Float64 = NDArray[np.float64]

FRAME_RESOLUTION = 128  # of the mesh that says what the camera has to look at


@dataclass(frozen=True)
class Panel:
    """One of the pictures that stand side by side.

    Attributes:
        label: over it.
        level: whose surface is seen.
        normal_level: whose normals.
    """

    label: str
    level: int = 0
    normal_level: int = 0


@dataclass(frozen=True)
class Subject:
    """Something to draw, in unit-sphere coordinates.

    Attributes:
        name: of the file, for messages.
        similarity: from input coordinates to those.
        panels: what to draw of it, at least one.
        field: what is traced; None for a mesh or a cloud.
        colored: whether it has colours of its own.
        oriented: whether it has normals.
        fitted_to: finds the cloud that the field was fitted to, or raises an InputError; None for a mesh or a cloud.
        outline: points ``(N, 3)`` that a camera has to have in view.
        view: what the pixels of a camera see.
    """

    name: Path
    similarity: Similarity
    panels: tuple[Panel, ...]
    field: Field | None
    colored: bool
    oriented: bool
    fitted_to: Callable[[], Path] | None
    outline: Callable[[], Float64]
    view: Callable[[Camera, Panel], Seen]


def open_subject(
    source: str | Path,
    *,
    time: float | None = None,
    level: int | None = None,
    normal_level: int | None = None,
    levels: bool = False,
    device: torch.device | str = "cpu",
) -> Subject:
    """Open a run, a .safetensors file, a mesh or a cloud.

    Args:
        source: which.
        time: the moment, of a run that moves.
        level: to draw; by default the finest.
        normal_level: whose normals; by default ``level``.
        levels: whether to draw all levels side by side, and the coarsest with the normals of the finest.
        device: where to evaluate a field.

    Raises:
        InputError: it cannot be read, or there is no such level.
    """
    if is_field(source):
        return _field_subject(find_field(source), time, level, normal_level, levels, device)
    for flag, given in (("--level", level), ("--normal-level", normal_level), ("--levels", levels or None)):
        if given is not None:
            raise InputError(f"{flag}: {source} has no levels; render the run that it was made from")
    if time is not None:
        raise InputError(f"--time {time:g}: {source} does not move; leave it out")
    return _surface_subject(Path(source))


def _field_subject(
    file: Path,
    time: float | None,
    level: int | None,
    normal_level: int | None,
    levels: bool,
    device: torch.device | str,
) -> Subject:
    field, similarity, metadata = load_still(file, time, device=device)
    finest = field.num_levels - 1
    level = chosen_level(field, file, level)
    normal_level = chosen_level(field, file, normal_level, otherwise=level, flag="--normal-level")
    panels = [_panel(level, normal_level)]
    if levels:
        panels = [_panel(index, index) for index in range(finest + 1)] + ([_panel(0, finest)] if finest else [])
    subject = subject_of(field, similarity, name=file, panels=panels, colors=colors_of_run(file, field, time))
    source = lambda: fitted_cloud(file, metadata, remedy="name it with --reference FILE")  # noqa: E731
    return dataclasses.replace(subject, fitted_to=source)


def subject_of(
    field: Field,
    similarity: Similarity,
    *,
    name: Path,
    panels: Sequence[Panel],
    colors: Colors | None = None,
) -> Subject:
    """A field to draw.

    Args:
        field: three-dimensional, on the device where it shall be evaluated.
        similarity: from input coordinates to those of the field.
        name: for messages.
        panels: what to draw of it.
        colors: of points of its surface, if it has some.
    """
    device = field.like.device

    def view(camera: Camera, panel: Panel) -> Seen:
        return trace_view(
            field, camera, level=panel.level, normal_level=panel.normal_level, colors=colors, device=device
        )

    return Subject(
        name=name,
        similarity=similarity,
        panels=tuple(panels),
        field=field,
        colored=colors is not None,
        oriented=True,
        fitted_to=None,
        outline=lambda: _outline(name, field),
        view=view,
    )


def _panel(level: int, normal_level: int) -> Panel:
    mapped = "" if normal_level == level else f" + normals of level {normal_level}"
    return Panel(f"level {level}{mapped}", level, normal_level)


def _outline(file: Path, field: Field) -> Float64:
    """Points of the finest level, whichever is drawn, so that one camera serves all levels and a mesh of them."""
    try:
        vertices = extract_mesh(field, resolution=FRAME_RESOLUTION).vertices.astype(np.float64)
    except NoSurfaceError as error:
        raise InputError(f"{file}: no surface to render ({error})") from error
    return traced_part(vertices)


def traced_part(points: Float64) -> Float64:
    """Those of the points ``(N, 3)`` of a mesh that rays reach, or all if none are.

    An open surface may go on to the corners of the mesher's cube, but is not traced there.
    """
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
        fitted_to=None,
        outline=lambda: similarity.to_unit(used),
        view=view,
    )


def disc_size(points: NDArray[np.floating]) -> float:
    """The diameter of the discs that stand for points ``(N, 3)``: 2.2 times the distance of most neighbours."""
    chosen = points[:: max(1, len(points) // 20_000)]
    return 2.2 * float(np.quantile(KDTree(points).query(chosen, k=2)[0][:, 1], 0.9))


def reference_distance(subject: Subject, reference: str | Path | None) -> Callable[[Tensor], Tensor]:
    """What measures how far points ``(P, 3)`` are from a reference, ``(P,)``, in the coordinates of the subject.

    Where the reference has normals, its points stand for discs that fill the gaps between them (`CloudDistance`), and
    a surface through them has no error; the distance to bare points is never less than their spacing allows.

    Args:
        subject: what is drawn.
        reference: a cloud, or a mesh, of which points are sampled; by default what the field was fitted to.

    Raises:
        InputError: there is none, or it cannot be read.
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
    """Cameras once around the points ``outline`` ``(N, 3)``, all at one distance.

    Raises:
        ValueError: an argument is out of its range, or all points are the same.
    """
    return turntable(outline, frames, width=size[0], height=size[1], **vars(orbit))


def posed_cameras(
    file: str | Path, frame: str | None, similarity: Similarity, *, width: int | None, film: bool
) -> list[Camera]:
    """The cameras of a file, in unit-sphere coordinates.

    Args:
        file: transforms.json or cameras_sphere.npz.
        frame: which camera, see `choose_frame`; for a film None, which means all of them.
        similarity: from the file's coordinates, which are those of the input.
        width: of the pictures, in pixels; the height follows. By default that of the images.
        film: whether a film is made.

    Raises:
        InputError: the file cannot be read, has no such frame, or its images are not of one size.
    """
    named = read_cameras(file)
    if film and frame is not None:
        raise InputError("--frame: a film goes through all the cameras; leave it out, or write a picture (.png)")
    chosen = named if film else [choose_frame(file, named, frame)]
    cameras = [_scaled(camera, width).moved(similarity) for _, camera in chosen]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}×{height}" for width, height in sizes[:3])
        raise InputError(f"{file}: the images have {len(sizes)} sizes ({shown}); a film needs one; choose a --frame")
    return cameras


def choose_frame(file: str | Path, named: Sequence[tuple[str, Camera]], frame: str | None) -> tuple[str, Camera]:
    """One of the cameras: by name, with or without folder and extension, or by index from 0; the only one by None.

    Raises:
        InputError: there is none of that name, or there are several.
    """
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


def _scaled(camera: Camera, width: int | None) -> Camera:
    if width is None:
        return camera
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))
