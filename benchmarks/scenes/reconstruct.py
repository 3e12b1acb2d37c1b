"""Benchmark ``reconstruct``: the multiscale geometry against the network of NeuS, on the same rays."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from mplicits.datasets.synthetic.scenes import SCENES, Scene, render_scene, scene_mesh
from mplicits.datasets.views.images import PosedImage, PosedImages, read_posed_images
from mplicits.neural_fields import InputError, Mesh, NoSurfaceError
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.neural_fields.meshing.extract import extract_mesh
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.reconstruct.consistency import GreyPictures
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel, build_scene
from mplicits.pipelines.reconstruct.views import ViewImage, comparison_sheet, held_out, measure, render_camera
from mplicits.pipelines.render.picture import Image, contact_sheet, write_picture
from mplicits.pipelines.surface.measure import Metrics, evaluate_surfaces
from mplicits.pipelines.surface.surface import in_region, keep_largest
from mplicits.pipelines.training.folder import digest_of
from mplicits.pipelines.training.scaffold import environment
from mplicits.pipelines.training.settings import ReconstructConfig, closest
from mplicits.pipelines.training.trainer import Interrupted, Progress, parameter_count, stop_on_signals

from ..harness.benchmark import Benchmark, Part, network_name, one_of_each, plain
from ..harness.jobs import Context, Registry, read_record, record_file
from ..harness.tables import Table
from .flops import LateRows, Watched, train_watched
from .reconstruct_rows import (
    EQUAL_TIME,
    MULTISCALE,
    NEUS,
    LateRates,
    ReconstructRow,
    SurfaceFigures,
    reconstruct_tables,
)

SHEET_VIEWS = 4  # rows of a sheet of held-out views
COMMON_VIEWS = 2  # on the sheet of all rows
UNUSED = ("texture_steps", "time_budget", "device", "width", "graphs")  # settings that change no row of one data set
ALIKE: Mapping[str, Any] = {"jets": 0, "focus": 0.0}  # or each network would have rays of its own


@dataclass(frozen=True, eq=False)
class BenchScene:
    """Posed images, and the exact scene where there is one.

    Attributes:
        name: for tables and files.
        images: what is trained on and measured.
        exact: the scene that they show, if it is known in closed form; its similarity is the identity.
    """

    name: str
    images: PosedImages
    exact: Scene | None

    @cached_property
    def digest(self) -> str:
        """Of the pictures and cameras."""
        arrays = [np.array([*self.images.similarity.center, self.images.similarity.scale])]
        for view in self.images.views:
            arrays += [view.color, view.camera.intrinsics.numpy(), view.camera.world_from_camera.numpy()]
            arrays += [] if view.mask is None else [view.mask]
        return digest_of(arrays)[:16]


@lru_cache(maxsize=4)  # of the scenes that are trained at a time
def _exact_surface(scene: BenchScene, resolution: int) -> Mesh | None:
    """In the coordinates of the unit sphere; None where it is not known."""
    return None if scene.exact is None else scene_mesh(scene.exact, resolution=resolution)


@dataclass(frozen=True, kw_only=True)
class ReconstructBench(Benchmark[ReconstructRow]):
    """NeuS's network, the multiscale one with as many steps, and again for as long as NeuS took, on every scene.

    All see the same rays in the same order, with the same numbers of samples and the same threshold below which
    intervals are skipped. NeuS has its own colour network,
    256 features and the position without an encoding. It has one learning rate for everything but the uncertainty,
    which both sharpen alike. A sheet of all rows per scene is written into the folder of the results.

    Attributes:
        scenes: of different names.
        config: settings of the multiscale rows; the geometry is chosen here.
        equal_time: whether to train the multiscale geometry once more, for as long as NeuS took.
        test_views: the most held-out views that are measured, evenly chosen.
        resolution: of the marching cubes, of the exact surface as well.
        samples: points on each surface for Chamfer distances.
        neus_learning_rate: peak rate of the NeuS rows, where geometry and colours have the same.
    """

    name = "reconstruct"
    source = "the multiscale geometry against the network of NeuS"
    row = ReconstructRow
    apart = ("scenes", "config", "equal_time", "test_views", "neus_learning_rate")
    scenes: Sequence[BenchScene]
    config: ReconstructConfig
    equal_time: bool = True
    test_views: int = 8
    resolution: int = 256
    samples: int = 500_000
    neus_learning_rate: float = 1e-3

    def jobs(self) -> list[Part]:
        """One for each row; see `Benchmark.jobs`."""
        one_of_each([scene.name for scene in self.scenes], "scenes")
        return [self.part(scene, kind) for scene in self.scenes for kind in self.kinds]

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the rows of a scene, in order."""
        return (NEUS, MULTISCALE, EQUAL_TIME) if self.equal_time else (NEUS, MULTISCALE)

    def part(self, scene: BenchScene, kind: str) -> Part:
        """The job of a row."""
        what = (("scene", scene.name), ("kind", kind), ("pictures", scene.digest))
        return Part(self.name, f"{scene.name}, {kind}", options=(*what, ("views", len(self.views(scene)[1]))))

    def config_of(self, kind: str) -> ReconstructConfig:
        """The settings of a row; all of them see the same rays."""
        if kind != NEUS:
            return dataclasses.replace(self.config, geometry="multiscale", **ALIKE)
        rates = {"learning_rate": self.neus_learning_rate, "color_rate": 1.0, "sharpening": 8.0}
        colors = {"color_width": 256, "color_depth": 4, "color_frequencies": 0, "color_grid": 0}
        return dataclasses.replace(self.config, geometry="neus", **ALIKE, **colors, **rates)

    def settings(self, job: Part) -> Mapping[str, Any]:
        """See `Benchmark.settings`; of the row's own settings those that change it."""
        config = plain(self.config_of(job.parameters["kind"]))
        return {**super().settings(job), "config": {k: v for k, v in config.items() if k not in UNUSED}}

    def views(self, scene: BenchScene) -> tuple[list[PosedImage], list[PosedImage]]:
        """What is trained on, and what is measured.

        Raises:
            InputError: no picture is held out.
        """
        train, tests = held_out(scene.images.views, self.config.test_every)
        if not tests:
            raise InputError(f"{scene.name}: no picture is held out to be measured; lower --test-every, but not to 0")
        chosen = np.unique(np.linspace(0, len(tests) - 1, min(self.test_views, len(tests))).round().astype(int))
        return train, [tests[index] for index in chosen]

    def measure(self, job: Part, context: Context) -> list[ReconstructRow]:
        """See `Benchmark.measure`; a training that is interrupted begins anew."""
        kind = job.parameters["kind"]
        scene = next(scene for scene in self.scenes if scene.name == job.parameters["scene"])
        seconds = None
        if kind == EQUAL_TIME:
            assert context.first is not None
            record = read_record(context.out, context.first(self.part(scene, NEUS)).key)
            assert record is not None
            seconds = record["outputs"][0]["seconds"]
        row = self.trained(scene, kind, seconds, context)
        key = Registry([self]).key
        if kind == NEUS:  # the row of equal time belongs to the time of another training
            record_file(context.out, key(self.part(scene, EQUAL_TIME))).unlink(missing_ok=True)
        sheets = []
        for part in (self.part(scene, other) for other in self.kinds):
            record = read_record(context.out, key(part))
            rows = [row] if part == job else [] if record is None else self.read([record])
            sheets += [(one, Context(context.out, key(part)).picture("views")) for one in rows]
        there = [(one, picture) for one, picture in sheets if picture.is_file()]
        write_picture(context.out / f"{scene.name}.png", common_sheet(there, self.views(scene)[1][:SHEET_VIEWS]))
        return [row]

    def build(self, config: ReconstructConfig, *, has_masks: bool, views: int) -> SceneModel:
        """An untrained scene; see `build_scene`."""
        return build_scene(config, has_masks=has_masks, views=views)

    def trained(self, scene: BenchScene, kind: str, seconds: float | None, context: Context) -> ReconstructRow:
        """Train, measure, write pictures and the mesh."""
        config, similarity, device = self.config_of(kind), scene.images.similarity, choose_device(self.device)
        (train, tests), stage = self.views(scene), f"{scene.name}, {kind}"
        report = context.progress or (lambda _: None)
        report(Progress(stage, 0, config.steps, 0.0, {}))
        started, has_masks = time.perf_counter(), all(view.mask is not None for view in train)
        model = self.build(config, has_masks=has_masks, views=len(train)).to(device)
        pool = RayPool(train, similarity, device, whole=model.outside is not None)
        start_seconds = time.perf_counter() - started

        def told(progress: Progress) -> None:
            report(dataclasses.replace(progress, stage=stage, steps=config.steps))

        with stop_on_signals() as flag:
            pictures = GreyPictures(train, device) if config.consistency else None
            watched = train_watched(model, pool, config, flag, pictures=pictures, seconds=seconds, report=told)
        if not watched.finished:
            raise Interrupted(context.out)
        objective, level = watched.trainer.objective, watched.trainer.objective.level_at(watched.trainer.fraction)
        model.requires_grad_(False)
        pairs: list[tuple[PosedImage, ViewImage]] = []
        for done, view in enumerate(tests, start=1):
            pairs.append((view, render_camera(model, view.camera.moved(similarity), objective.sampling, level=level)))
            report(Progress(f"{stage}: held-out views", done, len(tests), done / len(tests), {}))
        write_picture(context.picture("views"), comparison_sheet(pairs[:SHEET_VIEWS], model.background))
        mesh = self._mesh(model)
        if mesh is not None:
            write_mesh(context.mesh("surface"), mesh, similarity)
        name, surface = environment(device)["device"], self._surface(mesh, scene)
        return row_of(scene, kind, config, watched, pairs, surface, start_seconds=start_seconds, device=name)

    def _mesh(self, model: SceneModel) -> Mesh | None:
        """In unit-sphere coordinates; None where there is no surface."""
        try:
            return in_region(extract_mesh(model.geometry, resolution=self.resolution))
        except NoSurfaceError:
            return None

    def _surface(self, mesh: Mesh | None, scene: BenchScene) -> SurfaceFigures | None:
        """How near a mesh is to the exact surface; None where one of them is missing."""
        truth = _exact_surface(scene, self.resolution)
        if mesh is None or truth is None:
            return None
        columns = min(512, 2 * self.resolution)  # finer ones see no more of these meshes
        return surface_figures(mesh, truth, samples=self.samples, columns=columns, seed=self.config.seed)

    def tables(self, rows: Sequence[ReconstructRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `reconstruct_tables`."""
        return reconstruct_tables(self.name, rows, sgemm=sgemm)


def row_of(
    scene: BenchScene,
    kind: str,
    config: ReconstructConfig,
    watched: Watched,
    pairs: Sequence[tuple[PosedImage, ViewImage]],
    surface: SurfaceFigures | None,
    *,
    start_seconds: float,
    device: str,
) -> ReconstructRow:
    """All figures of a training.

    Args:
        scene: what was trained on.
        kind: see `ReconstructRow`.
        config: settings of the training.
        watched: the training.
        pairs: held-out views, and how the model renders them.
        surface: how near the surface came, if that can be said.
        start_seconds: see `ReconstructRow`.
        device: where it was trained.
    """
    trainer, model = watched.trainer, watched.trainer.objective.model
    views = [measure(image, view, model.background) for view, image in pairs]
    inside = [figures["psnr_object"] for figures in views if "psnr_object" in figures]
    rays = trainer.step * config.rays
    if isinstance(model.geometry, NeusSDF):
        network = f"NeuS {network_name([(model.geometry.width, model.geometry.depth)])}"
    else:
        network = network_name(zip(config.widths, config.depths, strict=True))
    return ReconstructRow(
        scene=scene.name,
        kind=kind,
        network=network,
        steps=trainer.step,
        rays=config.rays,
        seconds=trainer.elapsed,
        start_seconds=start_seconds,
        step_seconds=watched.step_seconds,
        views=len(views),
        psnr=float(np.mean([figures["psnr"] for figures in views])),
        psnr_object=float(np.mean(inside)) if inside else None,
        ssim=float(np.mean([figures["ssim"] for figures in views])),
        parameters=parameter_count(model.geometry),
        color_parameters=parameter_count(model.color),
        outside_parameters=0 if model.outside is None else parameter_count(model.outside),
        geometry_flops=watched.geometry_flops / rays,
        color_flops=watched.color_flops / rays,
        values_per_ray=tuple(rows / rays for rows in watched.values),
        jets_per_ray=tuple(rows / rays for rows in watched.jets),
        colors_per_ray=watched.colors / rays,
        late=late_rates(watched.late, config.rays),
        parts=watched.parts,
        finest_share=watched.finest_share,
        exact=scene.exact is not None,
        surface=surface,
        inv_std=float(model.inv_std),
        deltas=tuple(model.geometry.deltas.tolist()),
        device=device,
    )


def late_rates(late: LateRows | None, rays: int) -> LateRates | None:
    """Rows of the second half, per ray."""
    if late is None:
        return None
    count = late.steps * rays
    return LateRates(
        values=tuple(rows / count for rows in late.values),
        jets=tuple(rows / count for rows in late.jets),
        colors=late.colors / count,
    )


def surface_figures(mesh: Mesh, truth: Mesh, *, samples: int, columns: int = 512, seed: int = 0) -> SurfaceFigures:
    """A mesh, and its largest component, against the exact surface; both in the same coordinates.

    Args:
        mesh: to be judged.
        truth: the exact surface.
        samples: points on each of them.
        columns: of the volumetric IoU, see `evaluate_surfaces`.
        seed: of the samples.
    """

    def judge(part: Mesh) -> Metrics:
        return evaluate_surfaces(part, truth, samples=samples, seed=seed, columns=columns)

    whole = judge(mesh)
    largest = whole if whole.components == 1 else judge(keep_largest(mesh))
    return SurfaceFigures(
        chamfer=whole.chamfer,
        floor=whole.chamfer_floor,
        largest_chamfer=largest.chamfer,
        iou=whole.iou,
        normal_consistency=whole.normal_consistency,
        components=whole.components,
    )


def common_sheet(sheets: Sequence[tuple[ReconstructRow, Path]], views: Sequence[PosedImage]) -> Image:
    """The first views as all rows render them: two lines for each, colours beside the photograph, and normals.

    Args:
        sheets: rows, and the files of their `comparison_sheet` of ``views``.
        views: the photographs.
    """
    panels = [_panels(iio.imread(path), views) for _, path in sheets]
    lines = []
    for index in range(min(COMMON_VIEWS, len(views))):
        photograph = panels[0][index][0]
        colors, normals = [("photograph", photograph)], [(views[index].name, np.full_like(photograph, 255))]
        for (row, _), found in zip(sheets, panels, strict=True):
            # OpenCV draws ASCII.
            name = "equal time" if row.kind == EQUAL_TIME else row.network.replace("▷", " > ")
            colors.append((f"{name}: {row.psnr:.2f} dB", found[index][1]))
            normals.append((f"normals, {row.steps} steps", found[index][2]))
        lines += [colors, normals]
    return contact_sheet(*lines)


def _panels(sheet: Image, views: Sequence[PosedImage]) -> list[tuple[Image, Image, Image]]:
    """Photograph, colours and normals of each view on a `comparison_sheet`, in whole multiples of their size."""
    sizes = [view.color.shape[:2] for view in views]
    factor = sheet.shape[1] // (3 * max(width for _, width in sizes))
    gap = sheet.shape[0] // factor - sum(height for height, _ in sizes)
    found, top = [], 0
    for height, width in sizes:
        line = sheet[top : top + factor * height]
        photograph, color, normal = (line[:, k * factor * width : (k + 1) * factor * width] for k in range(3))
        found.append((photograph, color, normal))
        top += factor * height + factor * gap // len(sizes)
    return found


def read_scene(
    name: str,
    *,
    views: int = 24,
    size: int = 64,
    width: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BenchScene:
    """A scene of `SCENES`, drawn on the spot, or a data set.

    Args:
        name: of a scene, or the path of a data set (./statue for a folder that is called like a scene).
        views: of a scene.
        size: of a scene's images.
        width: to which the pictures of a data set are shrunk.
        progress: called with ``(done, total)`` while a scene is drawn.

    Raises:
        InputError: no such scene or data set, or it cannot be read.
    """
    if name in SCENES:
        scene = SCENES[name]()
        return BenchScene(name, render_scene(scene, views, size, progress=progress), scene)
    path = Path(name)
    if not path.exists():
        raise InputError(f"{name}: no such data set, and no scene of that name{closest(name, SCENES)}")
    images = read_posed_images(path, width=width)
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    return BenchScene(folder.name, images, None)
