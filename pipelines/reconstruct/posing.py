"""Cameras and sparse points of photographs, with progress: `find_cameras` and `find_points` as stages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from ...datasets.views.colmap_process import FEATURES, MATCHING
from ...datasets.views.colmap_process import Report as ColmapReport
from ...datasets.views.find_cameras import PLACING, FoundCameras, find_cameras
from ...datasets.views.find_points import NEAREST, TRIANGULATING, FoundPoints, find_points
from ...datasets.views.reading import find_source, read_shots
from ...datasets.views.shots import list_images
from ..run.schedule import Progress, Report, Schedule, Stage

__all__ = ["find_cameras_timed", "find_points_timed", "said_of", "said_of_points"]

# Seconds of a core for the features of a photograph and for matching two, and of the whole for placing one, or for its
# points where its place is known.
FEATURE_SECONDS, PAIR_SECONDS, PLACE_SECONDS, POINTS_SECONDS = 1.5, 0.05, 0.5, 0.1
FEW_POINTS = 100


def find_cameras_timed(
    source: str | Path,
    project: str | Path,
    *,
    frames: int = 100,
    lens: Literal["auto", "one", "each"] = "auto",
    progress: Report | None = None,
    then: Sequence[Stage] = (),
) -> FoundCameras:
    """`find_cameras`, that says how far it is and how long it will take.

    Args:
        source: see `find_cameras`.
        project: the same.
        frames: the same.
        lens: the same.
        progress: told of every stage.
        then: what will be done after it.
    """
    source, schedule = Path(source), Schedule.of(progress)
    count, cores = len(list_images(source)) or frames, os.cpu_count() or 1
    schedule.plan(
        [
            Stage(FEATURES, "features", FEATURE_SECONDS * count / cores),
            Stage(MATCHING, "matching", PAIR_SECONDS * count * (count - 1) / 2 / cores),
            Stage(PLACING, "placing", PLACE_SECONDS * count),
            *then,
        ]
    )

    return find_cameras(source, project, frames=frames, lens=lens, report=_to(schedule))


def find_points_timed(source: str | Path, project: str | Path, *, progress: Report | None = None) -> FoundPoints:
    """`find_points`, that says how far it is and how long it will take.

    Args:
        source: see `find_points`.
        project: the same.
        progress: told of every stage.
    """
    schedule = Schedule.of(progress)
    count, cores = len(read_shots(find_source(source))), os.cpu_count() or 1
    schedule.plan(
        [
            Stage(FEATURES, "features", FEATURE_SECONDS * count / cores),
            Stage(MATCHING, "matching", PAIR_SECONDS * count * min(NEAREST, count - 1) / cores),
            Stage(TRIANGULATING, "placing", POINTS_SECONDS * count),
        ]
    )

    return find_points(source, project, report=_to(schedule))


def _to(schedule: Schedule) -> ColmapReport:
    """What tells a schedule how far COLMAP is."""

    def report(stage: str, done: int, total: int) -> None:
        schedule(Progress(stage, done, total, done / max(total, 1), {}))

    return report


def said_of_points(found: FoundPoints) -> tuple[str, list[str]]:
    """What was found, in a line, and what is to be warned of."""
    line = (
        f"{found.project}: {found.points:,} points that {found.photographs} photographs show, seen {found.error:.2f} "
        "pixels off"
    )
    return line, _few(found.points)


def _few(points: int) -> list[str]:
    """What is to be warned of, if so many points are few."""
    warning = f"{points} points are few: cameras may be wrong; see `mplicits check-cameras`"
    return [warning] if points < FEW_POINTS else []


def said_of(found: FoundCameras) -> tuple[str, list[str]]:
    """What was found, in a line, and what is to be warned of."""
    placed = found.photographs - len(found.left_out)
    line = (
        f"{found.project}: {placed} of {found.photographs} photographs placed by {found.points:,} points that are seen "
        f"{found.error:.2f} pixels off"
    )
    warnings = []
    if found.left_out:
        names = ", ".join(found.left_out[:3]) + (", …" if len(found.left_out) > 3 else "")
        warnings.append(f"not placed: {names}; too little in them is in others too, or they are blurred")
    return line, warnings + _few(found.points)
