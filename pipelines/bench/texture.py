"""``mplicits bench texture``: texture fields on coarse surfaces against the UV-textured meshes they learnt from.

The fits and textures of ``mplicits bench texture``: kept in a folder, and used again if they are the same.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from ...datasets import Camera, TexturedMesh, read_textured, sample_textured, turntable
from ...neural_fields import Field, InputError, Similarity, TextureField, load_field, load_texture, map_colors
from ...neural_fields.files import write_json
from ...neural_fields.meshing import NoSurfaceError, extract_mesh
from ..fit.train import fit
from ..render.compare import Drawing, ImageError, draw, image_error, psnr
from ..render.picture import Image, as_bytes, contact_sheet, write_picture
from ..render.rasterise import mesh_view
from ..render.trace import trace_view
from ..run.folder import FIELD_FILE, RECORD_FILE, STATE_FILE, TEXTURE_FILE, read_record
from ..run.machine import choose_device, format_table
from ..run.settings import FitConfig, TextureConfig
from ..run.trainer import Progress
from ..surface.surface import Surface, from_mesh
from ..texture.train import texture_run

__all__ = [
    "PAPER_MSE",
    "Fitted",
    "Report",
    "TextureRow",
    "bench_texture",
    "check_kept",
    "fitted_texture",
    "format_texture",
]

# "Textures" in the supplement; over which pixels, of what images, it does not say.
PAPER_MSE: Mapping[str, float] = MappingProxyType(
    {"spot": 0.0329, "bob": 0.0434, "bunny": 0.0720, "egg": 0.0291, "earth": 0.0033}
)
MAGNIFIED = 4  # how much larger differences are drawn


@dataclass(frozen=True)
class TextureRow:
    """One surface with one texture, drawn in one way and compared with the original, all cameras together.

    Attributes:
        shape: name of the file.
        surface: whose surface is drawn, and how.
        texture: around which fit the texture was trained.
        parameters: of the surface's network.
        fit_seconds: training of that surface.
        texture_parameters: of the texture's network.
        texture_seconds: its training, the sampling of the mesh included.
        error: of the unlit images, display RGB in [0, 1].
        paper: the paper's figure for a shape of this name, if it has one.
    """

    shape: str
    surface: str
    texture: str
    parameters: int
    fit_seconds: float
    texture_parameters: int
    texture_seconds: float
    error: ImageError
    paper: float | None

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self) | {"psnr_either": psnr(self.error.either), "psnr_both": psnr(self.error.both)}


@dataclass(frozen=True)
class _Series:
    """One surface with one texture, drawn for all cameras."""

    surface: Fitted
    how: str
    painted: Fitted
    drawings: list[Drawing]


def bench_texture(
    meshes: Sequence[str | Path],
    directory: Path,
    texture: TextureConfig,
    *,
    coarse: FitConfig,
    full: FitConfig | None = None,
    views: int = 6,
    size: int = 512,
    samples: int = 2,
    up: str = "y",
    resolution: int = 256,
    progress: Report | None = None,
    report: Callable[[str], None] | None = None,
) -> list[TextureRow]:
    """Fit a coarse surface to each mesh, train its colours around it, and compare images of both.

    Images are unlit, on white, and averaged in linear light from ``samples``² per pixel. Fits, textures and a contact
    sheet per mesh are kept in ``directory``; those that are there already are used.

    Args:
        meshes: OBJ or glTF files with texture coordinates and an image.
        directory: made if it is not there.
        texture: settings of the textures.
        coarse: settings of the coarse fit.
        full: settings of another fit, for more rows: its surface, and its texture on the coarse surface.
        views: how many cameras, evenly around the mesh.
        size: width and height of the images.
        samples: per pixel and direction.
        up: "y" or "z".
        resolution: of the marching cubes of the coarse surface.
        progress: called with a name and the progress of a training.
        report: called with what is going on.

    Raises:
        InputError: a mesh cannot be used, two have one name, or ``directory`` holds fits with other settings.
        Interrupted: a fit was asked to stop; the same call goes on with it.
        KeyboardInterrupt: a texture was asked to stop.
    """
    say = report or (lambda _: None)
    paths = [Path(path) for path in meshes]
    originals = [_read(path) for path in paths]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"{max(names, key=names.count)}: two of the meshes are called that; rename one of them")
    directory.mkdir(parents=True, exist_ok=True)
    for path, mesh in zip(paths, originals, strict=True):
        check_kept(directory / path.stem, mesh, {"coarse": coarse, "full": full}, texture)
    rows: list[TextureRow] = []
    for path, mesh in zip(paths, originals, strict=True):
        home = directory / path.stem
        fits = [fitted_texture(path, mesh, home / "coarse", coarse, texture, progress)]
        if full is not None:
            fits.append(fitted_texture(path, mesh, home / "full", full, texture, progress))
        outline = mesh.vertices[np.unique(mesh.faces)]
        cameras = turntable(outline, views, width=size, height=size, up=up)
        say(f"{path.stem}: the original")
        wanted = [_original(mesh, camera, samples) for camera in cameras]
        series = _drawn(path.stem, fits, cameras, samples, resolution, say)
        rows += [_row(path.stem, one, image_error(zip(wanted, one.drawings, strict=True))) for one in series]
        write_picture(directory / f"{path.stem}.png", _sheet(wanted, series[: len(fits)]))
    return rows


def _read(path: Path) -> TexturedMesh:
    mesh = read_textured(path)
    if mesh.uv is None:
        raise InputError(f"{path}: no texture coordinates and image in it; export the mesh with its texture")
    return mesh


def _original(mesh: TexturedMesh, camera: Camera, samples: int) -> Drawing:
    seen = mesh_view(mesh, camera.resized(camera.width * samples, camera.height * samples))
    assert seen.color is not None
    return draw(seen, seen.color, samples=samples)


def _drawn(
    shape: str,
    fits: Sequence[Fitted],
    cameras: Sequence[Camera],
    samples: int,
    resolution: int,
    say: Callable[[str], None],
) -> list[_Series]:
    """All that is compared; first each fit, traced, with its own texture."""
    coarse, series = fits[0], []
    for fitted in fits:
        say(f"{shape}: {fitted.name}, traced")
        series.append(_Series(fitted, "traced", fitted, [_traced(fitted, fitted, c, samples) for c in cameras]))
    say(f"{shape}: the mesh of {coarse.name}")
    try:
        mesh = from_mesh(extract_mesh(coarse.field, resolution=resolution))
    except NoSurfaceError as error:
        raise InputError(f"{shape}: the coarse fit has no surface ({error}); give it more steps") from error
    series.append(_Series(coarse, "mesh", coarse, [_rasterised(mesh, coarse, c, samples) for c in cameras]))
    for other in fits[1:]:
        say(f"{shape}: {coarse.name} with the texture of {other.name}")
        series.append(_Series(coarse, "traced", other, [_traced(coarse, other, c, samples) for c in cameras]))
    return series


@torch.inference_mode()
def _traced(surface: Fitted, painted: Fitted, camera: Camera, samples: int) -> Drawing:
    """The surface of one fit with the texture of another, both of which have the same similarity."""
    fine = camera.moved(surface.similarity).resized(camera.width * samples, camera.height * samples)
    device = painted.texture.delta.device
    seen = trace_view(surface.field, fine, device=device)
    own = surface is painted  # then every hit is in the band, and the geometry need not be asked again
    colors = painted.texture.colors(seen.position) if own else map_colors(painted.texture, seen.position).values
    return draw(seen, colors, samples=samples)


@torch.inference_mode()
def _rasterised(mesh: Surface, painted: Fitted, camera: Camera, samples: int) -> Drawing:
    """A mesh in unit-sphere coordinates, with the texture looked up for every pixel."""
    fine = camera.moved(painted.similarity).resized(camera.width * samples, camera.height * samples)
    seen = mesh_view(mesh, fine)
    return draw(seen, painted.texture.colors(seen.position.to(painted.texture.delta.device)), samples=samples)


def _row(shape: str, series: _Series, error: ImageError) -> TextureRow:
    trained, word = series.painted.record["texture"], re.match("[a-z]*", shape.lower())
    return TextureRow(
        shape=shape,
        surface=f"{series.surface.name} {series.how}",
        texture=series.painted.name,
        parameters=series.surface.record["parameters"],
        fit_seconds=series.surface.record["training_seconds"],
        texture_parameters=trained["parameters"],
        texture_seconds=trained["sampling_seconds"] + trained["training_seconds"],
        error=error,
        paper=None if word is None else PAPER_MSE.get(word.group()),
    )


def _sheet(wanted: Sequence[Drawing], series: Sequence[_Series]) -> Image:
    """One line per camera: the original, each of the series, and its differences from the original."""
    lines = []
    for view, original in enumerate(wanted):
        tiles, differences = [("original", as_bytes(original.rgb))], []
        for one in series:
            label, rgb = one.surface.name.replace("▷", " > "), one.drawings[view].rgb  # OpenCV draws ASCII
            tiles.append((f"texture on {label}", as_bytes(rgb)))
            differences.append((f"{label}: difference x {MAGNIFIED}", as_bytes(MAGNIFIED * np.abs(rgb - original.rgb))))
        lines.append(tiles + differences)
    return contact_sheet(*lines)


def format_texture(rows: Sequence[TextureRow]) -> str:
    """The table that the command prints: mean squared errors, each with how many times the paper's it is below."""
    header = (
        *("shape, surface", "texture around", "parameters", "fit", "texture", "trained in"),
        *("MSE, all pixels", "seen by either", "inside both", "paper", "PSNR either", "PSNR both"),
    )
    cells = []
    for row in rows:
        errors = (row.error.everywhere, row.error.either, row.error.both)
        cells.append(
            (
                f"{row.shape} {row.surface}",
                row.texture,
                f"{row.parameters:,}",
                f"{row.fit_seconds:.1f} s",
                f"{row.texture_parameters:,}",
                f"{row.texture_seconds:.1f} s",
                *(f"{mse:.3g}{_times(row.paper, mse)}" for mse in errors),
                "" if row.paper is None else f"{row.paper:.4f}",
                f"{psnr(row.error.either):.1f} dB",
                f"{psnr(row.error.both):.1f} dB",
            )
        )
    return format_table(header, cells)


