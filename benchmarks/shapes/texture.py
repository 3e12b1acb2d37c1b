"""Benchmark ``texture``: texture fields on coarse surfaces against the UV-textured meshes they learnt from."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from mplicits.datasets import Camera, TexturedMesh, read_textured, sample_textured, turntable
from mplicits.datasets.files import to_bytes
from mplicits.neural_fields import (
    Field,
    InputError,
    Mesh,
    Similarity,
    TextureField,
    load_field,
    load_texture,
    map_colors,
)
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from mplicits.pipelines.render.picture import Image, contact_sheet, write_picture
from mplicits.pipelines.render.rasterise import mesh_view
from mplicits.pipelines.render.trace import trace_view
from mplicits.pipelines.texture.train import texture_run
from mplicits.pipelines.training.folder import TEXTURE_FILE, digest_of, find_field, read_record
from mplicits.pipelines.training.settings import FitConfig, TextureConfig

from ..harness.benchmark import Benchmark, Part, network_name, one_of_each
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .compare import Drawing, ImageError, draw, image_error, psnr
from .fits import fit_home, kept_fit

FIT_POINTS = 100_000
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

    @property
    def psnr_either(self) -> float:
        """In dB, over the pixels that see the shape in either image."""
        return psnr(self.error.either)

    @property
    def psnr_both(self) -> float:
        """In dB, over the pixels that are inside both."""
        return psnr(self.error.both)


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
        return network_name(zip(self.record["config"]["widths"], self.record["config"]["depths"], strict=True))


@dataclass(frozen=True)
class _Series:
    """One surface with one texture, drawn for all cameras."""

    surface: Fitted
    how: str
    painted: Fitted
    drawings: list[Drawing]


@dataclass(frozen=True, kw_only=True)
class TextureBench(Benchmark[TextureRow]):
    """Coarse surfaces fitted to meshes, their colours trained around them, and images of both compared.

    Images are unlit, on white, and averaged in linear light from ``samples``² per pixel. A contact sheet per mesh is
    written into the folder of the results.

    Attributes:
        meshes: OBJ or glTF files with texture coordinates and an image.
        texture: settings of the textures.
        coarse: settings of the coarse fit.
        full: settings of another fit, for more rows: its surface, and its texture on the coarse surface.
        views: how many cameras, evenly around the mesh.
        size: width and height of the images.
        samples: per pixel and direction.
        up: "y" or "z".
        resolution: of the marching cubes of the coarse surface.
    """

    name = "texture"
    source = "textures on coarse surfaces; supplement of the paper, Textures"
    row = TextureRow
    apart = ("meshes",)
    meshes: Sequence[str | Path]
    texture: TextureConfig
    coarse: FitConfig
    full: FitConfig | None = None
    views: int = 6
    size: int = 512
    samples: int = 2
    up: str = "y"
    resolution: int = 256

    def jobs(self) -> list[Part]:
        """One for each mesh; see `Benchmark.jobs`."""
        paths = [Path(path) for path in self.meshes]
        found = [(path, _read(path)) for path in paths]
        one_of_each([path.stem for path in paths], "meshes")
        return [Part(self.name, path.stem, (path,), (("image", _digest(mesh)),)) for path, mesh in found]

    def measure(self, job: Part, context: Context) -> list[TextureRow]:
        """See `Benchmark.measure`; raises `KeyboardInterrupt` where the training of a texture was stopped."""
        (path,), shape = job.files, job.name
        mesh = _read(path)
        configs = {"coarse": self.coarse} | ({} if self.full is None else {"full": self.full})
        fits = [self.fitted(path, mesh, config, name, context) for name, config in configs.items()]
        outline = mesh.vertices[np.unique(mesh.faces)]
        cameras = turntable(outline, self.views, width=self.size, height=self.size, up=self.up)
        context.say(f"{shape}: the original")
        wanted = [_original(mesh, camera, self.samples) for camera in cameras]
        series = self.drawn(shape, fits, cameras, context.say)
        write_picture(context.out / f"{shape}.png", _sheet(wanted, series[: len(fits)]))
        return [_row(shape, one, image_error(zip(wanted, one.drawings, strict=True))) for one in series]

    def fitted(self, path: Path, mesh: TexturedMesh, config: FitConfig, name: str, context: Context) -> Fitted:
        """A surface and its texture; whatever is not in the folder of the results yet is trained.

        Raises:
            Interrupted: the fit was stopped; the next call resumes it.
            KeyboardInterrupt: the texture was stopped; the next call trains it anew.
        """
        more = {"image": _digest(mesh), "points": FIT_POINTS, "texture": asdict(self.texture) | {"device": None}}
        run, progress = fit_home(context.out, path, config, **more), context.stage(f"{path.stem} {name}")
        kept_fit(run, sample_textured(mesh, FIT_POINTS, seed=config.seed), config, progress=progress)
        trained = (run / TEXTURE_FILE).is_file() and read_record(run).get("texture", {}).get("finished", False)
        if not trained and not texture_run(run, path, self.texture, progress=progress).record["finished"]:
            raise KeyboardInterrupt
        field, similarity, _ = load_field(find_field(run), device=choose_device(self.texture.device))
        return Fitted(field, similarity, load_texture(run / TEXTURE_FILE, field), read_record(run))

    def drawn(
        self, shape: str, fits: Sequence[Fitted], cameras: Sequence[Camera], say: Callable[[str], None]
    ) -> list[_Series]:
        """All that is compared; first each fit, traced, with its own texture."""
        coarse, samples = fits[0], self.samples
        series = []
        for fitted in fits:
            say(f"{shape}: {fitted.name}, traced")
            series.append(_Series(fitted, "traced", fitted, [_traced(fitted, fitted, c, samples) for c in cameras]))
        say(f"{shape}: the mesh of {coarse.name}")
        try:
            mesh = extract_mesh(coarse.field, resolution=self.resolution)
        except NoSurfaceError as error:
            raise InputError(f"{shape}: the coarse fit has no surface ({error}); give it more steps") from error
        series.append(_Series(coarse, "mesh", coarse, [_rasterised(mesh, coarse, c, samples) for c in cameras]))
        for other in fits[1:]:
            say(f"{shape}: {coarse.name} with the texture of {other.name}")
            series.append(_Series(coarse, "traced", other, [_traced(coarse, other, c, samples) for c in cameras]))
        return series

    def tables(self, rows: Sequence[TextureRow], *, sgemm: float) -> tuple[Table, ...]:
        """Mean squared errors, each with how many times the paper's it is below."""

        def error(region: str) -> Callable[[TextureRow], str]:
            def text(row: TextureRow) -> str:
                mse = getattr(row.error, region)
                return f"{mse:.3g}{_times(row.paper, mse)}"

            return text

        figures: list[Figure[TextureRow]] = [
            (Column("texture around", "s"), lambda r: r.texture),
            (Column("parameters", ",d"), lambda r: r.parameters),
            (Column("fit, s", ".1f"), lambda r: r.fit_seconds),
            (Column("texture", ",d"), lambda r: r.texture_parameters),
            (Column("trained in, s", ".1f"), lambda r: r.texture_seconds),
            (Column("MSE, all pixels", "s"), error("everywhere")),
            (Column("seen by either", "s"), error("either")),
            (Column("inside both", "s"), error("both")),
            (Column("paper", ".4f"), lambda r: r.paper),
            (Column("PSNR either, dB", ".1f"), lambda r: r.psnr_either),
            (Column("PSNR both, dB", ".1f"), lambda r: r.psnr_both),
        ]
        items = [(f"{row.shape} {row.surface}", row) for row in rows]
        return (tabulated(self.name, "Textures on coarse surfaces", "shape, surface", figures, items),)


