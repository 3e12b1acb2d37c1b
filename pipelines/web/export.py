"""Packs what a page shows: a run, a field, a mesh or a cloud."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...datasets.cameras import turntable
from ...neural_fields import Field, InputError, MultiscaleSDF, Similarity, TextureField, extract_mesh, load_field
from ...neural_fields.backend.files import write_whole
from ...neural_fields.meshing.extract import NoSurfaceError, surface_needed
from ...neural_fields.spacetime.field import SpaceTimeSDF
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS
from ..render.draw import FRAME_RESOLUTION, traced_part
from ..texture.train import texture_of
from ..training.folder import chosen_level, find_field, fitted_cloud, is_field, load_still
from .assembly import fill_page, write_folder
from .payload import Payload, Rounding, network_layers, rounding_error, shader_levels
from .shapes import Shape, add_shape, distance_cloud, field_shapes, read_shape
from .shell import GRID, MOMENTS, shell_mesh, surface_reach, swept_shell

PAGES = (".html", ".htm")
BITS = 13


@dataclass(frozen=True)
class WebOptions:
    """What a page shows.

    Attributes:
        levels: how many levels, from the coarsest on; None is all.
        time: the moment, for a run that moves; None shows all moments.
        colors: whether it has the colours of the run's texture; not while it moves.
        float32: whether the weights are kept as they are; else they are rounded to `BITS` bits.
        cloud: a cloud beside the field, coloured by its distance; "auto" is the fitted one, if it is found.
        up: the axis that points up, "y" or "z".
        title: of the page; None is the name of the run or file.
    """

    levels: int | None = None
    time: float | None = None
    colors: bool = True
    float32: bool = False
    cloud: str | Path | None = None
    up: str = "y"
    title: str | None = None


@dataclass(frozen=True)
class WebPage:
    """A page that was written.

    Attributes:
        size: bytes of the file, or of ``field.bin`` and its module.
        levels: of the field that it traces; 0 for clouds or meshes alone.
        triangles: of the mesh between which rays are sought, or of the meshes that it shows.
        rounding: what rounding the weights has changed, for each level; empty if they are exact.
    """

    size: int
    levels: int
    colored: bool
    triangles: int
    rounding: tuple[Rounding, ...]


class Packed(NamedTuple):
    """What a page carries: a header that describes the deflated bytes, these, and figures, but for the size."""

    header: dict[str, Any]
    data: bytes
    page: WebPage


def web_run(
    source: str | Path, out: str | Path, options: WebOptions | None = None, *, say: Callable[[str], None] | None = None
) -> WebPage:
    """Write a page that shows a run, a mesh or a cloud and needs nothing else, or a folder for another page.

    The name ``out`` is that of a file of `PAGES`, or of a folder, see `write_folder`. ``say`` is called with a line
    about what rounding has cost, and what is shown.

    Raises:
        InputError: see `pack`, or the file cannot be written.
    """
    header, data, page = pack(source, options)
    out = Path(out)
    alone = out.suffix.lower() in PAGES
    if alone:
        write_whole(out, fill_page(header, data))
    else:
        write_folder(out, header, data)
    fetched = [out] if alone else [out / "field.bin", out / "mplicits-field.js"]
    done = dataclasses.replace(page, size=sum(part.stat().st_size for part in fetched))
    if say is not None and header["moves"]:
        say("it moves: all of its moments are on the page; --time T shows one")
    if say is not None and done.rounding:
        worst = [max(getattr(part, key) for part in done.rounding) for key in ("value", "angle")]
        length = worst[0] * header["unit"]
        say(f"weights of {BITS} bits: distances change by at most {length:.2g} input units, normals by {worst[1]:.2g}°")
    return done


def pack(source: str | Path, options: WebOptions | None = None) -> Packed:
    """Pack a run, a mesh or a cloud; raises an InputError if it cannot be read or an option does not go with it."""
    options = options or WebOptions()
    if not is_field(source):
        for name in ("levels", "time", "cloud"):
            if getattr(options, name) not in (None, "auto"):
                raise InputError(f"--{name}: goes with a run; {source} is a mesh or a cloud")
        shape, similarity = read_shape(Path(source))
        return pack_shapes([shape], similarity, options, name=Path(source).stem)
    file = find_field(source)
    # A moving field keeps its motion where the page can trace it; any other is frozen at its time.
    saved = load_field(file)
    moves = options.time is None and isinstance(saved.field, SpaceTimeSDF)
    field, similarity, metadata = saved if moves else load_still(file, options.time)
    texture = texture_of(file, field) if options.colors and field.in_dim == 3 and options.time is None else None
    if options.levels is not None:
        chosen_level(field, file, options.levels - 1, flag="--levels")
        field = _coarse(field, options.levels)
    cloud = None if options.cloud in (None, "auto") else Path(str(options.cloud))
    if options.cloud == "auto" and metadata.get("run", {}).get("cloud"):
        with suppress(InputError):
            cloud = fitted_cloud(file, metadata, remedy="")
    if cloud is not None and field.in_dim != 3:
        raise InputError(f"--cloud: {file} moves; add --time T, or leave it out")
    name = file.resolve().parent.name if file.name == "field.safetensors" else file.stem
    with surface_needed(f"{file}: no surface to show"):
        return pack_field(field, similarity, options, name=name, texture=texture, cloud=cloud)


def pack_field(
    field: Field,
    similarity: Similarity,
    options: WebOptions | None = None,
    *,
    name: str = "field",
    texture: TextureField | None = None,
    cloud: Path | None = None,
) -> Packed:
    """Pack a field: levels of SIRENs as networks that the page traces, any other as meshes of its levels.

    It is three-dimensional, or levels of SIRENs in space and time. ``texture`` has its colours, ``cloud`` is a file of
    points to show beside it. Raises a NoSurfaceError, or an InputError if it moves and no shader traces it, or the
    cloud cannot be read.
    """
    options = options or WebOptions()
    shapes = [] if cloud is None else [distance_cloud(cloud, field, similarity)]
    moving = field if isinstance(field, SpaceTimeSDF) else None
    stills: list[Field] = [field] if moving is None else [moving.at(float(t)) for t in MOMENTS]
    if (networks := shader_levels(field if moving is None else moving.sdf)) is None:
        if moving is not None:
            raise InputError(f"{name}: a page shows only SIRENs at all times; choose one with --time T")
        return pack_shapes([*field_shapes(field, texture), *shapes], similarity, options, name=name)
    outlines = _outlines(stills)
    shell = shell_mesh(field) if moving is None else swept_shell(moving)
    bits = None if options.float32 else BITS
    rounding = [] if bits is None else _rounding(outlines, bits)
    payload = Payload()
    levels = [payload.add_network(f"level{index}", network_layers(part, bits)) for index, part in enumerate(networks)]
    colors = None
    if texture is not None:
        colors = payload.add_network("colors", network_layers(texture.network.siren, bits, channels=3))
        # Of a page with fewer levels, the finest that it has stands for the one that was coloured.
        colors["level"] = min(texture.geometry_level, field.num_levels - 1)
        colors |= {"delta": float(texture.delta), "outside": texture.outside.tolist()}
    low, high = shell.vertices.min(axis=0), shell.vertices.max(axis=0)
    payload.add_steps("shell.vertices", np.rint((shell.vertices - low) / (high - low) * GRID).T)
    payload.add_steps("shell.faces", shell.faces)
    page = WebPage(0, len(levels), colors is not None, len(shell.faces), tuple(rounding))
    outline = np.concatenate([points for _, points in outlines])
    deltas = [float(delta) for delta in field.deltas]
    bands = [deltas[:level] for level in range(field.num_levels)]  # what `surface_reach` is at most, at any moment
    header = {
        "moves": moving is not None,
        "levels": levels,
        "colors": colors,
        "deltas": deltas,
        "taper": stills[0].taper if isinstance(stills[0], MultiscaleSDF) else 0.0,
        "reach": surface_reach(field) if moving is None else bands,
        "shell": {"low": low.tolist(), "high": high.tolist(), "grid": GRID, "triangles": len(shell.faces)},
        "bits": bits,
        "rounding": [dataclasses.asdict(part) for part in rounding],
    }
    return _packed(payload, header, shapes, page, outline, similarity, options.title or name, options.up)


def pack_shapes(
    shapes: Sequence[Shape], similarity: Similarity, options: WebOptions | None = None, *, name: str
) -> Packed:
    """Pack clouds and meshes in unit-sphere coordinates, without a field; ``up`` and ``title`` of the options count."""
    options = options or WebOptions()
    outline = np.concatenate([shape.vertices for shape in shapes if not shape.hidden])
    header = {
        "moves": False,
        "levels": [],
        "colors": None,
        "deltas": [],
        "taper": 0.0,
        "reach": [],
        "shell": {"low": outline.min(axis=0).tolist(), "high": outline.max(axis=0).tolist()},
        "bits": None,
        "rounding": [],
    }
    triangles = sum(0 if shape.faces is None else len(shape.faces) for shape in shapes)
    page = WebPage(0, 0, any(shape.colors is not None for shape in shapes), triangles, ())
    return _packed(Payload(), header, shapes, page, outline, similarity, options.title or name, options.up)


def _packed(
    payload: Payload,
    header: dict[str, Any],
    shapes: Sequence[Shape],
    page: WebPage,
    outline: NDArray[np.floating],
    similarity: Similarity,
    title: str,
    up: str,
) -> Packed:
    described = [add_shape(payload, shape, index) for index, shape in enumerate(shapes)]
    data, blocks = payload.content()
    # The camera stands first where `mplicits render` would put it for a picture as wide as high.
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    distance = float(np.linalg.norm(turntable(outline, 1, up=up)[0].eye.numpy() - middle))
    view = {"middle": middle.tolist(), "distance": distance, "azimuth": 30.0, "elevation": 15.0, "up": up, "fov": 25.0}
    whole = {
        "format": "mplicits-web",
        "version": 2,
        "title": title,
        **header,
        "shapes": described,
        "radius": BOUNDING_RADIUS,
        "view": view,
        "unit": similarity.scale,
        "center": list(similarity.center),
        **blocks,
    }
    return Packed(whole, data, page)


def _coarse(field: Field, levels: int) -> Field:
    """The first levels of a field."""
    if isinstance(field, SpaceTimeSDF):
        sdf = _coarse(field.sdf, levels)
        return SpaceTimeSDF(sdf) if isinstance(sdf, MultiscaleSDF) else field
    return field.first_levels(levels) if isinstance(field, MultiscaleSDF) and levels < field.num_levels else field


def _outlines(stills: list[Field]) -> list[tuple[Field, NDArray[np.floating]]]:
    """The moments that have a surface, and points of it; raises a NoSurfaceError if none has."""
    found: list[tuple[Field, NDArray[np.floating]]] = []
    for index, still in enumerate(stills, start=1):
        try:
            found.append((still, traced_part(extract_mesh(still, resolution=FRAME_RESOLUTION, normals=False).vertices)))
        except NoSurfaceError:
            if not found and index == len(stills):
                raise
    return found


def _rounding(outlines: list[tuple[Field, NDArray[np.floating]]], bits: int) -> list[Rounding]:
    """What rounding changes at about 4,000 points, for each level: the most of all moments."""
    every = max(1, sum(len(points) for _, points in outlines) // 4000)
    found = [rounding_error(still, bits, points[::every]) for still, points in outlines]
    return [
        Rounding(max(part.value for part in parts), max(part.angle for part in parts))
        for parts in zip(*found, strict=True)
    ]
