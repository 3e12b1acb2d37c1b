"""A surface that moves, written down: a film, a sheet of moments, a folder of meshes, or one mesh that moves."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...neural_fields import Field, InputError, Similarity, load_field
from ...neural_fields.backend.devices import choose_device
from ...neural_fields.backend.files import check_place
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing.extract import NoSurfaceError, extract_mesh, surface_of
from ...neural_fields.spacetime.dynamic_tracing import DynamicTracer, moment
from ..mesh.files import write_mesh, write_moving
from ..render.draw import Orbit, orbit_cameras, traced_part
from ..render.film import ANIMATIONS, write_animation
from ..render.picture import Image, contact_sheet, in_rows, write_picture
from ..render.shade import ShadeOptions, compose, downsample, shade
from ..render.trace import PRECISION, fine_strips, pixel_size, see_hits
from ..texture.transport import Colors, TransportedColors, borrowed_colors, shape_colors, start_colors
from ..training.folder import FIELD_FILE, RECORD_FILE, chosen_level, find_field, load_motion, read_record
from .follow import follow_mesh
from .shapes import Placement as ShapePlacement

Tell = Callable[[int, int], None]

SHEET = ".png"


@dataclass(frozen=True)
class SequenceOptions:
    """What is written, and how."""

    frames: int = 48  # times from 0 to 1, both among them
    fps: float = 24.0  # frames per second
    size: tuple[int, int] = (640, 640)  # width and height of a film
    level: int | None = None  # counted from 0; None is the finest
    resolution: int = 128  # of meshes, in cells along the cube
    colors: str | Path | None = None  # run of the first shape, for its texture at time 0; None: the run's own
    last_colors: str | Path | None = None  # run of the last shape, whose texture fades in on the way
    no_colors: bool = False  # leave colours out
    orbit: Orbit = dataclasses.field(default_factory=Orbit)  # where the camera of a film stands
    shading: str = "lambert"  # of a film
    shadows: bool = False  # whether lambert has shadows and occlusion
    samples: int = 2  # rays per pixel and direction
    ease: bool = False  # begin and end at rest: frames are evenly spaced in s, at the times s² (3 − 2 s)
    loop: bool = False  # films play there and back, each frame traced once
    device: str = "auto"

    @property
    def times(self) -> list[float]:
        """When the frames are."""
        even = np.linspace(0, 1, self.frames)
        return (even**2 * (3 - 2 * even) if self.ease else even).tolist()


@dataclass(frozen=True)
class MovingSurface:
    """What is written: a surface that moves, its colours, and how."""

    file: Path
    field: Field  # four-dimensional
    similarity: Similarity  # from input coordinates to the field's
    level: int
    colors: TransportedColors | None
    options: SequenceOptions
    progress: Tell | None = None

    def tell(self, done: int) -> None:
        """Report how many frames are done."""
        if self.progress is not None:
            self.progress(done, self.options.frames)

    def colors_of(self, vertices: NDArray[np.floating], time: float) -> NDArray[np.floating] | None:
        """Display colours ``(V, 3)`` of points ``(V, 3)`` of the surface at a time; None if it has none."""
        if self.colors is None:
            return None
        return self.colors.at(time)(torch.from_numpy(vertices).to(self.field.like)).cpu().numpy()


def check_sequence_path(path: str | Path) -> Path:
    """The path of a sequence, if it can be written there.

    Raises:
        InputError: it is a file of another kind, it cannot come to be there, or it is a folder that is not empty.
    """
    path = Path(path)
    if path.suffix and path.suffix.lower() not in (*ANIMATIONS, SHEET, ".glb"):
        films = ", ".join(ANIMATIONS)
        raise InputError(f"{path}: write a film ({films}), a sheet of moments ({SHEET}), a .glb, or a folder of meshes")
    check_place(path)
    if path.suffix and path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file in it")
    if not path.suffix and path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: exists already; choose another folder, so that frames of two runs are not mixed")
    return path


def animate_run(
    run: str | Path, out: str | Path, options: SequenceOptions | None = None, *, progress: Tell | None = None
) -> str:
    """Write the surface of a run over time → what was written, in a few words.

    ``out`` is an .mp4 or .gif film, traced; a .png of all frames side by side; a .glb of one mesh that moves; or a
    folder, for a .ply per frame. ``progress`` is called with how many frames are done, and of how many.

    Raises:
        InputError: there is no such run, it does not move or has no such level or no surface; it cannot be one mesh; or
            ``out`` cannot be written.
    """
    options, out = options or SequenceOptions(), check_sequence_path(out)
    file = find_field(run)
    field, similarity, _ = load_field(file, device=choose_device(options.device))
    if field.in_dim != 4:
        raise InputError(f"{file}: does not move; use `mplicits render` or `mplicits mesh`")
    level = chosen_level(field, file, options.level)
    colors = _transported(file, field, similarity, level, options)
    if options.shading == "color" and colors is None:
        raise InputError(f"--shading color: {file} has no texture; name a textured run with --colors RUN")
    moving = MovingSurface(file, field, similarity, level, colors, options, progress)
    frames = film_frames(moving)  # drawn as they are taken, if they are
    if out.suffix.lower() in ANIMATIONS:
        write_animation(out, there_and_back(frames) if options.loop else frames, fps=options.fps)
        count = max(2 * options.frames - 2, 1) if options.loop else options.frames
        return f"{count} frames of {options.size[0]}×{options.size[1]}"
    if out.suffix.lower() == SHEET:
        moments = [(f"t = {time:.2f}", frame) for time, frame in zip(options.times, frames, strict=True)]
        write_picture(out, contact_sheet(*in_rows(moments, 7)))  # 7 in a row
        return f"{options.frames} moments of {options.size[0]}×{options.size[1]}"
    return _write_moving_mesh(out, moving) if out.suffix else _write_series(out, moving)


def _transported(
    file: Path, field: Field, similarity: Similarity, level: int, options: SequenceOptions
) -> TransportedColors | None:
    """The transported colours, if there are any."""
    if options.no_colors:
        return None
    motion = load_motion(file)
    motion = None if motion is None else motion.to(field.like)
    first = start_colors(file, field) if options.colors is None else borrowed_colors(options.colors, field, similarity)
    last = None if options.last_colors is None else last_colors(options.last_colors, file, field)
    if first is None and last is not None:
        raise InputError(f"--last-colors: {file} has no colours at the start; name the first shape's run with --colors")
    return None if first is None else TransportedColors(field, first, last=last, level=level, motion=motion)


def last_colors(run: str | Path, file: Path, field: Field) -> Colors:
    """The texture of the last shape's own run, where that shape was put."""
    known = file.name == FIELD_FILE and (file.parent / RECORD_FILE).is_file()
    placements = read_record(file.parent).get("placements", []) if known else []
    if len(placements) < 2:
        raise InputError(f"--last-colors {run}: {file} is not known to go from shape to shape")
    back = ShapePlacement.from_dict(placements[-1]).inverse()

    def home(points: Tensor) -> Tensor:
        return torch.from_numpy(back.apply(points.double().cpu().numpy())).to(points)

    geometry = load_field(find_field(run), device=field.deltas.device).field
    return shape_colors("--last-colors", run, geometry, field, 1.0, home)


