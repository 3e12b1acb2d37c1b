"""``mplicits bench reconstruct``: the multiscale geometry against the network of NeuS, on the same rays.

From a training that has ended to a row of ``mplicits bench reconstruct``, and the sheet of all rows of a scene.

What ``mplicits bench reconstruct`` trains on: exact scenes drawn on the spot, and data sets.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from torch import nn

from ...datasets.synthetic.scenes import SCENES, Scene, render_scene, scene_mesh
from ...datasets.views.images import PosedImage, PosedImages, read_posed_images
from ...neural_fields import InputError, NoSurfaceError
from ...neural_fields.baselines import NeusSDF
from ...neural_fields.files import write_json
from ...neural_fields.meshing import Mesh, extract_mesh
from ..mesh.files import write_mesh
from ..reconstruct.model import RayPool, SceneModel, build_scene
from ..reconstruct.views import ViewImage, comparison_sheet, held_out, measure, render_image
from ..render.picture import Image, contact_sheet, write_picture
from ..run.config import closest
from ..run.folder import digest_of
from ..run.machine import choose_device, environment
from ..run.settings import ReconstructConfig
from ..run.trainer import Interrupted, Progress, stop_on_signals
from ..surface.measure import Metrics, evaluate_surfaces
from ..surface.surface import Surface, from_mesh
from ..surface.trim import in_region, keep_largest
from .flops import Watched, train_watched
from .reconstruct_rows import EQUAL_TIME, MULTISCALE, NEUS, ReconstructRow, SurfaceFigures

__all__ = ["BenchOptions", "BenchScene", "bench_reconstruct", "common_sheet", "read_scene", "row_of", "surface_figures"]

SHEET_VIEWS = 4  # rows of a sheet of held-out views
UNUSED = ("texture_steps", "time_budget", "device", "width")  # settings that change no row of one data set


@dataclass(frozen=True)
class BenchOptions:
    """What the bench does beside training.

    Attributes:
        directory: keeps rows, pictures and meshes; rows that are there are used. None keeps nothing.
        equal_time: whether to train the multiscale geometry once more, for as long as NeuS took.
        test_views: at most so many of the held-out views are measured, evenly chosen.
        resolution: of the marching cubes, of the exact surface as well.
        samples: points on each surface for Chamfer distances.
        neus_learning_rate: peak rate of the NeuS rows, where geometry and colours have the same.
    """

    directory: Path | None = None
    equal_time: bool = True
    test_views: int = 8
    resolution: int = 256
    samples: int = 500_000
    neus_learning_rate: float = 1e-3


def bench_reconstruct(
    scenes: Sequence[BenchScene],
    config: ReconstructConfig,
    options: BenchOptions | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> Iterator[ReconstructRow]:
    """Train NeuS's network, the multiscale one with as many steps, and again for as long as NeuS took, on every scene.

    All see the same rays in the same order, with the same numbers of samples. NeuS has its own colour network,
    256 features and the position as it is, and one learning rate for everything but the uncertainty, which both
    sharpen alike.

    Args:
        scenes: of different names.
        config: settings of the multiscale rows; the geometry is chosen here.
        options: what else.
        progress: called with how far a training is.
        report: called with what is going on.

    Yields:
        Finished rows, scene by scene.

    Raises:
        InputError: before any training: nothing would be held out, two scenes have one name, or the directory holds
            rows with other settings.
        Interrupted: a training was asked to stop; the same call with a directory goes on after the last finished row.
    """
    options = options or BenchOptions()
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError(f"{max(names, key=names.count)}: two of the scenes are called that; rename one folder")
    benches = [
        _SceneBench(scene, config, options, progress or (lambda _: None), report or (lambda _: None))
        for scene in scenes
    ]
    for bench in benches:
        bench.check()
    for bench in benches:
        yield from bench.rows()


class _SceneBench:
    """The rows of one scene."""

    def __init__(
        self,
        scene: BenchScene,
        config: ReconstructConfig,
        options: BenchOptions,
        progress: Callable[[Progress], None],
        report: Callable[[str], None],
    ) -> None:
        self.scene, self.options, self.progress, self.report = scene, options, progress, report
        ours = dataclasses.replace(config, geometry="multiscale")
        neus = dataclasses.replace(
            config,
            geometry="neus",
            color_frequencies=0,
            learning_rate=options.neus_learning_rate,
            color_rate=1.0,
        )
        self.configs = {NEUS: neus, MULTISCALE: ours}
        if options.equal_time:
            self.configs[EQUAL_TIME] = ours
        self.device = choose_device(config.device)
        self.train_views, tests = held_out(scene.images.views, config.test_every)
        if not tests:
            raise InputError(f"{scene.name}: no picture is held out to be measured; lower --test-every, but not to 0")
        chosen = np.unique(np.linspace(0, len(tests) - 1, min(options.test_views, len(tests))).round().astype(int))
        self.test_views = [tests[index] for index in chosen]
        self.home = None if options.directory is None else options.directory / scene.name

    @cached_property
    def pool(self) -> RayPool:
        """The rays of all rows."""
        return RayPool(self.train_views, self.scene.images.similarity, self.device)

    @cached_property
    def truth(self) -> Surface | None:
        """The exact surface, in the coordinates of the unit sphere."""
        if self.scene.exact is None:
            return None
        return from_mesh(scene_mesh(self.scene.exact, resolution=self.options.resolution))

    @cached_property
    def digest(self) -> str:
        """Of the pictures and cameras, held-out ones included."""
        images = self.scene.images
        arrays = [np.array([*images.similarity.center, images.similarity.scale])]
        for view in images.views:
            arrays += [view.color, view.camera.intrinsics.numpy(), view.camera.world_from_camera.numpy()]
            arrays += [] if view.mask is None else [view.mask]
        return digest_of(arrays)[:16]

    def settings(self, kind: str) -> dict[str, Any]:
        """All that the figures of a row depend on, as JSON has it."""
        config = {k: v for k, v in dataclasses.asdict(self.configs[kind]).items() if k not in UNUSED}
        where = environment(self.device)
        found = config | {
            "pictures": self.digest,
            "held-out views": len(self.test_views),
            "resolution": self.options.resolution,
            "eval_samples": self.options.samples,
            "device": where["device"],
            "threads": where["threads"],
        }
        return json.loads(json.dumps(found))

    def check(self) -> None:
        """Refuse kept rows with other settings, and make the folder.

        Raises:
            InputError: see `bench_reconstruct`.
        """
        if self.home is None:
            return
        for kind in self.configs:
            self._kept(kind)
        self.home.mkdir(parents=True, exist_ok=True)

    def rows(self) -> Iterator[ReconstructRow]:
        """Each row when it is finished; the sheet of all grows with them."""
        neus_seconds = 0.0
        done: list[ReconstructRow] = []
        for kind in self.configs:
            seconds = neus_seconds if kind == EQUAL_TIME else None
            row = self._kept(kind, seconds)
            if row is None:
                row = self._train(kind, seconds)
            else:
                self.report(f"{self.scene.name}, {kind}: from {self.home}")
            if kind == NEUS:
                neus_seconds = row.seconds
            done.append(row)
            if self.home is not None:
                sheets = [(row, self.home / f"{row.kind}.png") for row in done]
                write_picture(
                    self.home.parent / f"{self.scene.name}.png", common_sheet(sheets, self.test_views[:SHEET_VIEWS])
                )
            yield row

    def _kept(self, kind: str, seconds: float | None = None) -> ReconstructRow | None:
        """The row in the folder; None where there is none, or it was trained for another time than ``seconds``."""
        if self.home is None:
            return None
        path = self.home / f"{kind}.json"
        if not path.is_file() or not path.with_suffix(".png").is_file():
            return None
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            settings, row = dict(kept["settings"]), ReconstructRow.from_dict(kept["row"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged ({error}); remove it") from error
        wanted = self.settings(kind)
        for name in wanted:
            if settings.get(name) != wanted[name]:
                raise InputError(
                    f"{path}: was made with {name} {settings.get(name)}, not {wanted[name]}; "
                    "choose another -o, or remove it"
                )
        return row if seconds in (None, kept["seconds"]) else None

    def _train(self, kind: str, seconds: float | None) -> ReconstructRow:
        """Train, measure, write."""
        config, similarity = self.configs[kind], self.scene.images.similarity
        stage = f"{self.scene.name}, {kind}"
        self.progress(Progress(stage, 0, config.steps, 0.0, {}))
        pool, started = self.pool, time.perf_counter()
        model = build_scene(config, has_masks=pool.has_masks).to(self.device)
        start_seconds = time.perf_counter() - started

        def told(progress: Progress) -> None:
            self.progress(dataclasses.replace(progress, stage=stage, steps=config.steps))

        with stop_on_signals() as flag:
            watched = train_watched(model, pool, config, flag, seconds=seconds, report=told)
        if not watched.finished:
            raise Interrupted(self.options.directory)
        objective, level = watched.trainer.objective, watched.trainer.objective.level_at(watched.trainer.fraction)
        model.requires_grad_(False)
        pairs: list[tuple[PosedImage, ViewImage]] = []
        for index, view in enumerate(self.test_views):
            pairs.append((view, render_image(model, view, similarity, objective.sampling, level=level)))
            done = index + 1
            fraction = done / len(self.test_views)
            self.progress(Progress(f"{stage}: held-out views", done, len(self.test_views), fraction, {}))
        mesh = self._mesh(model)
        row = row_of(
            self.scene,
            kind,
            config,
            watched,
            pairs,
            self._surface(mesh),
            start_seconds=start_seconds,
            device=environment(self.device)["device"],
        )
        if self.home is not None:
            write_picture(self.home / f"{kind}.png", comparison_sheet(pairs[:SHEET_VIEWS], model.background))
            if mesh is not None:
                write_mesh(self.home / f"{kind}.ply", mesh, similarity)
            kept = {"settings": self.settings(kind), "seconds": seconds, "row": row.as_dict()}
            write_json(self.home / f"{kind}.json", kept)
        return row

    def _mesh(self, model: SceneModel) -> Mesh | None:
        """In unit-sphere coordinates; None where there is no surface, or nobody wants it."""
        if self.home is None and self.scene.exact is None:
            return None
        try:
            return in_region(extract_mesh(model.geometry, resolution=self.options.resolution))
        except NoSurfaceError:
            return None

    def _surface(self, mesh: Mesh | None) -> SurfaceFigures | None:
        """How near a mesh is to the exact surface; None where one of them is missing."""
        if mesh is None or self.truth is None:
            return None
        options = self.options
        columns = min(512, 2 * options.resolution)  # finer ones see no more of these meshes
        return surface_figures(
            mesh, self.truth, samples=options.samples, columns=columns, seed=self.configs[MULTISCALE].seed
        )


COMMON_VIEWS = 2  # on the sheet of all rows


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
    neus = isinstance(model.geometry, NeusSDF)
    sizes = [(model.geometry.width, model.geometry.depth)] if neus else zip(config.widths, config.depths, strict=True)
    name = "▷".join(f"({width},{depth})" for width, depth in sizes)
    return ReconstructRow(
        scene=scene.name,
        kind=kind,
        network=f"NeuS {name}" if neus else name,
        steps=trainer.step,
        rays=config.rays,
        seconds=trainer.elapsed,
        start_seconds=start_seconds,
        step_seconds=watched.step_seconds,
        views=len(views),
        psnr=float(np.mean([figures["psnr"] for figures in views])),
        psnr_object=float(np.mean(inside)) if inside else None,
        ssim=float(np.mean([figures["ssim"] for figures in views])),
        parameters=_size(model.geometry),
        color_parameters=_size(model.color),
        outside_parameters=0 if model.outside is None else _size(model.outside),
        geometry_flops=watched.geometry_flops / rays,
        color_flops=watched.color_flops / rays,
        values_per_ray=tuple(rows / rays for rows in watched.values),
        jets_per_ray=tuple(rows / rays for rows in watched.jets),
        colors_per_ray=watched.colors / rays,
        finest_share=watched.finest_share,
        exact=scene.exact is not None,
        surface=surface,
        inv_std=float(model.inv_std),
        deltas=tuple(model.geometry.deltas.tolist()),
        device=device,
    )


def _size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def surface_figures(mesh: Mesh, truth: Surface, *, samples: int, columns: int = 512, seed: int = 0) -> SurfaceFigures:
    """A mesh, and its largest component, against the exact surface; both in the same coordinates.

    Args:
        mesh: to be judged.
        truth: the exact surface.
        samples: points on each of them.
        columns: of the volumetric IoU, see `evaluate_surfaces`.
        seed: of the samples.
    """

    def judge(part: Mesh) -> Metrics:
        return evaluate_surfaces(from_mesh(part), truth, samples=samples, seed=seed, columns=columns)

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


@dataclass(frozen=True)
class BenchScene:
    """Posed images, and what is known of them.

    Attributes:
        name: for tables and files.
        images: what is trained on and measured.
        exact: the scene that they show, if it is known in closed form; its similarity is the identity.
    """

    name: str
    images: PosedImages
    exact: Scene | None


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