def _times(paper: float | None, mse: float) -> str:
    """How many times smaller than the paper's figure an error is, to one or two digits."""
    if paper is None or not mse > 0:
        return ""
    ratio = paper / mse
    return f" ({ratio:.0f}×)" if ratio >= 9.95 else f" ({ratio:.1f}×)"


FIT_POINTS = 100_000
MESH_FILE = "mesh.json"

Report = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Fitted:
    """A surface and its texture.

    Attributes:
        field: the surface, on the device of the texture's settings.
        similarity: from input to its coordinates.
        texture: around it.
        record: what ``run.json`` says of both.
    """

    field: Field
    similarity: Similarity
    texture: TextureField
    record: dict[str, Any]

    @property
    def name(self) -> str:
        """The widths and depths of its levels, as the paper writes them."""
        sizes = zip(self.record["config"]["widths"], self.record["config"]["depths"], strict=True)
        return "▷".join(f"({width},{depth})" for width, depth in sizes)


def check_kept(home: Path, mesh: TexturedMesh, fits: Mapping[str, FitConfig | None], texture: TextureConfig) -> None:
    """Check that what is kept in a folder was made from this mesh and with these settings; make the folder if new.

    Args:
        home: the folder of the mesh.
        mesh: with an image.
        fits: settings by the names of the runs in that folder; None: it is not asked for.
        texture: settings of their textures.

    Raises:
        InputError: something there is of another mesh or has other settings.
    """
    digest = hashlib.sha256()
    for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.image):
        digest.update(np.ascontiguousarray(array).tobytes())
    file = home / MESH_FILE
    if file.is_file() and file.read_text(encoding="utf-8") != json.dumps(digest.hexdigest(), indent=2) + "\n":
        raise InputError(f"{home}: holds the fits of another mesh than {mesh.source}; choose another -o, or remove it")
    for name, config in fits.items():
        run = home / name
        if config is None or not (run / RECORD_FILE).is_file():
            continue
        record = read_record(run)
        _check_settings(run, record["config"], config)
        if "texture" in record:
            _check_settings(run / TEXTURE_FILE, record["texture"]["config"], texture)
    home.mkdir(exist_ok=True)
    write_json(file, digest.hexdigest())


