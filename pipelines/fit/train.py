"""``fit``: from an oriented point cloud to a multiscale SDF, level by level (paper Sec. 3.2)."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ...datasets import OrientedCloud, PointCloud, prepare_cloud, spacing_of
from ...datasets.clouds.cleaning.winding import DipoleField
from ...neural_fields import Field, InputError, MultiscaleSDF, Similarity, Siren
from ...neural_fields.backend.devices import choose_device, peak_memory
from ..surface.surface import thinned
from ..training.folder import SUPPORT_FILE, RunFolder, digest_of, named_cloud
from ..training.progress import reported, silent
from ..training.result import Run
from ..training.scaffold import BUDGET, Budget, Training, affordable, least_share
from ..training.settings import FitConfig
from ..training.trainer import (
    Interrupted,
    Report,
    StopFlag,
    Trainer,
    load_compiler,
    parameter_count,
    restore_frozen,
    stop_on_signals,
)
from .cloud import CloudDistance, Surroundings, load_cloud
from .densification import dense_distance
from .level import JUDGE, LEVEL, Judge, LevelObjective, calm_omega, held_out, new_level, noisy_points
from .review import review_points
from .samples import (
    DOMAIN,
    SQUARES,
    Band,
    RobustScales,
    Source,
    band_of,
    banded_sources,
    first_sources,
    with_wrong_sides,
)
from .unoriented import Places, Signs, fits_better, give_signs, signed

GUESSED = ("winding", "propagation")  # orientations of estimated normals that may be wrong in whole patches

Cloud = PointCloud | str | Path | NDArray[np.floating]
LevelDone = Callable[[MultiscaleSDF, Similarity], object]


def fit(
    cloud: Cloud,
    config: FitConfig | None = None,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
    level_done: LevelDone | None = None,
) -> Run[MultiscaleSDF]:
    """Fit a multiscale SDF to a point cloud.

    Args:
        cloud: a file, a `PointCloud`, or an array ``(N, 3)`` or ``(N, 6)`` of points (and normals).
        config: settings; the defaults are those of the ``default`` preset.
        out: run directory for the field, the checkpoints and ``run.json``; None writes nothing. An older run there is
            replaced only after the cloud has been read and checked.
        resume: continue the interrupted run in ``out`` with its own settings; ``config`` is then ignored.
        progress: called repeatedly with the progress of the training.
        level_done: called after each level with the field so far and the similarity from input coordinates.

    Raises:
        InputError: the cloud cannot be read or used, or there is nothing to resume.
        Interrupted: Ctrl-C or SIGTERM; ``out`` then holds a checkpoint and a usable field.

    Example:
        >>> run = fit("scan.ply")  # doctest: +SKIP
        >>> run.world.distance(points)  # of the scan, in its coordinates and units  # doctest: +SKIP
    """
    return _fit(RunFolder(out, resume=resume), cloud, config, progress=progress, level_done=level_done)


def fit_file(
    file: Path,
    config: FitConfig,
    *,
    out: Path,
    resume: bool = False,
    keep: str | None = None,
    around: Surroundings | None = None,
    progress: Report | None = None,
) -> Run[MultiscaleSDF]:
    """`fit` a cloud file that was made for the run, which may ``keep`` a copy of it by that name.

    What lies ``around`` it, if it is a part of a cloud, decides with it where inside is.
    """
    folder = RunFolder(out, resume=resume)
    if keep is not None:
        folder.keep(keep, file.read_bytes())
    source = None if keep is None else str(out / keep)
    return _fit(folder, file, config, source=source, around=around, progress=progress)


def _fit(
    folder: RunFolder,
    cloud: Cloud,
    config: FitConfig | None,
    *,
    source: str | None = None,
    around: Surroundings | None = None,
    progress: Report | None = None,
    level_done: LevelDone | None = None,
) -> Run[MultiscaleSDF]:
    config = folder.config(FitConfig, config)
    choose_device(config.device)  # a missing device is reported before a large cloud is read
    budget, report = Budget(config.time_budget), progress or silent
    points = _as_cloud(cloud)
    with reported(report, "reading the cloud"):
        raw, merging = load_cloud(
            points,
            limit=config.merge_above,
            isolation=config.isolation,
            cache=folder.path,
            columns=config.columns,
            drop_noise=config.drop_noise,
        )
    with reported(report, "preparing the cloud"):
        prepared = prepare(raw, config)
    load_compiler()
    origin = {"reading": raw.reading, "merging": None if merging is None else dataclasses.asdict(merging)}
    fitting = _Fitting(prepared, source or raw.source, origin, config, folder, budget, report, level_done)
    fitting.beyond = None if around is None else around.dipoles(prepared.similarity)
    with folder.writing(), stop_on_signals() as flag:
        if folder.resume:
            fitting.restore()
        return fitting.run(flag)


def prepare(cloud: PointCloud, config: FitConfig) -> OrientedCloud:
    """`prepare_cloud` with the settings of a fit."""
    given = config.normals
    return prepare_cloud(
        cloud,
        normals="estimate" if given == "none" else given,
        sensor_origin=config.sensor_origin,
        isolation=config.isolation,
        drop_outliers=config.drop_outliers,
        turn_normals=config.turn_normals,
        smooth_noise=config.smooth_noise and given != "none",  # without normals: after `give_signs`
        noisy=noisy_points(len(cloud), config.hold_out),
    )


def _as_cloud(cloud: Cloud) -> PointCloud | str | Path:
    if isinstance(cloud, PointCloud | str | Path):
        return cloud
    array = np.asarray(cloud)
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        raise InputError(f"cloud: array of shape {array.shape}; expected (N, 3) points or (N, 6) points and normals")
    normals = array[:, 3:].astype(np.float32) if array.shape[1] == 6 else None
    return PointCloud(points=array[:, :3].astype(np.float64), normals=normals, source="array")


class _Fitting(Training[FitConfig, MultiscaleSDF]):
    """One fit under way; ``origin`` is the part of the record on how the file was read and merged."""

    def __init__(
        self,
        cloud: OrientedCloud,
        source: str,
        origin: dict[str, Any],
        config: FitConfig,
        folder: RunFolder,
        budget: Budget,
        report: Report,
        level_done: LevelDone | None,
    ) -> None:
        super().__init__(config, folder, budget, report)
        self.cloud, self.source, self.level_done = cloud, source, level_done
        self.origin = {**named_cloud(source, folder.path), **origin}
        self.preparation_seconds = time.monotonic() - budget.started
        self.similarity = cloud.similarity
        self.fingerprint = digest_of((cloud.points, cloud.normals))
        self.points, self.normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
        self.index: CloudDistance | None = None  # of the points that the level learns from
        self.held = torch.zeros(len(self.points), dtype=torch.bool)  # points held out of residual levels
        self.beyond: DipoleField | None = None  # of the surface around the points
        self.signs: Signs | None = None  # given to the points without normals
        self.spacing = 0.0  # of all points
        self.errors = torch.empty(0)  # of the last frozen level, at all points
        # Samples of each kind, and points of the index: less than configured under a short time budget.
        self.samples = self.filling = config.samples

    def run(self, flag: StopFlag) -> Run[MultiscaleSDF]:
        """Train all levels that there is time for."""
        if not self.stages and not self.trainer_state:
            self.find_signs(flag)
        self.keep_support()
        levels = self.config.num_levels
        for level in range(len(self.stages), levels):
            if level > 1 and self.omega(level) <= self.stages[-1]["omega"] < self.config.omegas[level]:
                self.budget.leave_out(level, levels, "noise allows no higher frequency than that of the level before")
                break
            left, training = self.budget.left(), 1 - BUDGET.sampling_share
            share = self.share(level, self.config.steps[:levels], left, training=training)
            if share is None:
                self.budget.leave_out(level, levels)
                break
            self.train_level(level, share, flag)
        self.settle()
        assert self.frozen is not None
        record = self.folder.finish(self.frozen, self.similarity, self.record(finished=True))
        return Run(self.frozen.cpu(), self.similarity, self.folder.out, record)

    def find_signs(self, flag: StopFlag) -> None:
        """Orient normals of unknown or doubtful sign with `give_signs`."""
        if self.config.normals != "none" and self.cloud.report.oriented_by not in GUESSED:
            return
        unsigned = self.config.normals == "none"
        places = Places.around(CloudDistance(self.points, self.normals), seed=self.config.seed)
        if not unsigned and not places.contested:
            return
        about = {"device": self.device, "places": places, "flag": flag, "report": self.report}
        signs = give_signs(self.points, self.normals, self.config, **about)
        if signs is None:
            self.save(self.grown(new_level(self.config, 0, residual=False), None), None)
            raise Interrupted(self.folder.out)
        if unsigned or fits_better(self.cloud, signs):
            self.take_signs(signs)

    def take_signs(self, signs: Signs) -> None:
        """Turn the normals; of a cloud without normals, smooth the noise along them."""
        self.signs = signs
        self.cloud = signed(self.cloud, signs, smooth=self.config.normals == "none" and self.config.smooth_noise)
        self.points, self.normals = torch.from_numpy(self.cloud.points), torch.from_numpy(self.cloud.normals)

    def keep_support(self) -> None:
        """Write the fitted points to the run directory."""
        if self.folder.out is not None:
            self.folder.keep_tensors(SUPPORT_FILE, thinned(self.points.numpy()))

    def timed_step(self, level: int) -> Callable[[], Tensor]:
        """See `Training.timed_step`."""
        siren = new_level(self.config, level, residual=False).to(self.device)
        points = torch.rand(self.config.batch, 3, generator=torch.Generator().manual_seed(0))
        points = ((2 * points - 1) * DOMAIN).to(self.device)

        def step() -> Tensor:
            jet = siren.jet(points)
            return jet.value.square().mean() + jet.gradient.square().mean()

        return step

    def omega(self, level: int) -> float:
        """The frequency of a level, see `calm_omega`."""
        return calm_omega(self.config, level, self.cloud.noise if self.cloud.estimated else 0.0)

    def indexed(self, level: int) -> CloudDistance:
        """`distances` of a level, made once."""
        self.index = self.index or self.distances(level)
        return self.index

    def train_level(self, level: int, share: float, flag: StopFlag) -> None:
        """Make the samples of a level, train and freeze it, in ``share`` seconds (``inf``: no limit)."""
        started = time.monotonic()
        with reported(self.report, f"level {level}: samples"):
            if share < math.inf and level == 0 and not self.trainer_state:
                self.filling = self.affordable_filling(share)
            generator = torch.Generator().manual_seed(self.config.seed * 1009 + level)
            band = None if self.frozen is None else self.next_band()
            delta = None if band is None else band.delta
            index = self.indexed(level)
            if not self.trainer_state:
                self.samples = self.affordable_samples(level, share, started, index, delta)
            config = dataclasses.replace(self.config, samples=self.samples)
            siren = new_level(config, level, residual=level > 0, omega=self.omega(level)).to(self.device)
            sources = self.sources(index, delta, config, generator)
            weights = {"data": sources[0].data, "normal": sources[0].normal, "scales": sources[0].scales}
            judge = None if self.frozen is None or delta is None else self.judge(delta, self.frozen, **weights)
        sampling_seconds = time.monotonic() - started
        seconds = None if share == math.inf else self.training_seconds(level, share - sampling_seconds)
        rate, turn = config.learning_rates[level], config.turn
        objective = LevelObjective(siren, sources, learning_rate=rate, turn=turn, generator=generator, judge=judge)
        trainer = Trainer(objective, stage=f"level {level}", steps=config.steps[level], seconds=seconds)
        if not self.take_steps(trainer, flag, lambda: self.grown(siren, delta)):
            raise Interrupted(self.folder.out)
        verdict = objective.take_best()
        self.frozen = self.grown(siren, delta).requires_grad_(False)
        review = self.review() if level == 0 else None
        if level == 0 and config.hold_out:
            self.index = None  # residual levels hold points out
        before, self.errors = self.errors, self.values_at_cloud()
        silenced = level > 0 and _rms(self.errors) > LEVEL.worse * _rms(before)
        on_trial = False
        if verdict is not None:
            seen = ~self.held
            learnt = _rms(self.errors[seen]) / max(_rms(before[seen]), 1e-30)
            verdict = verdict._replace(learnt=learnt)
            on_trial = verdict.unsettled and level + 1 < self.config.num_levels and self.trial is None
            silenced |= not (verdict.better or on_trial)
        if silenced:
            _silence(siren)
            self.errors = before
        self.stages.append(
            {
                "level": level,
                "parameters": parameter_count(siren),
                "omega": siren.omega,
                "delta": delta,
                "band": None if band is None else dataclasses.asdict(band),
                "between": len(index.points) - index.given,
                "repaired_normals": index.repaired,
                "samples": {source.name: len(source.samples) for source in sources},
                "sampling_seconds": round(sampling_seconds, 3),
                "training_seconds": round(trainer.elapsed, 3),
                "steps": trainer.step,
                "ended_by_time_budget": trainer.ended_early,
                "silenced": silenced,
                "on_trial": on_trial and not silenced,
                "held_out": None if verdict is None else verdict.record(level, scale=self.similarity.scale),
                "losses": trainer.losses,
                **({} if review is None else {"review": review}),
                **self.surface_errors(),
            }
        )
        if not on_trial:
            self.settle()
        self.save(self.frozen, None)
        if self.level_done is not None:
            self.level_done(self.frozen, self.similarity)

    @property
    def trial(self) -> dict[str, Any] | None:
        """The stage of the level that waits for the next one to decide whether both are kept."""
        return next((stage for stage in self.stages if stage.get("on_trial")), None)

    def settle(self) -> None:
        """Keep the level on trial if it is better than none with the levels after it, else set them to zero."""
        stage = self.trial
        if stage is None or self.frozen is None:
            return
        number, levels = stage["level"], self.frozen.levels
        judge = self.judge(stage["delta"], self.frozen.first_levels(number))
        assert judge is not None  # there was one when the trial began
        verdict = judge.verdict(judge.errors_of(self.frozen), 1.0)._replace(until=self.frozen.num_levels - 1)
        stage.update(on_trial=False, silenced=not verdict.better)
        stage["held_out"] = verdict.record(number, scale=self.similarity.scale)
        if not verdict.better:
            for later, siren in zip(self.stages[number:], levels[number:], strict=True):
                later["silenced"] = True
                _silence(siren)
            self.errors = self.values_at_cloud()
            self.stages[-1].update(self.surface_errors())

    def sources(
        self, index: CloudDistance, delta: float | None, config: FitConfig, generator: torch.Generator
    ) -> list[Source]:
        """Samples of the next level; of a residual level, in the band of half-width ``delta``."""
        if self.frozen is None or delta is None:
            return first_sources(index, config, generator=generator, device=self.device)
        return banded_sources(index, self.frozen, delta, config, generator=generator, name=self.source)

    def affordable_count(self, index: CloudDistance, delta: float | None, seconds: float) -> int:
        """How many samples of each kind can be made in ``seconds``, see `affordable`."""
        generator = torch.Generator().manual_seed(0)

        def make(count: int) -> list[Source]:
            return self.sources(index, delta, dataclasses.replace(self.config, samples=count), generator)

        return affordable(make, self.config.samples, seconds)

    def affordable_filling(self, share: float) -> int:
        """Points of the index that fit into the ``share`` seconds of level 0."""
        full = self.config.samples
        if not self.config.between or full <= len(self.points):
            return full
        index = CloudDistance(self.points, self.normals)
        return self.affordable_count(index, None, BUDGET.sampling_share / 2 * share)

    def affordable_samples(
        self, level: int, share: float, started: float, index: CloudDistance, delta: float | None
    ) -> int:
        """Samples of each kind that fit into the ``share`` seconds of a level, which began at ``started``."""
        full = self.config.samples
        if share == math.inf:
            return full
        spare = share - self.config.steps[level] * self.cost(level)
        left = max(BUDGET.sampling_share * share, spare) - (time.monotonic() - started)
        count = self.affordable_count(index, delta, left)
        if count < full:
            note = f"level {level} learns from {count:,} samples of each kind instead of {full:,}"
            self.budget.notes.append(note)
        return count

    def training_seconds(self, level: int, left: float) -> float:
        """Seconds for the steps of a level: those ``left``, but enough for a usable surface."""
        steps = self.config.steps[level]
        least = least_share(steps) * steps * self.cost(level)
        if left < least:
            self.budget.notes.append(f"the time was up before level {level}, which is trained briefly all the same")
        return self.elapsed + max(left, least)

    def distances(self, level: int) -> CloudDistance:
        """The points that a level learns from, densified where they are sparse.

        Level 0 is not judged, so no point is held out of it: a small face may lie in a single voxel.
        """
        config, all_points = self.config, self.points.numpy()
        about: dict[str, Any] = {"noise": self.cloud.noise, "guessed": self.cloud.estimated, "beyond": self.beyond}
        self.spacing = spacing_of(all_points.astype(np.float64))
        share = config.hold_out if level and self.cloud.noisy is None else 0.0
        self.held = torch.from_numpy(held_out(all_points, self.spacing, share, seed=config.seed))
        points, normals = self.points[~self.held], self.normals[~self.held]
        if not config.between:
            return CloudDistance(points, normals, **about)
        about |= {"omega": max(config.omegas), "count": self.filling, "seed": config.seed}
        return dense_distance(points, normals, **about)

    def next_band(self) -> Band:
        """The band around the last frozen level (Eq. 5), no wider than the one before."""
        config, level = self.config, len(self.stages)
        assert self.frozen is not None
        band = band_of(self.errors, epsilon=config.epsilon, quantile=config.quantile)
        if level == 1 and config.quantile is None:
            about = {"epsilon": config.epsilon, "count": self.filling, "seed": config.seed, "device": self.device}
            band = with_wrong_sides(band, self.errors, self.indexed(level), self.frozen, **about)
        return band.within(self.stages[-1]["delta"], self.errors)

    def judge(
        self, delta: float, before: Field, *, data: float = 0.0, normal: float = 0.0, scales: RobustScales = SQUARES
    ) -> Judge | None:
        """The judge of levels after those ``before``, with loss weights; None without enough held-out points."""
        index, noisy = self.indexed(before.num_levels), self.cloud.noisy
        points = self.points[self.held] if noisy is None else torch.from_numpy(noisy)
        if not len(points):
            return None
        rows = index.nearest_rows(points.numpy())[1]
        normals = self.normals[self.held] if noisy is None else torch.from_numpy(index.normals[rows])
        terms: dict[str, Any] = {"data": data, "normal": normal, "scales": scales, "spacing": self.spacing}
        about = {"guessed": self.cloud.estimated, "noisy": noisy is not None}
        areas = torch.from_numpy(index.gaps[rows]) ** 2
        judge = Judge(points, normals, before, delta, areas=areas, **about, **terms)
        return judge if judge.count >= JUDGE.fewest / 2 else None

    def review(self) -> dict[str, Any]:
        """Drop outliers and turn normals by level 0 → counts for the record."""
        config = self.config
        turn = config.turn_normals and config.normals != "file"
        assert self.frozen is not None
        patches = turn and self.cloud.report.oriented_by in (*GUESSED, "level")
        about = {"device": self.device, "outliers": config.drop_outliers, "turn": turn, "patches": patches}
        found = review_points(self.points, self.normals, self.frozen, **about)
        if found.dropped.any() or found.turned.any():
            kept, turned = torch.from_numpy(~found.dropped), torch.from_numpy(found.turned)
            self.normals = torch.where(turned[:, None], -self.normals, self.normals)[kept]
            self.points = self.points[kept]
            self.index = None
            self.keep_support()
        return found.record()

    @torch.no_grad()
    def values_at_cloud(self) -> Tensor:
        """Values ``(n,)`` of the finest frozen level at the points, on the CPU."""
        assert self.frozen is not None
        return torch.cat([self.frozen.value(part.to(self.device)).cpu() for part in self.points.split(1 << 18)])

    def surface_errors(self) -> dict[str, float]:
        """|f| at the points, in input units."""
        scale = self.similarity.scale
        return {"rms_at_points": _rms(self.errors) * scale, "max_at_points": float(self.errors.abs().max()) * scale}

    def grown(self, siren: Siren, delta: float | None) -> MultiscaleSDF:
        """The frozen levels and one more."""
        if self.frozen is None or delta is None:
            return MultiscaleSDF(siren, [], []).to(self.device)
        return self.frozen.with_level(siren, delta=delta).to(self.device)

    def kept(self) -> dict[str, Any]:
        """See `Training.kept`."""
        signs = None if self.signs is None else self.signs.record()
        return {"samples": self.samples, "filling": self.filling, "signs": signs}

    def kept_tensors(self) -> dict[str, Tensor]:
        """See `Training.kept_tensors`."""
        return {} if self.signs is None else {"signs.turned": torch.from_numpy(self.signs.turned)}

    def restore(self) -> None:
        """Take up an interrupted run."""
        mismatch = f"{self.source}: not the cloud that {self.folder.path} was fitted to; resume with that cloud"
        tensors, progress = self.restored(mismatch)
        full = self.config.samples
        self.samples, self.filling = progress.get("samples") or full, progress.get("filling") or full
        signs = progress.get("signs")
        if signs is not None:
            self.take_signs(Signs(tensors["signs.turned"].numpy(), signs["slope"], signs["witness"]))
        omegas = [stage.get("omega") for stage in self.stages]  # runs of older versions have the configured ones
        levels = [new_level(self.config, level, residual=False, omega=omega) for level, omega in enumerate(omegas)]
        if levels:
            empty = MultiscaleSDF(levels[0], levels[1:], [1.0] * (len(levels) - 1)).to(self.device)
            self.frozen = restore_frozen(empty, tensors)
            self.review()  # not stored: it follows from the cloud and level 0
            self.errors = self.values_at_cloud()

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        return {
            **self.origin,
            "cleaning": dataclasses.asdict(self.cloud.report),
            "signs": None if self.signs is None else self.signs.record(),
            "preparation_seconds": round(self.preparation_seconds, 3),
            "peak_memory": peak_memory(),
            **self.common_record(finished=finished),
            **self.stages_record(),
        }


def _silence(siren: Any) -> None:
    """Set a residual to zero."""
    nn.init.zeros_(siren.output.weight)
    nn.init.zeros_(siren.output.bias)


def _rms(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())
