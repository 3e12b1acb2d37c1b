"""``mplicits bench evolve --meshes A B``: a morph between the fits of two meshes, measured against the meshes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..neural_fields import InputError, extract_mesh, load_field
from .evolve.shapes import Placed, Placement
from .evolve.train import evolve
from .fit.train import fit
from .run.folder import FIELD_FILE, STATE_FILE
from .run.machine import format_table
from .run.settings import EvolveConfig, FitConfig
from .run.trainer import Progress
from .surface.measure import evaluate_surfaces
from .surface.surface import from_mesh, read_reference

__all__ = ["MorphRow", "bench_morph", "format_morph"]


@dataclass(frozen=True)
class MorphRow:
    """A morph between two meshes.

    Attributes:
        shapes: names of the files.
        seconds: training of the morph, without the fits.
        fits: Chamfer distance of each static fit to its mesh, squared and both ways, in units of its bounding sphere.
        ends: the same of the morph at its ends.
        floors: what a perfect mesh would score.
        volumes: at each time.
        components: at each time.
        times: those times.
        warnings: as in ``run.json``.
    """

    shapes: tuple[str, str]
    seconds: float
    fits: tuple[float, float]
    ends: tuple[float, float]
    floors: tuple[float, float]
    volumes: tuple[float, ...]
    components: tuple[int, ...]
    times: tuple[float, ...]
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return dataclasses.asdict(self)


def bench_morph(
    first: str | Path,
    second: str | Path,
    config: EvolveConfig,
    *,
    directory: Path,
    fit_config: FitConfig | None = None,
    resolution: int = 256,
    samples: int = 500_000,
    progress: Callable[[str, Progress], None] | None = None,
) -> MorphRow:
    """Fit two meshes, morph between the fits, and measure both ends against the meshes.

    Args:
        first: mesh file.
        second: mesh file.
        config: how the morph is trained and aligned.
        directory: keeps the fits and the morph; fits that are there are used, and continued if interrupted.
        fit_config: of the fits.
        resolution: of the meshes that are measured.
        samples: points drawn on each surface.
        progress: called with what is being trained and its progress.

    Raises:
        InputError: a file cannot be read, holds no faces to compare with, or both have one name.
    """
    paths = [Path(first), Path(second)]
    if len({"morph", *(path.stem for path in paths)}) < 3:
        raise InputError(f"--meshes {first} {second}: their names are those of their runs; rename one")
    references = [read_reference(path) for path in paths]
    runs = [directory / path.stem for path in paths]
    for path, run in zip(paths, runs, strict=True):
        interrupted = (run / STATE_FILE).is_file()
        if not (run / FIELD_FILE).is_file() or interrupted:
            tell = None if progress is None else _named(progress, path.stem)
            fit(path, fit_config, out=run, resume=interrupted, progress=tell)
    own = dataclasses.replace(config, kind="morph", shapes=tuple(map(str, runs)), times=())
    tell = None if progress is None else _named(progress, "morph")
    run = evolve(own, out=directory / "morph", progress=tell)
    fits, ends, floors = [], [], []
    for time, (path, reference) in enumerate(zip(runs, references, strict=True)):
        field, similarity, _ = load_field(path / FIELD_FILE)
        moved = reference.moved(similarity)
        back = Placement.from_dict(run.record["placements"][time]).inverse()
        for found, into in ((field, fits), (Placed(run.field.at(float(time)), back), ends)):
            mesh = from_mesh(extract_mesh(found, resolution=resolution))
            metrics = evaluate_surfaces(mesh, moved, samples=samples, columns=16)  # the volumes are not asked for
            into.append(metrics.chamfer)
            floor = metrics.chamfer_floor
        floors.append(floor)
    frames = run.record["checks"]["frames"]
    return MorphRow(
        (paths[0].stem, paths[1].stem),
        run.record["training_seconds"],
        (fits[0], fits[1]),
        (ends[0], ends[1]),
        (floors[0], floors[1]),
        tuple(frame["volume"] for frame in frames),
        tuple(frame["components"] for frame in frames),
        tuple(frame["time"] for frame in frames),
        tuple(run.record["checks"]["warnings"]),
    )


def format_morph(row: MorphRow) -> str:
    """The table that the command prints, and the curves below it."""
    header = ("morph", "Chamfer", "of the fit", "floor", "ratio")
    cells = [
        (f"{name} at t = {time}", f"{end:.2e}", f"{fitted:.2e}", f"{floor:.2e}", f"{end / fitted:.2f}")
        for time, (name, end, fitted, floor) in enumerate(zip(row.shapes, row.ends, row.fits, row.floors, strict=True))
    ]
    curve = [
        (f"{time:.2f}", f"{volume:.3f}", str(count))
        for time, volume, count in zip(row.times, row.volumes, row.components, strict=True)
    ]
    lines = [format_table(header, cells), f"trained in {row.seconds:.0f} s; the aim is a ratio below 1.5", ""]
    lines.append(format_table(("t", "volume", "components"), curve))
    return "\n".join([*lines, *(f"warning: {warning}" for warning in row.warnings)])


def _named(progress: Callable[[str, Progress], None], name: str) -> Callable[[Progress], None]:
    return lambda report: progress(name, report)
