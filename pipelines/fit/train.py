"""``fit``: from an oriented point cloud to a multiscale SDF, level by level (paper Sec. 3.2).

What the coarse level shows to be wrong with the cloud, outliers and flipped normals, the finer ones do not see.
"""

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
from ...datasets.clouds.large import Merging
from ...neural_fields import InputError, MultiscaleSDF, Similarity, Siren
from ..surface.surface import thinned
from ..training.folder import SUPPORT_FILE, RunFolder, digest_of, named_cloud
from ..training.machine import choose_device, environment, peak_memory
from ..training.progress import reported, silent
from ..training.result import Run
from ..training.scaffold import BUDGET, Budget, affordable, least_share, step_seconds
from ..training.settings import FitConfig
from ..training.trainer import (
    Interrupted,
    Report,
    StopFlag,
    Trainer,
    checkpoint_of,
    load_compiler,
    parameter_count,
    restore_frozen,
    stop_on_signals,
    without_prefix,
)
from .band import Band, band_of, with_wrong_sides
from .between import dense_distance
from .cloud import CloudDistance, load_cloud
from .heldout import JUDGE, Judge, held_out
from .level import LEVEL, LevelObjective, calm_omega, new_level
from .review import Review, review_points
from .samples import DOMAIN, Source, banded_sources, first_sources
from .unoriented import Places, Signs, fits_better, give_signs, signed

__all__ = ["FitConfig", "Review", "Run", "fit", "fit_moved", "prepare", "review_points"]

