"""``mplicits bench texture``: texture fields on coarse surfaces against the UV-textured meshes they learnt from."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets import Camera, TexturedMesh, read_textured, turntable
from ..neural_fields import InputError, map_colors
from ..neural_fields.meshing import NoSurfaceError, extract_mesh
from .bench_texture_fits import Fitted, Report, check_kept, fitted_texture
from .render.compare import Drawing, ImageError, draw, image_error, psnr
from .render.rasterise import contact_sheet, mesh_view, textured_view, write_picture
from .render.trace import trace_view
from .run.machine import format_table
from .run.settings import FitConfig, TextureConfig
from .surface.surface import Surface, from_mesh

__all__ = ["PAPER_MSE", "TextureRow", "bench_texture", "format_texture"]

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
    seen = textured_view(mesh, camera.resized(camera.width * samples, camera.height * samples))
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


def _sheet(wanted: Sequence[Drawing], series: Sequence[_Series]) -> NDArray[np.uint8]:
    """One line per camera: the original, each of the series, and its differences from the original."""
    lines = []
    for view, original in enumerate(wanted):
        tiles, differences = [("original", _bytes(original.rgb))], []
        for one in series:
            label, rgb = one.surface.name.replace("▷", " > "), one.drawings[view].rgb  # OpenCV draws ASCII
            tiles.append((f"texture on {label}", _bytes(rgb)))
            differences.append((f"{label}: difference x {MAGNIFIED}", _bytes(MAGNIFIED * np.abs(rgb - original.rgb))))
        lines.append(contact_sheet(tiles + differences))
    return np.concatenate(lines)


def _bytes(rgb: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (rgb.clip(0, 1) * 255 + 0.5).astype(np.uint8)


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
