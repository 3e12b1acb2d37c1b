"""Benchmark ``signs``: how many estimated normals of a cloud come out on the wrong side."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from mplicits.datasets import OrientedCloud, PointCloud
from mplicits.neural_fields import InputError
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.train import prepare
from mplicits.pipelines.fit.unoriented import Places, fits_better, give_signs
from mplicits.pipelines.surface.surface import read_reference
from mplicits.pipelines.training.settings import FitConfig
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .fits import clouds_of

NEAREST = 64  # of the noisy points, among which a smoothed one is looked for


@dataclass(frozen=True)
class SignsRow:
    """One cloud.

    Attributes:
        shape: name of the file.
        noise: half-width of the uniform displacement, as a fraction of the bounding box's diagonal.
        isotropic: whether the noise has no direction; see `FitRow`.
        points: that were left of the cloud.
        oriented_by: what gave the normals their signs; see `CleaningReport`.
        before: share of the normals that point inward, as the cloud was prepared.
        after: the same once a network that was not told of signs has given them.
        asked: whether a fit would have asked for that by itself.
        fits: whether it would then have taken them: neighbours or winding numbers fit better with them.
        seconds: of the preparation.
        more_seconds: of the network.
    """

    shape: str
    noise: float
    isotropic: bool
    points: int
    oriented_by: str
    before: float
    after: float
    asked: bool
    fits: bool
    seconds: float
    more_seconds: float


@dataclass(frozen=True, kw_only=True)
class SignsBench(Benchmark[SignsRow]):
    """Signs of normals estimated from the vertices of meshes, or from points drawn on them.

    A normal is wrong where it points against the exact one of the point that the noise has moved, though it may now be
    nearer to the other side of a thin part.

    Attributes:
        shapes: mesh files.
        config: settings of a fit, whose clouds are prepared so.
        noise: see `SignsRow`.
        isotropic: see `SignsRow`.
        points: how many are drawn on each mesh; None takes its vertices.
    """

    name = "signs"
    source = "the signs of estimated normals"
    row = SignsRow
    apart = ("shapes",)
    shapes: Sequence[str | Path]
    config: FitConfig
    noise: float = 0.0
    isotropic: bool = False
    points: int | None = None

    def jobs(self) -> list[Part]:
        """One for each shape; see `Benchmark.jobs`."""
        for shape in self.shapes:
            read_reference(shape)
        return [Part(self.name, Path(shape).stem, (Path(shape),)) for shape in self.shapes]

    def measure(self, job: Part, context: Context) -> list[SignsRow]:
        """See `Benchmark.measure`."""
        (path,), seed = job.files, self.config.seed
        about = {"points": self.points, "noise": self.noise, "isotropic": self.isotropic, "seed": seed}
        clean, noisy = clouds_of(path, **about)
        if clean.normals is None:
            raise InputError(f"{path}: a cloud without normals; expected a mesh, whose sides are known")
        config = dataclasses.replace(self.config, normals="estimate")
        started = time.perf_counter()
        cloud = prepare(noisy, config)
        seconds = time.perf_counter() - started
        exact = _exact_normals(clean, noisy, cloud, config)
        started = time.perf_counter()
        points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
        places = Places.around(CloudDistance(points, normals), seed=seed)
        device = choose_device(self.device)
        signs = give_signs(points, normals, config, device=device, places=places, report=context.stage(path.stem))
        assert signs is not None  # it gets no stop flag
        against = (cloud.normals * exact).sum(axis=1) < 0
        return [
            SignsRow(
                shape=path.stem,
                noise=self.noise,
                isotropic=self.isotropic,
                points=len(cloud),
                oriented_by=cloud.report.oriented_by or "file",
                before=float(against.mean()),
                after=float((against != signs.turned).mean()),
                asked=places.contested,
                fits=fits_better(cloud, signs),
                seconds=seconds,
                more_seconds=time.perf_counter() - started,
            )
        ]

    def tables(self, rows: Sequence[SignsRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[SignsRow]] = [
            (Column("points", ",d"), lambda row: row.points),
            (Column("oriented by", "s"), lambda row: row.oriented_by),
            (Column("wrong, %", ".2f"), lambda row: 100 * row.before),
            (Column("after the network, %", ".2f"), lambda row: 100 * row.after),
            (Column("asked by itself", "s"), lambda row: "yes" if row.asked else "no"),
            (Column("fits better", "s"), lambda row: "yes" if row.fits else "no"),
            (Column("preparation, s", ".1f"), lambda row: row.seconds),
            (Column("network, s", ".1f"), lambda row: row.more_seconds),
        ]
        kinds = {False: "noise", True: "isotropic noise"}
        items = [(f"{row.shape}{f' + {kinds[row.isotropic]} {row.noise:g}' if row.noise else ''}", row) for row in rows]
        return (tabulated(self.name, "Normals on the wrong side", "shape", figures, items),)


def _exact_normals(
    clean: PointCloud, noisy: PointCloud, cloud: OrientedCloud, config: FitConfig
) -> NDArray[np.float32]:
    """The exact normal of each point that is left of a noisy cloud, ``(N, 3)``.

    Smoothing has moved the points, and dropped k of them; the others keep their order, so that the i-th that is left
    was one of those from the i-th to the (i + k)-th: of these it is the one that is nearest.
    """
    still = cloud if not cloud.noise else prepare(noisy, dataclasses.replace(config, smooth_noise=False))
    assert clean.normals is not None
    unit = cloud.similarity.to_unit(noisy.points)
    exact = clean.normals[np.asarray(KDTree(unit).query(still.points)[1])]
    dropped = len(still) - len(cloud)
    if not dropped:
        return exact
    near = np.asarray(KDTree(still.points).query(cloud.points, k=min(NEAREST, len(still)))[1])
    skipped = near - np.arange(len(cloud))[:, None]
    possible = (skipped >= 0) & (skipped <= dropped)
    return exact[near[np.arange(len(near)), possible.argmax(axis=1)]]