GUESSED = ("winding", "propagation")  # what gives estimated normals signs that may be wrong in whole patches

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
        out: run directory for the field, the checkpoints and ``run.json``; None writes nothing. What another run left
            there stays until the cloud has been read and found to be usable.
        resume: continue the interrupted run in ``out`` with its own settings; ``config`` is then ignored.
        progress: called now and then with how far the training is.
        level_done: called with the field of all levels so far when one is finished, to show it, say; and with the
            similarity to input coordinates.

    Raises:
        InputError: the cloud cannot be read or used, or there is nothing to resume.
        Interrupted: Ctrl-C or SIGTERM; ``out`` then holds a checkpoint and a usable field.

    Example:
        >>> run = fit("scan.ply")  # doctest: +SKIP
        >>> run.world.distance(points)  # of the scan, in its coordinates and units  # doctest: +SKIP
    """
    return _fit(RunFolder(out, resume=resume), cloud, config, progress=progress, level_done=level_done)


def fit_moved(
    file: Path, config: FitConfig, *, out: Path, name: str, progress: Report | None = None
) -> Run[MultiscaleSDF]:
    """`fit` a cloud that was made for the run, and lies in its directory.

    Args:
        file: the cloud.
        config: settings.
        out: run directory.
        name: of its copy there, from the first checkpoint on.
        progress: see `fit`.

    Raises:
        InputError: see `fit`.
        Interrupted: see `fit`.
    """
    folder = RunFolder(out)
    folder.keep(name, file.read_bytes())
    return _fit(folder, file, config, source=str(out / name), progress=progress)


def _fit(
    folder: RunFolder,
    cloud: Cloud,
    config: FitConfig | None,
    *,
    source: str | None = None,
    progress: Report | None = None,
    level_done: LevelDone | None = None,
) -> Run[MultiscaleSDF]:
    config = folder.config(FitConfig, config)
    device = choose_device(config.device)
    budget, points = Budget(config.time_budget), _as_cloud(cloud)
    with reported(progress, "reading the cloud"):
        raw, merging = load_cloud(
            points,
            limit=config.merge_above,
            isolation=config.isolation,
            cache=folder.path,
            columns=config.columns,
            drop_noise=config.drop_noise,
        )
    with reported(progress, "preparing the cloud"):
        prepared = prepare(raw, config)
    load_compiler()
    fitting = _Fitting(prepared, source or raw.source, config, device, folder, budget, merging)
    fitting.reading = raw.reading
    fitting.report = progress or silent
    fitting.level_done = level_done
    with folder.writing(), stop_on_signals() as flag:
        if folder.resume:
            fitting.restore()
        return fitting.run(flag)


def prepare(cloud: PointCloud, config: FitConfig) -> OrientedCloud:
    """`prepare_cloud` as the settings of a fit ask for it.

    Raises:
        InputError: see `prepare_cloud`.
    """
    given = config.normals
    return prepare_cloud(
        cloud,
        normals="estimate" if given == "none" else given,
        sensor_origin=config.sensor_origin,
        isolation=config.isolation,
        drop_outliers=config.drop_outliers,
        turn_normals=config.turn_normals,
        smooth_noise=config.smooth_noise and given != "none",  # along which normals, level 0 says first
    )


def _as_cloud(cloud: Cloud) -> PointCloud | str | Path:
    if isinstance(cloud, PointCloud | str | Path):
        return cloud
    array = np.asarray(cloud)
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        raise InputError(f"cloud: array of shape {array.shape}; expected (N, 3) points or (N, 6) points and normals")
    normals = array[:, 3:].astype(np.float32) if array.shape[1] == 6 else None
    return PointCloud(points=array[:, :3].astype(np.float64), normals=normals, source="array")


class _Fitting:
    """One fit under way: the frozen levels, and the records of their stages."""

    def __init__(
        self,
        cloud: OrientedCloud,
        source: str,
        config: FitConfig,
        device: torch.device,
        folder: RunFolder,
        budget: Budget,
        merging: Merging | None,
    ) -> None:
        self.cloud, self.source, self.config = cloud, source, config
        self.device, self.folder, self.merging = device, folder, merging
        self.budget, self.preparation_seconds = budget, time.monotonic() - budget.started
        self.report: Report = silent
        self.reading = ""
        self.costs: dict[int, float] = {}  # measured seconds of a step, by level
        self.fingerprint = digest_of((cloud.points, cloud.normals))
        self.points, self.normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
        self.index: CloudDistance | None = None  # of the points above
        self.held = torch.zeros(len(self.points), dtype=torch.bool)  # those of them that residual levels leave out
        self.signs: Signs | None = None  # that the points without normals were given
        self.spacing = 0.0  # of all of them
        self.frozen: MultiscaleSDF | None = None
        self.errors = torch.empty(0)  # of the last frozen level, at the input points
        self.stages: list[dict[str, Any]] = []
        self.trainer_state: dict[str, Tensor] = {}
        self.level_done: LevelDone | None = None
        # Of the level under way, and of the cloud's index; fewer than the settings' where a time budget leaves no more.
        self.samples = self.filling = config.samples

    def run(self, flag: StopFlag) -> Run[MultiscaleSDF]:
        if not self.stages and not self.trainer_state:
            self.find_signs(flag)
        self.keep_support()
        for level in range(len(self.stages), self.config.num_levels):
            share = self.share(level)
            if share is None:
                self.budget.leave_out(level, self.config.num_levels)
                break
            self.train_level(level, share, flag)
        assert self.frozen is not None
        record = self.folder.finish(self.frozen, self.cloud.similarity, self.record(finished=True))
        return Run(self.frozen.cpu(), self.cloud.similarity, self.folder.out, record)

    def find_signs(self, flag: StopFlag) -> None:
        """Let a network say which way normals point whose signs nobody knows for sure."""
        if self.config.normals != "none" and self.cloud.report.oriented_by not in GUESSED:
            return
        asked = self.config.normals == "none"
        places = Places.around(CloudDistance(self.points, self.normals), seed=self.config.seed)
        if not asked and not places.contested:
            return
        signs = give_signs(
            self.points,
            self.normals,
            self.config,
            device=self.device,
            places=places,
            flag=flag,
            report=self.report,
        )
        if signs is None:
            self.save(self.grown(new_level(self.config, 0, residual=False), None), None)
            raise Interrupted(self.folder.out)
        if asked or fits_better(self.cloud, signs):
            self.take_signs(signs)

    def take_signs(self, signs: Signs) -> None:
        """Turn normals as was found, and smooth the noise along them, if that was left until now."""
        self.signs = signs
        self.cloud = signed(self.cloud, signs, smooth=self.config.normals == "none" and self.config.smooth_noise)
        self.points, self.normals = torch.from_numpy(self.cloud.points), torch.from_numpy(self.cloud.normals)

    def keep_support(self) -> None:
        """Keep the points that are fitted in the run."""
        if self.folder.out is not None:
            self.folder.keep_tensors(SUPPORT_FILE, thinned(self.points.numpy()))

    def share(self, level: int) -> float | None:
        """Seconds for samples and training of a level; infinite without a budget, None if it is not worth beginning."""
        left, steps = self.budget.left(), self.config.steps[: self.config.num_levels]
        if left is None:
            return math.inf
        training, begun = 1 - BUDGET.sampling_share, bool(self.trainer_state)
        return self.budget.share(left, level, steps, self.cost, training=training, begun=begun)

    def cost(self, level: int) -> float:
        """Measured seconds of a training step of a level."""
        if level not in self.costs:
            siren = new_level(self.config, level, residual=False).to(self.device)
            points = torch.rand(self.config.batch, 3, generator=torch.Generator().manual_seed(0))
            points = ((2 * points - 1) * DOMAIN).to(self.device)

            def step() -> Tensor:
                jet = siren.jet(points)
                return jet.value.square().mean() + jet.gradient.square().mean()

            self.costs[level] = step_seconds(step, self.budget.left() or 0.0)
        return self.costs[level]

    def indexed(self, level: int) -> CloudDistance:
        """`distances` of a level, made once."""
        self.index = self.index or self.distances(level)
        return self.index

    def train_level(self, level: int, share: float, flag: StopFlag) -> None:
        """Make the samples of one level, train it, freeze it, in ``share`` seconds."""
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
            gain = LEVEL.small_gain if config.robust_normals else LEVEL.residual_gain
            noisy = self.cloud.estimated and index.filled < 0.5
            omega = calm_omega(config, level, self.cloud.noise if noisy else 0.0)
            siren = new_level(config, level, residual=level > 0, gain=gain, omega=omega).to(self.device)
            sources = self.sources(index, delta, config, generator)
            judge = None if delta is None else self.judge(delta, sources[0])
        sampling_seconds = time.monotonic() - started
        seconds = None if share == math.inf else self.training_seconds(level, share - sampling_seconds)
        rate = config.learning_rates[level]
        objective = LevelObjective(siren, sources, learning_rate=rate, generator=generator, judge=judge)
        trainer = Trainer(
            objective,
            stage=f"level {level}",
            steps=config.steps[level],
            seconds=seconds,
        )
        if self.trainer_state:
            trainer.restore(self.trainer_state)
            self.trainer_state = {}
        if not trainer.run(flag, report=self.report, save=lambda: self.save(self.grown(siren, delta), trainer)):
            raise Interrupted(self.folder.out)
        verdict = objective.take_best()
        self.frozen = self.grown(siren, delta).requires_grad_(False)
        review = self.review() if level == 0 else None
        if level == 0 and config.hold_out:
            self.index = None  # the next level leaves some points out
        before, self.errors = self.errors, self.values_at_cloud()
        silenced = level > 0 and _rms(self.errors) > LEVEL.worse * _rms(before)
        if verdict is not None:
            seen = ~self.held
            learnt = _rms(self.errors[seen]) / max(_rms(before[seen]), 1e-30)
            verdict = verdict._replace(learnt=learnt)
            silenced |= not verdict.better
        if silenced:
            nn.init.zeros_(siren.output.weight)
            nn.init.zeros_(siren.output.bias)
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
                "ended_by_time_budget": trainer.ended_early and not objective.hopeless,
                "silenced": silenced,
                "held_out": None if verdict is None else verdict.record(level, scale=self.cloud.similarity.scale),
                "losses": trainer.losses,
                **({} if review is None else {"review": review}),
                **self.surface_errors(),
            }
        )
        self.save(self.frozen, None)
        if self.level_done is not None:
            self.level_done(self.frozen, self.cloud.similarity)

    def sources(
        self, index: CloudDistance, delta: float | None, config: FitConfig, generator: torch.Generator
    ) -> list[Source]:
        """The samples of the next level; those of a residual level lie in the band of half-width ``delta``."""
        if self.frozen is None or delta is None:
            return first_sources(index, config, generator=generator, device=self.device)
        return banded_sources(index, self.frozen, delta, config, generator=generator, name=self.source)

    def affordable_filling(self, share: float) -> int:
        """Points of the index that level 0 has time for, if it gets ``share`` seconds in all."""
        full = self.config.samples
        if not self.config.between or full <= len(self.points):
            return full
        index, generator = CloudDistance(self.points, self.normals), torch.Generator().manual_seed(0)
        return affordable(
            lambda count: self.sources(index, None, dataclasses.replace(self.config, samples=count), generator),
            full,
            BUDGET.sampling_share / 2 * share,
        )

    def affordable_samples(
        self, level: int, share: float, started: float, index: CloudDistance, delta: float | None
    ) -> int:
        """Samples of each kind that a level has time for, which began at ``started``."""
        if share == math.inf:
            return self.config.samples
        spare = share - self.config.steps[level] * self.cost(level)
        generator, full = torch.Generator().manual_seed(0), self.config.samples
        count = affordable(
            lambda count: self.sources(index, delta, dataclasses.replace(self.config, samples=count), generator),
            full,
            max(BUDGET.sampling_share * share, spare) - (time.monotonic() - started),
        )
        if count < full:
            note = f"level {level} learns from {count:,} samples of each kind instead of {full:,}"
            self.budget.notes.append(note)
        return count

    def training_seconds(self, level: int, left: float) -> float:
        """Seconds for the steps of a level of which ``left`` remain: at least so many that there is a surface."""
        steps, took = self.config.steps[level], 0.0
        if self.trainer_state:
            took = float(self.trainer_state["progress"][1])
        least = least_share(steps) * steps * self.cost(level)
        if left < least:
            self.budget.notes.append(f"the time was up before level {level}, which is trained briefly all the same")
        return took + max(left, least)

    def distances(self, level: int) -> CloudDistance:
        """The points that are trained on, and where they are sparse, what they say of the places between them.

        Nobody judges level 0, so it learns from all of them: a voxel may be all that there is of a small face.
        """
        config, all_points = self.config, self.points.numpy()
        noise, guessed = self.cloud.noise, self.cloud.estimated
        self.spacing = spacing_of(all_points.astype(np.float64))
        share = config.hold_out if level else 0.0
        self.held = torch.from_numpy(held_out(all_points, self.spacing, share, seed=config.seed))
        points, normals = self.points[~self.held], self.normals[~self.held]
        if not config.between:
            return CloudDistance(points, normals, noise=noise, guessed=guessed)
        omega = max(config.omegas[: config.num_levels])
        about = {"noise": noise, "guessed": guessed, "seed": config.seed}
        return dense_distance(points, normals, omega=omega, count=self.filling, **about)

    def next_band(self) -> Band:
        """The band around the last frozen level (Eq. 5), inside the one before: under noise it could be wider."""
        config, level = self.config, len(self.stages)
        assert self.frozen is not None
        band = band_of(self.errors, epsilon=config.epsilon, quantile=config.quantile)
        if level == 1 and config.quantile is None:
            asked = {"epsilon": config.epsilon, "count": self.filling, "seed": config.seed, "device": self.device}
            band = with_wrong_sides(band, self.errors, self.indexed(level), self.frozen, **asked)
        return band.within(self.stages[-1]["delta"], self.errors)

    def judge(self, delta: float, surface: Source) -> Judge | None:
        """What judges a residual level, by the weights of its loss on the surface; None if no point was held out."""
        if not self.held.any():
            return None
        assert self.frozen is not None
        points, normals = self.points[self.held], self.normals[self.held]
        areas = torch.from_numpy(self.indexed(len(self.stages)).beyond(points.numpy(), 1.0)[1].astype(np.float32)) ** 2
        terms = {"data": surface.data, "normal": surface.normal, "usual": surface.usual}
        about = {"spacing": self.spacing, "areas": areas, "guessed": self.cloud.estimated}
        judge = Judge(points, normals, self.frozen, delta, **about, **terms)
        return judge if judge.count >= JUDGE.fewest / 2 else None

    def review(self) -> dict[str, Any]:
        """Take out of the data, or turn round, what level 0 shows to be wrong → counts for the record."""
        config = self.config
        turn = config.turn_normals and config.normals != "file"
        assert self.frozen is not None
        found = review_points(
            self.points,
            self.normals,
            self.frozen,
            device=self.device,
            outliers=config.drop_outliers,
            turn=turn,
            patches=turn and self.cloud.report.oriented_by in (*GUESSED, "level"),
        )
        if found.dropped.any() or found.turned.any():
            kept, turned = torch.from_numpy(~found.dropped), torch.from_numpy(found.turned)
            self.normals = torch.where(turned[:, None], -self.normals, self.normals)[kept]
            self.points = self.points[kept]
            self.index = None
            self.keep_support()
        return found.record()

    @torch.no_grad()
    def values_at_cloud(self) -> Tensor:
        """Values of the finest frozen level at the input points → ``(n,)`` on the CPU."""
        assert self.frozen is not None
        return torch.cat([self.frozen.value(part.to(self.device)).cpu() for part in self.points.split(1 << 18)])

    def surface_errors(self) -> dict[str, float]:
        """|f| at the input points, in input units: how closely the level passes by them."""
        scale = self.cloud.similarity.scale
        return {"rms_at_points": _rms(self.errors) * scale, "max_at_points": float(self.errors.abs().max()) * scale}

    def grown(self, siren: Siren, delta: float | None) -> MultiscaleSDF:
        """The frozen levels and one more."""
        if self.frozen is None or delta is None:
            return MultiscaleSDF(siren, [], []).to(self.device)
        return self.frozen.with_level(siren, delta=delta).to(self.device)

    def save(self, field: MultiscaleSDF, trainer: Trainer[LevelObjective] | None) -> None:
        """Write a usable field and all that `restore` needs."""
        tensors = checkpoint_of(self.frozen, trainer)
        if self.signs is not None:
            tensors["signs.turned"] = torch.from_numpy(self.signs.turned)
        kept = {"samples": self.samples, "filling": self.filling, "notes": self.budget.notes}
        signs = None if self.signs is None else self.signs.record()
        progress = {"fingerprint": self.fingerprint, "stages": self.stages, "signs": signs, **kept}
        self.folder.save(field, self.cloud.similarity, self.record(finished=False), tensors, progress)

    def restore(self) -> None:
        """Take up an interrupted run; see `RunFolder.restore`."""
        mismatch = f"{self.source}: not the cloud that {self.folder.path} was fitted to; resume with that cloud"
        tensors, progress = self.folder.restore(self.fingerprint, mismatch)
        self.stages, full = progress["stages"], self.config.samples
        self.samples, self.filling = progress.get("samples") or full, progress.get("filling") or full
        self.budget.notes = progress.get("notes", [])
        signs = progress.get("signs")
        if signs is not None:
            self.take_signs(Signs(tensors["signs.turned"].numpy(), signs["slope"], signs["witness"]))
        omegas = [stage.get("omega") for stage in self.stages]  # older runs have the configuration's
        levels = [new_level(self.config, level, residual=False, omega=omega) for level, omega in enumerate(omegas)]
        if levels:
            empty = MultiscaleSDF(levels[0], levels[1:], [1.0] * (len(levels) - 1)).to(self.device)
            self.frozen = restore_frozen(empty, tensors)
            self.review()  # again: it follows from the cloud and level 0
            self.errors = self.values_at_cloud()
        self.trainer_state = without_prefix("trainer.", tensors)
        took = sum(stage["sampling_seconds"] + stage["training_seconds"] for stage in self.stages)
        self.budget.before = took + (float(self.trainer_state["progress"][1]) if self.trainer_state else 0.0)

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        return {
            "finished": finished,
            **named_cloud(self.source, self.folder.path),
            "reading": self.reading,
            "merging": None if self.merging is None else dataclasses.asdict(self.merging),
            "cleaning": dataclasses.asdict(self.cloud.report),
            "signs": None if self.signs is None else self.signs.record(),
            "similarity": dataclasses.asdict(self.cloud.similarity),
            "config": dataclasses.asdict(self.config),
            "stages": self.stages,
            "parameters": sum(stage["parameters"] for stage in self.stages),
            "deltas": [stage["delta"] for stage in self.stages if stage["delta"] is not None],
            "preparation_seconds": round(self.preparation_seconds, 3),
            "training_seconds": round(sum(s["sampling_seconds"] + s["training_seconds"] for s in self.stages), 3),
            **self.budget.record(),
            "peak_memory": peak_memory(),
            "environment": environment(self.device),
        }


def _rms(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())
