"""Scans and meshes as shapes of an evolution: each is fitted once, beside the run; poses of one mesh give landmarks."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.landmarks import write_landmarks
from ...neural_fields import Mesh, load_field
from ..fit.train import fit
from ..surface.surface import read_surface
from ..training.folder import FIELD_FILE, STATE_FILE, find_field, is_fitted, read_record
from ..training.progress import Report
from ..training.settings import EvolveConfig, FitConfig, load_config
from .shapes import FAR_OUT


def scans_among(shapes: Sequence[str]) -> dict[str, Mesh]:
    """Those of the shapes that are files of points or triangles, read; InputError if one cannot be."""
    files = [text for text in dict.fromkeys(shapes) if Path(text).is_file() and Path(text).suffix != ".safetensors"]
    return {text: read_surface(text) for text in files}


def fitted_scans(
    config: EvolveConfig, scans: Mapping[str, Mesh], folder: Path, fits: FitConfig, *, progress: Report | None = None
) -> EvolveConfig:
    """The same evolution with fits in place of ``scans``: what is in the ``folder`` already is taken, or goes on.

    Where all shapes of a deformation are meshes with the same faces, and no landmarks were given, up to 400 vertices
    become landmarks, written to files beside the fits.

    Raises:
        InputError: a cloud cannot be used.
        Interrupted: a fit was stopped by Ctrl-C; the next call resumes it.
    """
    runs = {}
    for index, text in enumerate(scans):
        runs[text] = folder / f"{index:02d}-{Path(text).stem}"
        if not _is_fit_of(runs[text], Path(text), fits):
            begun = (runs[text] / STATE_FILE).is_file() and _is_of(runs[text], Path(text), fits)
            fit(Path(text), fits, out=runs[text], resume=begun, progress=progress)
    shapes = tuple(str(runs.get(text, text)) for text in config.shapes)
    landmarks = config.landmarks or _pairs(config, scans, runs, folder)
    return dataclasses.replace(config, shapes=shapes, landmarks=landmarks)


def _is_fit_of(run: Path, scan: Path, fits: FitConfig) -> bool:
    """Whether a fit of this file with these settings lies there, newer than the file."""
    if not is_fitted(run) or not _is_of(run, scan, fits):
        return False
    return (run / FIELD_FILE).stat().st_mtime >= scan.stat().st_mtime


def _is_of(run: Path, scan: Path, fits: FitConfig) -> bool:
    record = read_record(run)
    return record.get("cloud") == str(scan.absolute()) and load_config(FitConfig, None, record["config"]) == fits


def _pairs(config: EvolveConfig, scans: Mapping[str, Mesh], runs: Mapping[str, Path], folder: Path) -> tuple[str, ...]:
    """Files of vertices that are the same, for each two shapes; none where shapes are no poses of one mesh."""
    poses = [scans.get(text) for text in config.shapes]
    first = poses[0] if poses else None
    if config.kind != "deform" or len(poses) < 2 or first is None or not len(first.faces):
        return ()
    if not all(pose is not None and np.array_equal(pose.faces, first.faces) for pose in poses):
        return ()
    # 400 vertices are landmarks; more say nothing new of a smooth motion.
    chosen = np.sort(np.random.default_rng(0).permutation(np.unique(first.faces))[:400])
    near = np.ones(len(chosen), bool)
    for text, pose in zip(config.shapes, poses, strict=True):
        if pose is not None:
            near &= _on_fit(runs[text], pose.vertices[chosen])
    if not near.any():
        return ()
    files = []
    for index, (before, after) in enumerate(itertools.pairwise(pose for pose in poses if pose is not None)):
        files.append(folder / f"pairs-{index:02d}.txt")
        write_landmarks(files[-1], *(pose.vertices[chosen[near]] for pose in (before, after)))
    return tuple(map(str, files))


@torch.no_grad()
def _on_fit(run: Path, vertices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which vertices the fit has kept: a thin part may be lost."""
    field, similarity, _ = load_field(find_field(run))
    points = torch.from_numpy(similarity.to_unit(vertices)).float()
    return (field.value(points).abs() < FAR_OUT).numpy()
