"""From a run to the page: what is shown of it, rounded and packed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from ...datasets.cameras import turntable
from ...neural_fields import Field, InputError, MultiscaleSDF, Siren, TextureField, extract_mesh, load_field
from ...neural_fields.backend.files import write_whole
from ...neural_fields.checkpoint import SavedField
from ...neural_fields.meshing.extract import NoSurfaceError
from ...neural_fields.networks.multiscale import levels_of
from ...neural_fields.spacetime.field import SpaceTimeSDF
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS
from ..render.subject import FRAME_RESOLUTION, traced_part
from ..texture.train import texture_of
from ..training.folder import chosen_level, find_field, load_still
from .assembly import fill_page, write_folder
from .film import MOMENTS, band_reach, swept_shell
from .networks import Rounding, network_layers, rounding_error, shader_levels, taper_of
from .payload import Payload
from .shell import GRID, shell_mesh, surface_reach

__all__ = ["BITS", "PAGES", "Packed", "WebOptions", "WebPage", "pack_run", "web_run"]

PAGES = (".html", ".htm")
BITS = 13
VERSION = 1
CHANNELS = 3
ERROR_POINTS = 4000  # at which rounding is measured


@dataclass(frozen=True)
class WebOptions:
    """What a page shows.

    Attributes:
        levels: how many levels, from the coarsest on; None is all.
        time: the moment, of a run that moves; None shows all of its moments.
        colors: whether the colours of the run's texture are in it, if it has one and does not move.
        float32: whether the weights are kept as they are; else they are rounded to `BITS` bits.
        up: the axis that points up, "y" or "z".
        title: of the page; None is the name of the run.
    """

    levels: int | None = None
    time: float | None = None
    colors: bool = True
    float32: bool = False
    up: str = "y"
    title: str | None = None


@dataclass(frozen=True)
class WebPage:
    """A page that was written.

    Attributes:
        size: of the file, or of what the element fetches: ``field.bin`` and its module; in bytes.
        levels: that it shows.
        colored: whether it has colours.
        triangles: of the mesh between which rays are sought.
        rounding: what rounding the weights has changed, for each level; empty if they are exact.
    """

    size: int
    levels: int
    colored: bool
    triangles: int
    rounding: tuple[Rounding, ...]


class Packed(NamedTuple):
    """A run as a page carries it.

    Attributes:
        header: what is shown, and what stands where among the bytes.
        data: deflated.
        page: what is told of it; the size is not known yet.
    """

    header: dict[str, Any]
    data: bytes
    page: WebPage


def web_run(
    run: str | Path, out: str | Path, options: WebOptions | None = None, *, say: Callable[[str], None] | None = None
) -> WebPage:
    """Write a page that shows a run, and needs nothing but itself; or a folder, to show it in another page.

    Args:
        run: run directory or .safetensors file.
        out: a file of `PAGES`; any other name is a folder's, see `write_folder`.
        options: what to show.
        say: called with a line about what rounding has cost, and what is shown.

    Raises:
        InputError: there is no such run, it has no surface or is of a kind that no shader knows, or the file cannot be
            written.
    """
    header, data, page = pack_run(run, options)
    out = Path(out)
    if out.suffix.lower() in PAGES:
        write_whole(out, fill_page(header, data))
    else:
        write_folder(out, header, data)
    done = dataclasses.replace(page, size=sum(part.stat().st_size for part in _fetched(out)))
    if say is not None and header["moves"]:
        say("it moves: all of its moments are on the page; --time T shows one")
    if say is not None and done.rounding:
        worst = [max(getattr(part, key) for part in done.rounding) for key in ("value", "angle")]
        length = worst[0] * header["unit"]
        say(f"weights of {BITS} bits: distances change by at most {length:.2g} input units, normals by {worst[1]:.2g}°")
    return done


def pack_run(run: str | Path, options: WebOptions | None = None) -> Packed:
    """What a page shows of a run.

    Args:
        run: run directory or .safetensors file.
        options: what to show.

    Raises:
        NoShaderError: no shader knows this kind of field.
        InputError: there is no such run, or it has no surface.
    """
    options = options or WebOptions()
    file = find_field(run)
    saved = _shown(file, options.time)
    shown = saved.field
    still = shown.in_dim == 3 and options.time is None
    texture = texture_of(file, shown) if options.colors and still else None
    if options.levels is not None:
        chosen_level(shown, file, options.levels - 1, flag="--levels")
        shown = _coarse(shown, options.levels)
    return _content(shown, texture, saved, file, options)


def _fetched(out: Path) -> list[Path]:
    """What a browser fetches: the page, or of a folder the field and the module."""
    return [out] if out.suffix.lower() in PAGES else [out / "field.bin", out / "mplicits-field.js"]


def _shown(file: Path, time: float | None) -> SavedField:
    """A field that stands still, frozen at its time if it moves and there is one; else a `SpaceTimeSDF`."""
    saved = load_field(file)
    if time is None and isinstance(saved.field, SpaceTimeSDF):
        return saved
    return load_still(file, time)


@overload
def _coarse(shown: MultiscaleSDF, levels: int) -> MultiscaleSDF: ...
@overload
def _coarse(shown: Field, levels: int) -> Field: ...
def _coarse(shown: Field, levels: int) -> Field:
    """The first levels of a field."""
    if isinstance(shown, SpaceTimeSDF):
        return SpaceTimeSDF(_coarse(shown.sdf, levels))
    if not isinstance(shown, MultiscaleSDF) or levels == shown.num_levels:
        return shown
    residuals = list(shown.levels[1:levels])
    return MultiscaleSDF(shown.base, residuals, shown.deltas[: levels - 1], taper=shown.taper)


def _name_of(file: Path) -> str:
    return file.resolve().parent.name if file.name == "field.safetensors" else file.stem


def _content(shown: Field, texture: TextureField | None, saved: SavedField, file: Path, options: WebOptions) -> Packed:
    moving = shown if isinstance(shown, SpaceTimeSDF) else None
    stills: list[Field] = [shown] if moving is None else [moving.at(float(t)) for t in MOMENTS]
    shader_levels(stills[0], file)
    networks = [part for part in levels_of(shown if moving is None else moving.sdf) if isinstance(part, Siren)]
    try:
        outlines = _outlines(stills)
        shell = shell_mesh(shown) if moving is None else swept_shell(moving)
    except NoSurfaceError as error:
        raise InputError(f"{file}: no surface to show ({error})") from error
    outline = np.concatenate([points for _, points in outlines])
    bits = None if options.float32 else BITS
    rounding = [] if bits is None else _rounding(outlines, bits)
    payload = Payload()
    levels = [payload.add_network(f"level{index}", network_layers(part, bits)) for index, part in enumerate(networks)]
    colors = None
    if texture is not None:
        colors = payload.add_network("colors", network_layers(texture.network.siren, bits, channels=CHANNELS))
        # Of a page with fewer levels, the finest that it has stands for the one that was coloured.
        colors["level"] = min(texture.geometry_level, shown.num_levels - 1)
        colors |= {"delta": float(texture.delta), "outside": texture.outside.tolist()}
    low, high = shell.vertices.min(axis=0), shell.vertices.max(axis=0)
    payload.add_steps("shell.vertices", np.rint((shell.vertices - low) / (high - low) * GRID).T)
    payload.add_steps("shell.faces", shell.faces)
    data, described = payload.content()
    header = {
        "format": "mplicits-web",
        "version": VERSION,
        "title": options.title or _name_of(file),
        "moves": moving is not None,
        "levels": levels,
        "colors": colors,
        "deltas": [float(delta) for delta in shown.deltas],
        "taper": taper_of(stills[0]),
        # What a film's levels reach at every moment is not known; their bands are.
        "reach": surface_reach(shown) if moving is None else band_reach(shown),
        "radius": BOUNDING_RADIUS,
        "shell": {"low": low.tolist(), "high": high.tolist(), "grid": GRID, "triangles": len(shell.faces)},
        "view": _view(outline, options.up),
        "unit": saved.similarity.scale,
        "center": list(saved.similarity.center),
        "bits": bits,
        "rounding": [dataclasses.asdict(part) for part in rounding],
        **described,
    }
    page = WebPage(0, len(levels), colors is not None, len(shell.faces), tuple(rounding))
    return Packed(header, data, page)


def _outlines(stills: list[Field]) -> list[tuple[Field, NDArray[np.floating]]]:
    """The moments that have a surface, and points of it.

    Raises:
        NoSurfaceError: none has one.
    """
    found: list[tuple[Field, NDArray[np.floating]]] = []
    missing: NoSurfaceError | None = None
    for still in stills:
        try:
            found.append((still, traced_part(extract_mesh(still, resolution=FRAME_RESOLUTION, normals=False).vertices)))
        except NoSurfaceError as error:
            missing = error
    if not found and missing is not None:
        raise missing
    return found


def _rounding(outlines: list[tuple[Field, NDArray[np.floating]]], bits: int) -> list[Rounding]:
    """What rounding changes, for each level: the most of all moments."""
    every = max(1, sum(len(points) for _, points in outlines) // ERROR_POINTS)
    found = [rounding_error(still, bits, points[::every]) for still, points in outlines]
    return [
        Rounding(max(part.value for part in parts), max(part.angle for part in parts))
        for parts in zip(*found, strict=True)
    ]


def _view(outline: NDArray[np.floating], up: str) -> dict[str, Any]:
    """Where the camera stands first: where ``mplicits render`` would put it for a picture as wide as high."""
    camera = turntable(outline, 1, up=up)[0]
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    distance = float(np.linalg.norm(camera.eye.numpy() - middle))
    return {"middle": middle.tolist(), "distance": distance, "azimuth": 30.0, "elevation": 15.0, "up": up, "fov": 25.0}
