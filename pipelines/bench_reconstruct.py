"""``mplicits bench reconstruct``: the multiscale geometry against the network of NeuS, on the same rays."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.synthetic.scenes import scene_mesh
from ..datasets.views.images import PosedImage
from ..neural_fields import InputError, NoSurfaceError
from ..neural_fields.files import write_json
from ..neural_fields.meshing import Mesh, extract_mesh
from .bench_reconstruct_figures import common_sheet, row_of, surface_figures
from .bench_reconstruct_row import EQUAL_TIME, MULTISCALE, NEUS, ReconstructRow, SurfaceFigures
from .bench_reconstruct_scene import BenchScene
from .bench_reconstruct_train import train_watched
from .mesh.files import write_mesh
from .reconstruct.model import RayPool, SceneModel, build_scene
from .reconstruct.trainer import SceneTrainer
from .reconstruct.views import ViewImage, comparison_sheet, held_out, render_image
from .render.rasterise import write_picture
from .run.folder import digest_of
from .run.machine import choose_device, environment
from .run.settings import ReconstructConfig
from .run.trainer import Interrupted, Progress, stop_on_signals
from .surface.surface import Surface, from_mesh
from .surface.trim import in_region

__all__ = ["BenchOptions", "bench_reconstruct"]

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

        def told(trainer: SceneTrainer) -> None:
            self.progress(Progress(stage, trainer.step, config.steps, trainer.fraction, trainer.losses))

        with stop_on_signals() as flag:
            watched = train_watched(model, pool, config, flag, seconds=seconds, report=told)
        if not watched.finished:
            raise Interrupted(self.options.directory)
        trainer = watched.trainer
        model.requires_grad_(False)
        pairs: list[tuple[PosedImage, ViewImage]] = []
        for index, view in enumerate(self.test_views):
            pairs.append((view, render_image(model, view, similarity, trainer.sampling, level=trainer.level)))
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
