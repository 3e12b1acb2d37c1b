"""Many clouds with the same settings: a run for each, side by side where Ray is installed."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ...datasets.clouds.readers.reading import check_cloud_path
from ...neural_fields import InputError
from ...neural_fields.backend.files import damage, write_json
from ..training.folder import STATE_FILE, check_new_run, is_fitted, read_record
from ..training.jobs import Outcome, check_jobs, run_jobs
from ..training.progress import format_table
from ..training.settings import FitConfig, load_config
from ..training.trainer import Progress, Report
from .cloud import Surroundings
from .train import fit_file

SETTINGS_FILE = "fits.json"  # in the directory of all runs: the settings of those yet to begin

FitOutcome = Outcome["FitJob", dict[str, Any]]


@dataclass(frozen=True)
class FitJob:
    """One of the fits: a cloud, what lies around it, its run directory; a resumed run has its own settings."""

    cloud: Path
    directory: Path
    config: FitConfig
    resume: bool = False
    around: Surroundings | None = None


def plan_fits(
    clouds: Sequence[str | Path], out: Path, config: FitConfig | None, *, resume: bool = False, force: bool = False
) -> list[FitJob]:
    """Check everything before any work, and give every cloud its run directory ``out/<stem>``.

    ``resume`` continues interrupted runs, begins missing ones and skips finished ones, with the settings kept in
    ``out``. An `InputError` names a missing or unknown file, two clouds of one name, an existing run, or nothing to
    resume.
    """
    paths = [check_cloud_path(cloud) for cloud in clouds]
    twice = [stem for stem, count in Counter(path.stem for path in paths).items() if count > 1]
    if twice:
        both = " and ".join(str(path) for path in paths if path.stem == twice[0])
        raise InputError(f"{both}: would both be fitted into {out / twice[0]}; rename one")
    check_new_run(out, resume=False, force=True)  # it may hold other runs
    if resume:
        config = load_config(FitConfig, None, read_kept(out / SETTINGS_FILE)["config"])
    assert config is not None
    if out.is_dir():
        for path in paths:
            check_new_run(out / path.stem, resume=False, force=force or resume)
    return [FitJob(path, out / path.stem, config, resume) for path in paths]


def fit_many(
    planned: Sequence[FitJob],
    out: Path,
    *,
    jobs: int = 1,
    progress: Callable[[str, Progress], None] | None = None,
    report: Callable[[FitOutcome], None] | None = None,
) -> list[FitOutcome]:
    """Fit all clouds, also after one has failed → the record of each run, or the reason of its failure.

    ``jobs`` run at a time, see `run_jobs`; ``progress`` is called with a single job only, ``report`` after each fit.
    """
    check_jobs(jobs)
    out.mkdir(parents=True, exist_ok=True)
    if planned:
        write_json(out / SETTINGS_FILE, {"config": dataclasses.asdict(planned[0].config)})
    return run_fits(planned, jobs=jobs, progress=progress, report=report)


def run_fits(
    planned: Sequence[FitJob],
    *,
    jobs: int,
    address: str | None = None,
    progress: Callable[[str, Progress], None] | None = None,
    report: Callable[[FitOutcome], None] | None = None,
) -> list[FitOutcome]:
    """See `fit_many`, and `run_jobs` for the ``address``; fits whose worker dies go on, twice at most."""
    if jobs > 1 or address is not None or progress is None:
        return run_jobs(_fit, planned, jobs=jobs, address=address, retries=2, report=report)
    return run_jobs(lambda job: _fit(job, partial(progress, job.cloud.stem)), planned, report=report)


def format_fits(outcomes: Sequence[FitOutcome]) -> str:
    """A table, one line per cloud."""
    rows = []
    for outcome in outcomes:
        name, record = outcome.item.cloud.stem, outcome.value
        if record is None:
            rows.append((name, "", "", "", f"failed: {outcome.error}"))
            continue
        rms = record["stages"][-1]["rms_at_points"]
        kept = f"{record['cleaning']['kept']:,}"
        rows.append((name, kept, f"{rms:.3g}", f"{record['training_seconds']:.1f} s", str(outcome.item.directory)))
    return format_table(("cloud", "points", "rms at points", "time", "run"), rows)


def _fit(job: FitJob, progress: Report | None = None) -> dict[str, Any]:
    """Fit one cloud, or resume it → its record."""
    if job.resume and is_fitted(job.directory):
        return read_record(job.directory)
    resume = job.resume and (job.directory / STATE_FILE).is_file()
    about = {"resume": resume, "around": job.around, "progress": progress}
    return fit_file(job.cloud, job.config, out=job.directory, **about).record


def read_kept(path: Path) -> dict[str, Any]:
    """The JSON of a file that tells how to resume; InputError if there is none, or it is damaged."""
    if not path.is_file():
        raise InputError(f"{path}: no such file, so there is nothing to resume; leave out --resume")
    with damage(path, "begin again without --resume"):
        kept = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(kept["config"], dict):
            raise TypeError("config is not a mapping")
        return kept