def _check_settings(where: Path, kept: Mapping[str, Any], wanted: FitConfig | TextureConfig) -> None:
    given = json.loads(json.dumps(asdict(wanted)))  # lists, as the file has them
    for name in given:
        if name != "device" and kept.get(name) != given[name]:
            raise InputError(
                f"{where}: was made with {name} {kept.get(name)}, not {given[name]}; choose another -o, or remove it"
            )


def fitted_texture(
    path: Path, mesh: TexturedMesh, run: Path, config: FitConfig, texture: TextureConfig, progress: Report | None
) -> Fitted:
    """The surface and its texture; whatever is not in the folder ``run`` yet is trained.

    Args:
        path: of the mesh.
        mesh: what it holds.
        run: run directory of the fit and its texture; its name is that of the fit.
        config: settings of the fit.
        texture: settings of the texture.
        progress: called with a name and the progress of a training.

    Raises:
        Interrupted: the fit was asked to stop; the next call resumes it.
        KeyboardInterrupt: the texture was asked to stop; the next call trains it anew.
    """

    def told(step: Progress) -> None:
        if progress is not None:
            progress(f"{path.stem} {run.name}", step)

    resume = (run / STATE_FILE).is_file()
    if resume or not (run / FIELD_FILE).is_file():
        fit(sample_textured(mesh, FIT_POINTS, seed=config.seed), config, out=run, resume=resume, progress=told)
    trained = (run / TEXTURE_FILE).is_file() and read_record(run).get("texture", {}).get("finished", False)
    if not trained and not texture_run(run, path, texture, progress=told).record["finished"]:
        raise KeyboardInterrupt
    field, similarity, _ = load_field(run / FIELD_FILE, device=choose_device(texture.device))
    return Fitted(field, similarity, load_texture(run / TEXTURE_FILE, field), read_record(run))