def _read(path: Path) -> TexturedMesh:
    mesh = read_textured(path)
    if mesh.uv is None:
        raise InputError(f"{path}: no texture coordinates and image in it; export the mesh with its texture")
    return mesh


def _digest(mesh: TexturedMesh) -> str:
    """Of the mesh and its image, which is in a file of its own."""
    return digest_of(array for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.image) if array is not None)


def _original(mesh: TexturedMesh, camera: Camera, samples: int) -> Drawing:
    seen = mesh_view(mesh, camera.resized(camera.width * samples, camera.height * samples))
    assert seen.color is not None
    return draw(seen, seen.color, samples=samples)


@torch.inference_mode()
def _traced(surface: Fitted, painted: Fitted, camera: Camera, samples: int) -> Drawing:
    """The surface of one fit with the texture of another, with the same similarity."""
    fine = camera.moved(surface.similarity).resized(camera.width * samples, camera.height * samples)
    device = painted.texture.delta.device
    seen = trace_view(surface.field, fine, device=device)
    own = surface is painted  # then every hit is in the band, and the geometry need not be asked again
    colors = painted.texture.colors(seen.position) if own else map_colors(painted.texture, seen.position).values
    return draw(seen, colors, samples=samples)


@torch.inference_mode()
def _rasterised(mesh: Mesh, painted: Fitted, camera: Camera, samples: int) -> Drawing:
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
        tiles, differences = [("original", to_bytes(original.rgb))], []
        for one in series:
            label, rgb = one.surface.name.replace("▷", " > "), one.drawings[view].rgb  # OpenCV draws ASCII
            tiles.append((f"texture on {label}", to_bytes(rgb)))
            differences.append((f"{label}: difference x {MAGNIFIED}", to_bytes(MAGNIFIED * np.abs(rgb - original.rgb))))
        lines.append(tiles + differences)
    return contact_sheet(*lines)


def _times(paper: float | None, mse: float) -> str:
    """How many times smaller than the paper's figure an error is, to one or two digits."""
    if paper is None or not mse > 0:
        return ""
    ratio = paper / mse
    return f" ({ratio:.0f}×)" if ratio >= 9.95 else f" ({ratio:.1f}×)"
