"""A cloud that one network cannot hold: cut into tiles, fitted side by side, and joined to one field."""

from __future__ import annotations

import dataclasses
import itertools
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from ...datasets.clouds.large import Survey, merge_cloud
from ...datasets.clouds.readers.columns import CloudStream, MemoryStream
from ...datasets.clouds.readers.reading import check_cloud_path, open_stream, read_cloud
from ...datasets.clouds.tiling import TilePlan, plan_tiles, tile_name, write_tiles
from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.files import check_place, damage, write_json
from ...neural_fields.checkpoint import TileFiles
from ...neural_fields.fields.tiled import Split, TiledField
from ..surface.surface import support_of_tiles
from ..training.folder import FIELD_FILE, RunFolder, is_fitted, named_cloud, read_record
from ..training.jobs import check_jobs
from ..training.progress import counted, reported, silent
from ..training.result import Run
from ..training.scaffold import environment
from ..training.settings import FitConfig, load_config
from ..training.trainer import Progress, Report
from .cloud import CloudDistance, Surroundings, file_facts
from .many import FitJob, FitOutcome, read_kept, run_fits
from .samples import DOMAIN

PLAN_FILE = "tiles.json"  # in the run directory: the boxes and the settings of all tiles
POINTS, RUNS = "points", "tiles"  # folders there: points of the tiles until all are fitted, and their runs
AROUND_FILE, AROUND = "around.npy", 30_000  # means of the whole cloud, beside the points of the tiles, and how many


@dataclass(frozen=True)
class SeamOptions:
    """How tiles are compared where they overlap."""

    points: int = 2_000  # of each tile, on average
    share: float = 0.5  # of the reach: how far from the surface, at most


SEAMS = SeamOptions()


@dataclass(frozen=True)
class TilesJob:
    """A cloud, the plan of its tiles, their settings and the directory of them all."""

    cloud: Path
    directory: Path
    plan: TilePlan
    config: FitConfig

    @property
    def oriented(self) -> bool:
        """Whether the normals of the cloud say where inside is."""
        return self.plan.normals and self.config.normals in ("auto", "file")

    @property
    def aided(self) -> bool:
        """Whether what lies around a tile decides with it where inside is."""
        return self.oriented and bool(self.plan.cuts)

    @property
    def similarity(self) -> Similarity:
        """From input coordinates to those of the joined field: the box of the points lies in the unit sphere."""
        return Similarity.to_unit_sphere(np.array([self.plan.low, self.plan.high]))

    def jobs(self, at_a_time: int) -> list[FitJob]:
        """The fits; a time budget is shared out."""
        budget = self.config.time_budget
        config = dataclasses.replace(
            self.config,
            columns="x,y,z,nx,ny,nz" if self.plan.normals else "x,y,z",
            drop_noise=False,
            time_budget=None if budget is None else budget * at_a_time / self.plan.num_tiles,
        )
        points, runs, parts = self.directory / POINTS, self.directory / RUNS, []
        for number in range(self.plan.num_tiles):
            name = tile_name(number)
            around = Surroundings(points / AROUND_FILE, self.plan, number) if self.aided else None
            parts.append(FitJob(points / name, runs / Path(name).stem, config, True, around))
        return parts


