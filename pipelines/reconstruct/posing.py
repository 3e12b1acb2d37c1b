"""Cameras and sparse points of photographs: COLMAP's progress, and what is printed of the result."""

from __future__ import annotations

from ...datasets.views.poses.colmap_process import Report as ColmapReport
from ...datasets.views.poses.find_cameras import FoundCameras
from ...datasets.views.poses.find_points import FoundPoints
from ..training.report import Progress, Report, silent


def colmap_report(report: Report | None) -> ColmapReport:
    """A receiver of COLMAP's progress that passes it on to ``report``."""

    def passed_on(stage: str, done: int, total: int) -> None:
        (report or silent)(Progress(stage, done, total, done / max(total, 1), {}))

    return passed_on


def said_of(found: FoundCameras | FoundPoints) -> tuple[str, list[str]]:
    """What was found, in a line, and what is to be warned of."""
    seen, warnings = f"seen {found.error:.2f} pixels off", []
    if isinstance(found, FoundCameras):
        placed = found.photographs - len(found.left_out)
        line = f"{placed} of {found.photographs} photographs placed by {found.points:,} points that are {seen}"
        if found.left_out:
            names = ", ".join(found.left_out[:3]) + (", …" if len(found.left_out) > 3 else "")
            warnings.append(f"not placed: {names}; too little in them is in others too, or they are blurred")
    else:
        line = f"{found.points:,} points that {found.photographs} photographs show, {seen}"
    if found.points < 100:
        warnings.append(f"{found.points} points are few: cameras may be wrong; see `mplicits check-cameras`")
    return f"{found.project}: {line}", warnings
