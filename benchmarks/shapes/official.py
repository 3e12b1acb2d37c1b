"""Benchmark ``official``: the protocol of the paper's own code on its folders, ours beside its checkpoints.

It follows ``reproduce.py`` and REPRODUCING.md of dsilvavinicius/m-plicits. The vertices of
``data/normalized_sphere/input`` are fitted, or those of ``data/normalized_noise/noise_data``. Meshes have 512³ cells;
500,000 samples give squared distances in the coordinates of the files. The truth is always the clean mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from mplicits.datasets import add_noise, read_cloud, write_cloud_ply
from mplicits.neural_fields import InputError, Mesh, MultiscaleSDF, Similarity
from mplicits.neural_fields.backend.files import files_in
from mplicits.pipelines.fit.official import import_official
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.surface.measure import evaluate_surfaces
from mplicits.pipelines.surface.surface import read_reference
from mplicits.pipelines.training.folder import STAGES, WEIGHTS_FILE
from mplicits.pipelines.training.result import Run
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import parameter_count

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, mean, median, tabulated
from .fits import fit_home, in_input, kept_fit, stage_seconds, timed_mesh

INPUTS = Path("data/normalized_sphere/input")
NOISY = Path("data/normalized_noise/noise_data")
NOISE = 0.01  # share of the diagonal by which vertices move along their normals (tools/perturb_mesh.py)
FIXED = (0.1, 0.06)  # bands of reconstruct.py
FIXED_NAME = "official fine, fixed bands"


class Verified(NamedTuple):
    """What their verification log prints, over the shapes that it could use."""

    shapes: int
    mean_chamfer: float
    median_chamfer: float
    mean_iou: float
    median_iou: float


# REPRODUCING.md, section 7, a run of 2026-09-16 on an RTX 5090: (noisy, method) → figures.
VERIFIED: Mapping[tuple[bool, str], Verified] = MappingProxyType(
    {
        (False, "official coarse"): Verified(36, 3.90e-5, 2.17e-5, 0.522, 0.579),
        (False, "official fine"): Verified(34, 2.01e-5, 1.14e-5, 0.723, 0.869),
        (False, FIXED_NAME): Verified(34, 1.40e-4, 6.87e-5, 0.489, 0.583),
        (True, "official fine"): Verified(35, 2.59e-5, 1.65e-5, 0.529, 0.548),
    }
)


@dataclass(frozen=True)
class OfficialRow:
    """One level on one shape.

    Attributes:
        shape: name of the file, without its extension.
        noisy: whether it was fitted to the noisy points.
        method: "ours coarse", "official fine" and so on.
        parameters: of the levels up to this one.
        delta: half-width of the band around the level before; None for the coarse one.
        seconds: training up to and with this level, here; None of a checkpoint.
        mesh_seconds: extraction, here.
        chamfer: squared, both ways, in the coordinates of the file; None where there is no surface.
        floor: the same of another sampling of the truth.
        hausdorff: largest squared distance.
        shell_iou: overlap of the surface voxels of size 0.01.
        components: of the mesh.
    """

    shape: str
    noisy: bool
    method: str
    parameters: int
    delta: float | None
    seconds: float | None
    mesh_seconds: float
    chamfer: float | None = None
    floor: float | None = None
    hausdorff: float | None = None
    shell_iou: float | None = None
    components: int | None = None


@dataclass(frozen=True, kw_only=True)
class OfficialBench(Benchmark[OfficialRow]):
    """Fits of the shapes of their archive, and its checkpoints where there are some.

    Attributes:
        folder: with ``data`` in it, as their archive unpacks.
        config: settings of our fits.
        shapes: names of the files; all of them by default.
        results: the folder of their checkpoints; None measures ours alone.
        resolution: cells along each side of the extraction box.
        samples: points drawn on each surface.
    """

    name = "official"
    source = "the protocol of dsilvavinicius/m-plicits on its folders"
    row = OfficialRow
    apart = ("folder", "shapes", "results")
    folder: Path
    config: FitConfig
    shapes: Sequence[str] = ()
    results: Path | None = None
    resolution: int = 512
    samples: int = 500_000

    def jobs(self) -> list[Part]:
        """One for each shape, clean and where there are noisy points too, ours and theirs; see `Benchmark.jobs`."""
        inputs = self.folder / INPUTS
        if not inputs.is_dir():
            raise InputError(f"{inputs}: no such folder; DIR is where their archive was unpacked, or use --add MESH")
        files = {file.stem: file for file in files_in(inputs, (".ply",))}
        for name in self.shapes:
            if name not in files:
                raise InputError(f"--shapes {name}: {inputs} has {', '.join(files) or 'no .ply file'}")
        planned = []
        for name in self.shapes or files:
            read_reference(files[name])
            noisy = self.folder / NOISY / f"{name}.ply"
            for damaged, cloud in ((False, files[name]), (True, noisy)):
                if cloud.is_file():
                    planned.append(self._part(name, files[name], cloud, ours=True, noisy=damaged))
            if self.results is not None and (self.results / name).is_dir():
                planned.append(self._part(name, files[name], files[name], ours=False, noisy=False))
        return planned

    def _part(self, name: str, truth: Path, cloud: Path, *, ours: bool, noisy: bool) -> Part:
        files = [truth, cloud]
        if not ours:
            assert self.results is not None
            files += [file for stage in STAGES if (file := self.results / name / stage / WEIGHTS_FILE).is_file()]
        label = f"{name}{', noisy' * noisy}, {'ours' if ours else 'official'}"
        return Part(self.name, label, tuple(files), (("ours", ours), ("noisy", noisy)))

    def measure(self, job: Part, context: Context) -> list[OfficialRow]:
        """See `Benchmark.measure`."""
        (truth, cloud, *checkpoints), about = job.files, job.parameters
        reference, noisy = read_reference(truth), bool(about["noisy"])
        if about["ours"]:
            home = fit_home(context.out, cloud, self.config)
            run = kept_fit(home, read_cloud(cloud), self.config, progress=context.stage(job.name))
        else:
            run = import_official(checkpoints, cloud=truth)
        whose = "ours" if about["ours"] else "official"
        names = [*STAGES, *(f"level {level}" for level in range(len(STAGES), run.field.num_levels))]
        rows = [
            self._row(run, level, truth.stem, reference, f"{whose} {names[level]}", noisy)
            for level in range(run.field.num_levels)
        ]
        if len(checkpoints) > 1:
            fixed = import_official(checkpoints, deltas=FIXED[: len(checkpoints) - 1])
            rows.append(self._row(fixed, len(checkpoints) - 1, truth.stem, reference, FIXED_NAME, noisy))
        return rows

    def _row(
        self, run: Run[MultiscaleSDF], level: int, shape: str, reference: Mesh, method: str, noisy: bool
    ) -> OfficialRow:
        mesh, mesh_seconds = timed_mesh(run, self.resolution, level)
        figures: dict[str, Any] = {}
        if mesh is not None:
            surface = in_input(mesh, run.similarity)
            metrics = evaluate_surfaces(surface, reference, samples=self.samples, seed=self.config.seed)
            assert metrics.chamfer_floor is not None
            unit = metrics.scale**2  # to the coordinates of the file, as they measure
            figures = {"chamfer": metrics.chamfer * unit, "floor": metrics.chamfer_floor * unit}
            figures |= {"hausdorff": metrics.hausdorff * unit}
            figures |= {"shell_iou": metrics.shell_iou, "components": metrics.components}
        seconds = [stage_seconds(stage) for stage in run.record["stages"][: level + 1] if "training_seconds" in stage]
        return OfficialRow(
            shape=shape,
            noisy=noisy,
            method=method,
            parameters=parameter_count(*run.field.levels[: level + 1]),
            delta=float(run.field.deltas[level - 1]) if level else None,
            seconds=sum(seconds) if seconds else None,
            mesh_seconds=mesh_seconds,
            **figures,
        )

    def tables(self, rows: Sequence[OfficialRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`: each shape, and means and medians over those that have a surface."""

        def of(name: str) -> Callable[[OfficialRow], Any]:
            return lambda row: getattr(row, name)

        figures: list[Figure[OfficialRow]] = [
            (Column("method", "s"), of("method")),
            (Column("Chamfer", ".2e"), lambda row: "no surface" if row.chamfer is None else row.chamfer),
            (Column("floor", ".2e"), of("floor")),
            (Column("Hausdorff", ".1e"), of("hausdorff")),
            (Column("shell IoU", ".3f"), of("shell_iou")),
            (Column("parts", "d"), of("components")),
            (Column("δ before", ".4f"), of("delta")),
            (Column("parameters", ",d"), of("parameters")),
            (Column("fit, s", ".1f"), of("seconds")),
            (Column("mesh, s", ".1f"), of("mesh_seconds")),
        ]
        items = [(f"{row.shape}{' + noise' * row.noisy}", row) for row in rows]
        each = tabulated("official_shapes", "Each shape", "shape", figures, items)
        keys = [*((row.noisy, row.method) for row in rows), *VERIFIED]
        groups = {key: _Group([], VERIFIED.get(key)) for key in sorted(dict.fromkeys(keys), key=lambda key: key[0])}
        for row in rows:
            groups[row.noisy, row.method].rows.append(row)

        def over(average: Callable[[Iterable[Any]], float | None], name: str) -> Callable[[_Group], float | None]:
            return lambda group: average(getattr(row, name) for row in group.rows)

        means: list[Figure[_Group]] = [
            (Column("shapes", "d"), lambda group: sum(row.chamfer is not None for row in group.rows)),
            (Column("mean CD", ".2e"), over(mean, "chamfer")),
            (Column("median CD", ".2e"), over(median, "chamfer")),
            (Column("mean shell IoU", ".3f"), over(mean, "shell_iou")),
            (Column("median shell IoU", ".3f"), over(median, "shell_iou")),
            (Column("mean floor", ".2e"), over(mean, "floor")),
            (Column("fit, s", ".0f"), over(mean, "seconds")),
            (Column("mesh, s", ".1f"), over(mean, "mesh_seconds")),
        ]
        named = [(f"{method}{' + noise' * noisy}", group) for (noisy, method), group in groups.items()]
        notes = (
            "In brackets: their verification log (2026-09-16, an RTX 5090, 34 to 36 shapes of their archive). Means "
            "over other shapes are no comparison.",
            "Chamfer distances are squared and in the coordinates of the files; shell IoU is the overlap of surface "
            "voxels of size 0.01.",
        )
        title = "Means and medians over the shapes"
        summary = tabulated(
            "official", title, "method", means, named, published=lambda group: group.printed, notes=notes
        )
        return summary, each


class _Group(NamedTuple):
    """The rows of one method, and what their log prints of it."""

    rows: list[OfficialRow]
    printed: Verified | None


def add_shapes(folder: Path, meshes: Sequence[Path], *, seed: int = 0) -> None:
    """Write meshes as their archive has them: in the unit sphere, and their vertices with 1 % noise.

    Raises:
        InputError: a mesh cannot be read, or a shape of that name is there.
    """
    for path in meshes:
        target = folder / INPUTS / f"{path.stem}.ply"
        if target.exists():
            raise InputError(f"{target}: exists; rename {path.name}, or remove it")
        mesh = read_reference(path)
        write_mesh(target, mesh.moved(Similarity.to_unit_sphere(mesh.used_vertices())))
        write_cloud_ply(folder / NOISY / target.name, add_noise(read_cloud(target), NOISE, seed=seed))