def film_frames(moving: MovingSurface) -> Iterator[Image]:
    """The pictures of a film, each traced with what the one before it knew."""
    field, level, options = moving.field, moving.level, moving.options
    camera = orbit_cameras(_outline(moving), options.orbit, size=options.size, frames=1)[0]
    samples, device = options.samples, field.deltas.device
    strips = [(strip, _tracer(field, strip, level)) for strip in fine_strips(camera, samples)]
    lit = ShadeOptions(shadows=options.shadows, occlusion=options.shadows)
    for index, time in enumerate(options.times, start=1):
        still = moment(field, time)
        colors = None if moving.colors is None else moving.colors.at(time)
        parts = []
        for strip, tracer in strips:
            directions = strip.rays(device=device)[1]
            hits = tracer.trace(time)
            seen = see_hits(still, strip, hits, directions, level=level, normal_level=level, colors=colors)
            rgb = seen.position
            if len(seen.pixel):
                rgb = shade(seen, options.shading, camera=strip, field=still, level=level, options=lit)
            parts.append(downsample(compose(seen, rgb, background=(1.0, 1.0, 1.0)), samples))
        moving.tell(index)
        yield np.concatenate(parts)


def there_and_back(frames: Iterable[Image]) -> Iterator[Image]:
    """All frames, and those between both ends once more in reverse, so that a film that repeats has no jump."""
    kept = []
    for frame in frames:
        kept.append(frame)
        yield frame
    yield from kept[-2:0:-1]


def _tracer(field: Field, camera: Camera, level: int) -> DynamicTracer:
    eye, directions = camera.rays(device=field.deltas.device)
    size = pixel_size(camera)
    return DynamicTracer(
        field,
        eye,
        directions,
        level=level,
        tolerance=PRECISION.tolerance * size,
        resolution=PRECISION.resolution * size,
    )


def _outline(moving: MovingSurface) -> NDArray[np.float64]:
    """Points that the camera has to have in view at all times."""
    times = np.linspace(0, 1, min(9, moving.options.frames)).tolist()
    seen = [surface_of(moment(moving.field, time), resolution=48) for time in times]
    points = [mesh.vertices for mesh in seen if mesh is not None]  # a surface may come and go
    if not points:
        raise InputError(f"{moving.file}: no surface at any time")
    return traced_part(np.concatenate(points))


def _write_series(folder: Path, moving: MovingSurface) -> str:
    """frame_0000.ply and so on; a frame without a surface has no file."""
    field, options = moving.field, moving.options
    folder.mkdir(parents=True, exist_ok=True)
    digits = max(4, len(str(options.frames - 1)))
    written = 0
    for index, time in enumerate(options.times):
        try:
            mesh = extract_mesh(moment(field, time), resolution=options.resolution, level=moving.level)
        except NoSurfaceError:
            continue
        mesh = dataclasses.replace(mesh, colors=moving.colors_of(mesh.vertices, time))
        write_mesh(folder / f"frame_{index:0{digits}d}.ply", mesh, moving.similarity)
        written += 1
        moving.tell(index + 1)
    if not written:
        folder.rmdir()
        raise InputError(f"{moving.file}: no surface at any time")
    missing = options.frames - written
    return f"{written} meshes" + (f"; {missing} frames have no surface" if missing else "")


def _write_moving_mesh(out: Path, moving: MovingSurface) -> str:
    options = moving.options
    if options.frames < 2:
        raise InputError(f"--frames {options.frames}: a mesh moves in 2 frames or more")
    about = {"resolution": options.resolution, "level": moving.level}
    tracked = follow_mesh(moving.field, options.times, name=str(moving.file), progress=moving.progress, **about)
    write_moving(
        out,
        tracked.faces,
        list(tracked.vertices),
        list(tracked.normals),
        seconds=np.arange(options.frames) / options.fps,
        similarity=moving.similarity,
        colors=moving.colors_of(tracked.vertices[0], 0.0),
        placement=Placement(options.orbit.up),
    )
    size = math.ceil(out.stat().st_size / 1e6)
    return f"{tracked.vertices.shape[1]:,} vertices in {options.frames} frames, {size} MB"