def plan_fit(
    cloud: str | Path,
    out: Path,
    config: FitConfig | None,
    *,
    size: float | None = None,
    resume: bool = False,
    report: Report | None = None,
) -> TilesJob:
    """Cut a cloud into tiles, see `plan_tiles`, and write the points of each to the run directory ``out``.

    With ``resume`` the plan there is taken, with its settings.

    Raises:
        InputError: the cloud cannot be read or has changed, there is nothing to resume, or the disk is too small.
    """
    path, report = check_cloud_path(cloud), report or silent
    check_place(out)
    job = _read_plan(path, out) if resume else None
    points = out / POINTS
    if job is not None and (points.is_dir() or all(is_fitted(fit.directory) for fit in job.jobs(1))):
        return job
    settings = job.config if job is not None else config or FitConfig()
    stream: CloudStream | None = open_stream(path, columns=settings.columns, drop_noise=settings.drop_noise)
    if stream is None:
        stream = MemoryStream(read_cloud(path, columns=settings.columns, drop_noise=settings.drop_noise))
    with reported(report, "choosing tiles"):
        plan, frame = plan_tiles(stream, size=size)
    job = job or TilesJob(path, out, plan, settings)
    for folder in (out / RUNS, points):
        shutil.rmtree(folder, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    (out / FIELD_FILE).unlink(missing_ok=True)  # of an older run
    about = {**file_facts(path), "config": dataclasses.asdict(job.config)}
    write_json(out / PLAN_FILE, about | {"plan": dataclasses.asdict(job.plan)})
    partial = points.with_name(f".{POINTS}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    write_tiles(stream, job.plan, frame, partial, report=counted(report, "sorting points into tiles"))
    if job.aided:
        with reported(report, "what lies around tiles"):
            np.save(partial / AROUND_FILE, _dipoles(stream, frame, job.similarity))
    partial.rename(points)
    return job


def _dipoles(stream: CloudStream, frame: Survey, similarity: Similarity) -> NDArray[np.float64]:
    """Means of the cloud with their normals times areas ``(N, 6)``, which tell each tile where inside is."""
    merged = merge_cloud(stream, AROUND, frame=frame)
    assert merged is not None
    cloud = merged[0]
    assert cloud.normals is not None
    kept = cloud.normals.any(axis=1)
    points, normals = cloud.points[kept], cloud.normals[kept]
    unit = torch.from_numpy(similarity.to_unit(points).astype(np.float32))
    areas = CloudDistance(unit, torch.from_numpy(normals)).areas * similarity.scale**2
    return np.concatenate((points, normals * areas[:, None]), axis=1)


def _read_plan(cloud: Path, out: Path) -> TilesJob:
    path = out / PLAN_FILE
    about = read_kept(path)
    if {name: about.get(name) for name in file_facts(cloud)} != file_facts(cloud):
        raise InputError(
            f"{cloud}: is not the cloud that {path} was made for, or has changed; begin again with --force"
        )
    with damage(path, "begin again with --force"):
        plan = about["plan"]
        low, high, cuts = tuple(plan["low"]), tuple(plan["high"]), tuple(Split(*cut) for cut in plan["cuts"])
        plan = TilePlan(**(plan | {"low": low, "high": high, "cuts": cuts}))
    return TilesJob(cloud, out, plan, load_config(FitConfig, None, about["config"]))


def fit_tiles(
    job: TilesJob,
    *,
    jobs: int = 1,
    address: str | None = None,
    progress: Callable[[str, Progress], None] | None = None,
    report: Callable[[FitOutcome], None] | None = None,
) -> Run[TiledField]:
    """Fit all tiles of a plan, those that are fitted already left alone, and join them.

    Args:
        job: see `plan_fit`.
        jobs: tiles at a time, see `run_jobs`.
        address: of a Ray cluster, whose machines share the run directory.
        progress: called with the name of a tile and its progress, with a single job only.
        report: called after each tile.

    Raises:
        InputError: some tiles failed; the others are kept, and ``--resume`` goes on.
    """
    check_jobs(jobs, address)
    started = time.monotonic()
    parts = job.jobs(jobs)
    outcomes = run_fits(parts, jobs=jobs, address=address, progress=progress, report=report)
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    if failed:
        first = f"{failed[0].item.directory.name}: {failed[0].error}"
        raise InputError(f"{job.directory}: {len(failed)} of {len(parts)} tiles failed, tile {first}; see --resume")
    return join_tiles(job, [part.directory for part in parts], seconds=time.monotonic() - started)


def join_tiles(job: TilesJob, runs: list[Path], *, seconds: float) -> Run[TiledField]:
    """Write the joined field of fitted tiles to the run directory."""
    plan, similarity = job.plan, job.similarity
    records = [read_record(run) for run in runs]
    scales = [record["similarity"]["scale"] / similarity.scale for record in records]
    bands = [[scale * delta for delta in record["deltas"]] for record, scale in zip(records, scales, strict=True)]
    widest = [max(each) for each in itertools.zip_longest(*bands, fillvalue=0.0)]
    reach = plan.blend / similarity.scale
    places = [(cut.place - similarity.center[cut.axis]) / similarity.scale for cut in plan.cuts]
    splits = [cut._replace(place=place, half=reach) for cut, place in zip(plan.cuts, places, strict=True)]
    names = tuple(f"{RUNS}/{run.name}/{FIELD_FILE}" for run in runs)

    def joined(signs: tuple[int, ...], gap: float) -> TiledField:
        load = TileFiles(job.directory, names, similarity, signs)
        return TiledField(load, splits, deltas=widest, reach=reach, gap=gap, domain=DOMAIN)

    support = support_of_tiles(runs, similarity, 0)
    assert support is not None
    points = torch.from_numpy(support.points[:: 1 + len(support.points) // (SEAMS.points * len(runs))])
    seams = compare_tiles(joined((1,) * len(runs), 0.0), points, turn=not job.oriented)
    field = joined(seams.signs, seams.gap)
    about = {
        "finished": True,
        **named_cloud(str(job.cloud), job.directory),
        "similarity": dataclasses.asdict(similarity),
        "config": dataclasses.asdict(job.config),
        "tiles": [
            {"run": f"{RUNS}/{run.name}", "sign": sign, "rms_at_points": record["stages"][-1]["rms_at_points"]}
            for run, sign, record in zip(runs, seams.signs, records, strict=True)
        ],
        "seams": {"gap": seams.gap * similarity.scale, "typical": seams.typical * similarity.scale}
        | {"opposed": seams.opposed, "overlap": 2 * plan.blend},
        "parameters": sum(record["parameters"] for record in records),
        "peak_memory": max((record["peak_memory"] or 0 for record in records), default=0) or None,
        "training_seconds": round(seconds, 3),
        "environment": environment(torch.device("cpu")),
    }
    folder = RunFolder(job.directory)
    with folder.writing():
        record = folder.finish(field, similarity, about)
    shutil.rmtree(job.directory / POINTS, ignore_errors=True)
    return Run(field, similarity, job.directory, record)


class Seams(NamedTuple):
    """How tiles meet: a sign for each, and differences where they overlap, in the field's units.

    ``gap`` is the largest one, ``typical`` the median at the finest level, ``opposed`` the number of pairs of tiles
    whose insides still oppose each other.
    """

    signs: tuple[int, ...]
    gap: float
    typical: float
    opposed: int


@torch.no_grad()
def compare_tiles(field: TiledField, points: torch.Tensor, *, turn: bool) -> Seams:
    """Compare tiles near surface points ``(N, 3)`` where they overlap; with ``turn``, choose signs by which they agree.

    The agreement of two tiles is the sum of v_i v_k over places that both see. Signs follow the strongest agreements,
    along a spanning tree.
    """
    generator = torch.Generator().manual_seed(0)
    moved = points + SEAMS.share * field.reach * (2 * torch.rand(points.shape, generator=generator).double() - 1)
    rows, tiles = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    values = [np.empty((0, field.num_levels))]
    for number, covered, _, found in field.tile_values(moved, level=field.num_levels - 1):
        rows.append(covered.numpy())
        tiles.append(np.full(len(covered), number))
        values.append(torch.stack(found, dim=-1).numpy())
    row, tile, value = np.concatenate(rows), np.concatenate(tiles), np.concatenate(values)
    table = coo_matrix((value[:, -1], (row, tile)), (len(points), field.num_tiles)).tocsr()
    agreement = (table.T @ table).toarray()
    np.fill_diagonal(agreement, 0)
    signs = _signs(agreement) if turn else np.ones(field.num_tiles, np.int64)
    opposed = (agreement * np.outer(signs, signs) < 0).sum() // 2
    signed = value * signs[tile][:, None]
    low, high = (np.full((len(points), field.num_levels), bound) for bound in (np.inf, -np.inf))
    np.minimum.at(low, row, signed)
    np.maximum.at(high, row, signed)
    shared = np.bincount(row, minlength=len(points)) > 1
    apart = (high - low)[shared]
    gap, typical = (float(apart.max()), float(np.median(apart[:, -1]))) if len(apart) else (0.0, 0.0)
    return Seams(tuple(int(sign) for sign in signs), gap, typical, int(opposed))


def _signs(agreement: NDArray[np.float64]) -> NDArray[np.int64]:
    """Signs ``(T,)`` that follow the strongest agreements and disagreements from tile to tile; most are 1."""
    met = agreement != 0
    tree = minimum_spanning_tree(np.divide(1, np.abs(agreement), out=np.zeros_like(agreement), where=met))
    signs = np.zeros(len(agreement), np.int64)
    for start in range(len(signs)):
        if signs[start]:
            continue
        order, before = breadth_first_order(tree, start, directed=False)
        signs[start] = 1
        for tile in order[1:]:
            signs[tile] = signs[before[tile]] * (1 if agreement[before[tile], tile] > 0 else -1)
        if signs[order].sum() < 0:
            signs[order] *= -1
    return signs
