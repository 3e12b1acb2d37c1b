"""``texture``: from colours on points or meshes to a texture field around a fitted surface (paper Sec. 3)."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets import PointCloud, read_cloud
from ...datasets.clouds.point_cloud import select
from ...datasets.textured.reading import TEXTURED_READERS, read_textured, sample_textured
from ...neural_fields import Field, InputError, Similarity, TextureField, load_field, load_texture
from ...neural_fields.backend.devices import upload
from ...neural_fields.backend.files import damage, write_whole
from ...neural_fields.checkpoint import texture_bytes
from ...neural_fields.fields.losses import color_loss, tangential_loss
from ...neural_fields.networks.colors import ColorSiren
from ...neural_fields.spacetime.dynamic_tracing import moment
from ..fit.samples import DOMAIN, value_and_gradient
from ..training.folder import (
    TEXTURE_FILE,
    RunFolder,
    chosen_level,
    digest_of,
    find_field,
    load_state,
    locked,
    prune,
    save_state,
    texture_state_file,
    write_texture,
)
from ..training.progress import Report, reported, silent
from ..training.result import Run
from ..training.scaffold import BUDGET, Budget, Training, affordable, step_seconds
from ..training.settings import TextureConfig, load_config
from ..training.trainer import Objective, Trainer, parameter_count, seeded, siren_groups, stop_on_signals


class ColorSamples(NamedTuple):
    """Points of the band with known colours."""

    points: Tensor  # (N, 3) in unit-sphere coordinates
    colors: Tensor  # (N, 3) display RGB
    left_out: int  # how many points of the cloud were outside the band, or not finite


class BandSamples(NamedTuple):
    """Points of the band with the direction along which the colour shall not change."""

    points: Tensor  # (M, 3) in unit-sphere coordinates
    gradients: Tensor  # (M, 3) ∇f there


def read_colors(path: str | Path, *, samples: int, seed: int, columns: str | None = None) -> PointCloud:
    """Read a cloud with colours; a mesh gives ``samples`` points, with the colours of its texture or its vertices.

    Raises:
        InputError: the file cannot be read, or has no colours.
    """
    path = Path(path)
    if path.suffix.lower() in TEXTURED_READERS and _has_faces(path):
        return sample_textured(read_textured(path), samples, seed=seed)
    cloud = read_cloud(path, columns=columns)
    if cloud.colors is None:
        raise InputError(f"{path}: colors: there are none; export the points with their colours, or name a mesh")
    return cloud


def has_colors(path: str | Path, columns: str | None = None) -> bool:
    """Whether `read_colors` would find colours in the file of a cloud or mesh; InputError if it cannot be read."""
    path = Path(path)
    cloud = read_cloud(path, columns=columns)
    if path.suffix.lower() in TEXTURED_READERS and _has_faces(path):
        return TEXTURED_READERS[path.suffix.lower()](path).has_colors
    return cloud.colors is not None


def _has_faces(path: Path) -> bool:
    """Whether a file is a mesh; one that does not exist is left to whoever reads it."""
    extension = path.suffix.lower()
    if extension not in (".ply", ".obj") or not path.is_file():
        return True
    with path.open("rb") as file:
        if extension == ".obj":
            return any(line.lstrip().startswith(b"f ") for line in file)
        header = file.read(1 << 16).split(b"end_header", 1)[0]
        return re.search(rb"element\s+face\s+0*[1-9]", header) is not None


@torch.no_grad()
def match_colors(
    cloud: PointCloud, geometry: Field, similarity: Similarity, *, level: int, delta: float
) -> ColorSamples:
    """The points of a cloud in input coordinates that lie in the band |f| < ``delta``, in the field's coordinates.

    Raises:
        InputError: there are no colours, or most of the points are not near the surface: another shape or scale.
    """
    if cloud.colors is None:
        raise InputError(f"{cloud.source}: colors: there are none; export the points with their colours")
    finite = np.isfinite(cloud.points).all(axis=1)
    unit = similarity.to_unit(cloud.points[finite])
    distances = _distances(unit, geometry, level=level)
    inside = distances < delta
    # With fewer points in the band, the colours are those of something else.
    if inside.mean() < 0.5:
        far, near = np.median(distances) * similarity.scale, delta * similarity.scale
        raise InputError(
            f"{cloud.source}: points: {inside.mean():.0%} of them lie within {near:.3g} of the surface of the run, "
            f"half are further off than {far:.3g} (input units); give the shape that was fitted, in the same "
            "coordinates, or widen the band (--delta)"
        )
    like = geometry.like
    points = torch.from_numpy(unit[inside]).to(like)
    colors = torch.from_numpy(cloud.colors[finite][inside]).to(like)
    return ColorSamples(points, colors, len(cloud) - len(points))


def _distances(unit: NDArray[np.float64], geometry: Field, *, level: int) -> NDArray[np.float64]:
    """|f|, and beyond the cube in which fields are trained the way back into it as well → ``(N,)``."""
    clamped = unit.clip(-DOMAIN, DOMAIN)
    points = torch.from_numpy(clamped).to(geometry.like)
    values = torch.cat([geometry.value(part, level=level).abs() for part in points.split(1 << 17)])
    return values.double().cpu().numpy() + np.linalg.norm(unit - clamped, axis=1)


@torch.no_grad()
def band_directions(
    samples: ColorSamples, geometry: Field, count: int, *, level: int, delta: float, generator: torch.Generator
) -> BandSamples:
    """``count`` points moved by U(−δ, δ) along each axis, those that stay in the band, with ∇f."""
    index = torch.randint(len(samples.points), (count,), generator=generator)
    shift = (2 * torch.rand(count, 3, generator=generator) - 1) * delta
    points = samples.points[index.to(samples.points.device)] + shift.to(samples.points)
    value, gradient = value_and_gradient(geometry, points, level=level)
    kept = (value.abs() < delta).nonzero()[:, 0]
    return BandSamples(points[kept], gradient[kept])


# A band at least this wide (in units of the field) holds decimated meshes, and the surfaces of small networks.
LEAST_DELTA = 0.02
FEWEST_COLORED = 2_000  # points that are left where time is short


@dataclass(frozen=True)
class FittedTexture(Run[Field]):
    """A trained texture; ``record`` is what ``run.json`` holds under ``texture``, not ``finished`` after Ctrl-C.

    Attributes:
        texture: on the CPU, around its geometry.
    """

    texture: TextureField


def texture_step_seconds(config: TextureConfig, device: torch.device, left: float) -> float:
    """Measured seconds of a step of `fit_texture`; see `step_seconds`."""
    generator = torch.Generator().manual_seed(0)
    points, others = (torch.rand(config.batch, 3, generator=generator).to(device) for _ in range(2))
    network = ColorSiren(config.width, config.depth, omega=config.omega).to(device)
    samples, band = ColorSamples(points, others, 0), BandSamples(points, others)
    objective = TextureObjective(network, samples, band, config, delta=LEAST_DELTA, generator=generator)
    return step_seconds(lambda: objective.losses(0, 0.0)[1], left)


def fit_texture(
    geometry: Field,
    cloud: PointCloud,
    config: TextureConfig | None = None,
    *,
    similarity: Similarity | None = None,
    level: int = -1,
    progress: Report | None = None,
    started: float | None = None,
) -> FittedTexture:
    """Train a texture field by the paper's 𝒯(φ): the colours at points, and none of their change along ∇f.

    The geometry f is frozen. The ``cloud`` has colours, in input coordinates (of meshes see `read_colors`), from which
    ``similarity`` leads to f's. The time budget began when it was ``started``, by `time.monotonic`; None is now. Ctrl-C
    ends the training early and leaves what has been learnt.

    Raises:
        InputError: the cloud has no colours, or lies somewhere else than the surface.
        ValueError: there is no such ``level`` of f.
    """
    config, similarity = config or TextureConfig(), similarity or Similarity.identity()
    budget = Budget(config.time_budget, started=started)
    return _Texturing(geometry, cloud, config, similarity, level, budget, progress or silent).run()


class _Texturing(Training[TextureConfig, Field]):
    """One texture under way; ``save`` writes the state of its trainer, for ``trainer_state`` of the next process."""

    def __init__(
        self,
        geometry: Field,
        cloud: PointCloud,
        config: TextureConfig,
        similarity: Similarity,
        level: int,
        budget: Budget,
        report: Report,
        keep: Callable[[dict[str, Tensor]], None] | None = None,
    ) -> None:
        super().__init__(config, RunFolder(None), budget, report)
        self.home, self.geometry = geometry.like.device, geometry.to(self.device)
        self.cloud, self.similarity, self.keep = cloud, similarity, keep
        self.level = geometry.resolve_level(level)
        self.delta = config.delta or default_delta(geometry)
        self.generator = torch.Generator()

    def run(self) -> FittedTexture:
        config = self.config
        with reported(self.report, "texture: samples"):
            cloud, band_samples = self.affordable()
            self.samples, band = self.made(cloud, band_samples)
            mean = self.samples.colors.mean(dim=0).tolist()
            with seeded(config.seed):
                network = ColorSiren(config.width, config.depth, omega=config.omega, mean=mean)
            self.network = network.to(self.samples.points)
        self.sampling_seconds = time.monotonic() - self.budget.started
        left, seconds = self.budget.left(), None
        if left is not None and config.time_budget is not None:
            seconds = max(left, 0.1 * config.time_budget)  # the steps get a tenth in any case
        objective = TextureObjective(
            self.network, self.samples, band, config, delta=self.delta, generator=self.generator
        )
        self.trainer = Trainer(objective, stage="texture", steps=config.steps, seconds=seconds)
        with stop_on_signals() as flag:
            finished = self.take_steps(self.trainer, flag, lambda: self.geometry)
        record = self.record(finished=finished)
        self.network.requires_grad_(False)
        geometry, colors = self.geometry.to(self.home), self.network.to(self.home)
        texture = TextureField(geometry, colors, delta=self.delta, geometry_level=self.level, outside=mean)
        texture = texture.to(self.home)
        return FittedTexture(texture.geometry, self.similarity, None, record, texture)

    def made(self, cloud: PointCloud, band_samples: int) -> tuple[ColorSamples, BandSamples]:
        """The samples of a cloud; ∇f is evaluated once, so that a step evaluates the texture network only."""
        geometry, generator = self.geometry, self.generator.manual_seed(self.config.seed)
        about = {"level": self.level, "delta": self.delta}
        samples = match_colors(cloud, geometry, self.similarity, **about)
        return samples, band_directions(samples, geometry, band_samples, generator=generator, **about)

    def affordable(self) -> tuple[PointCloud, int]:
        """As much of the cloud, and as many points of the band, as there is time for."""
        cloud, band_samples, left = self.cloud, self.config.samples // 2, self.budget.left()
        if left is None:
            return cloud, band_samples

        def part(count: int) -> tuple[PointCloud, int]:
            """``count`` of the points, and as large a part of the band's."""
            share = count / max(len(cloud), 1)
            return _thinned(cloud, share, self.config.seed), max(int(share * band_samples), FEWEST_COLORED)

        seconds = BUDGET.sampling_share * left
        count = affordable(lambda count: self.made(*part(count)), len(cloud), seconds, fewest=FEWEST_COLORED)
        if count == len(cloud):
            return cloud, band_samples
        some, few = part(count)
        self.budget.notes.append(f"learns from {len(some):,} points and {few:,} of the band, for want of time")
        return some, few

    def save(self, field: Field, trainer: Trainer[Any] | None) -> None:
        """See `Training.save`."""
        if self.keep is not None and trainer is not None:
            self.keep(trainer.state())

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds under ``texture``."""
        return {
            "source": self.cloud.source,
            "level": self.level,
            "delta": self.delta,
            "points": len(self.samples.points),
            "left_out": self.samples.left_out,
            "parameters": parameter_count(self.network),
            "steps": self.trainer.step,
            "sampling_seconds": round(self.sampling_seconds, 3),
            "training_seconds": round(self.trainer.elapsed, 3),
            "losses": self.trainer.losses,
            "psnr_at_points": _psnr(self.network, self.samples, self.generator),
            **self.common_record(finished=finished),
        }


def texture_run(
    run: str | Path,
    source: str | Path,
    config: TextureConfig | None = None,
    *,
    out: str | Path | None = None,
    level: int | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> FittedTexture:
    """Train a texture for a run and write it, by default beside its field, where ``run.json`` records it.

    Until it is trained, the state of the training lies beside it; see `texture_state_file`.

    Args:
        run: run directory or .safetensors file.
        source: a cloud with colours or a mesh with a texture or vertex colours, in the coordinates of the fit.
        config: settings.
        out: another place for the texture.
        level: of the run, counted from 0; None is the finest.
        resume: continue the interrupted training with its own settings and level; those given are then ignored.
        progress: see `fit_texture`.

    Raises:
        InputError: there is no such run or level, the source cannot be used, or there is nothing to resume.
    """
    started = time.monotonic()
    file = find_field(run)
    target = file.with_name(TEXTURE_FILE) if out is None else Path(out)
    beside = target == file.with_name(TEXTURE_FILE)
    state_file = texture_state_file(target)
    with locked(file.parent if beside else target):
        if beside:
            prune(file.parent)
        tensors, before = load_state(state_file.parent, name=state_file.name) if resume else ({}, {})
        if resume:
            with damage(state_file, "begin again without --resume"):
                config, level = load_config(TextureConfig, None, before["config"]), before["level"]
        config = config or TextureConfig()
        geometry, similarity, _ = load_field(file)
        if geometry.in_dim == 4:
            geometry = moment(geometry, 0.0)  # colours are transported from there
        trained_level = chosen_level(geometry, file, level)
        cloud = read_colors(source, samples=config.samples, seed=config.seed, columns=config.columns)
        assert cloud.colors is not None
        weights = (tensor.detach().cpu().numpy() for _, tensor in sorted(geometry.state_dict().items()))
        fingerprint = digest_of((cloud.points, cloud.colors, *weights))
        if before.get("fingerprint", fingerprint) != fingerprint:
            raise InputError(
                f"{source}: not the colours, or {file} not the field, that the interrupted training began with; "
                "resume with those, or leave out --resume"
            )
        about = {"config": dataclasses.asdict(config), "level": level, "fingerprint": fingerprint}
        keep = functools.partial(save_state, state_file, progress=about)
        budget = Budget(config.time_budget, started=started)
        training = _Texturing(geometry, cloud, config, similarity, trained_level, budget, progress or silent, keep)
        training.trainer_state = tensors
        fitted = training.run()
        content = texture_bytes(fitted.texture, metadata={"texture": fitted.record})
        finished = bool(fitted.record["finished"])
        if beside:
            write_texture(file.parent, content, fitted.record, finished=finished)
        else:
            write_whole(target, content)
            if finished:
                state_file.unlink(missing_ok=True)
        return dataclasses.replace(fitted, directory=target.parent)


def _thinned(cloud: PointCloud, share: float, seed: int) -> PointCloud:
    """That share of the points, but at least `FEWEST_COLORED`, drawn by the seed."""
    count = min(len(cloud), max(int(share * len(cloud)), FEWEST_COLORED))
    return select(cloud, np.sort(np.random.default_rng(seed).permutation(len(cloud))[:count]))


def texture_of(run: str | Path, geometry: Field) -> TextureField | None:
    """The texture that lies beside the field of a run, or None; ``geometry`` is that field.

    Raises:
        InputError: there is no such run, or its texture is damaged or belongs to another field.
    """
    path = find_field(run).with_name(TEXTURE_FILE)
    return load_texture(path, geometry) if path.is_file() else None


def default_delta(geometry: Field) -> float:
    """The band that holds the surfaces of all levels, in units of the field."""
    if geometry.num_levels == 1:
        return 0.05  # it has no band of its own that says how near it is to its points
    return max(LEAST_DELTA, float(geometry.deltas.max()))


class TextureObjective(Objective):
    """The paper's 𝒯(φ): the colours at points, and none of their change along ∇f, of a band of half-width ``delta``."""

    def __init__(
        self,
        network: ColorSiren,
        samples: ColorSamples,
        band: BandSamples,
        config: TextureConfig,
        *,
        delta: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__(network, siren_groups(network, config.learning_rate, config.turn), generator)
        self.colors, self.samples, self.band, self.config, self.delta = network, samples, band, config, delta

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        here = self._draw(self.samples.points, self.config.batch)
        there = self._draw(self.band.points, self.config.band_batch)
        color = color_loss(self.colors.value(self.samples.points[here]), self.samples.colors[here]).mean()
        _, along = self.colors.derivative_along(self.band.points[there], self.band.gradients[there])
        tangential = tangential_loss(along, self.delta).mean()
        return {"color": color, "tangential": tangential}, color + self.config.tangential_weight * tangential

    def _draw(self, pool: Tensor, count: int) -> Tensor:
        return upload(torch.randint(len(pool), (count,), generator=self.generator), pool.device)


@torch.no_grad()
def _psnr(network: ColorSiren, samples: ColorSamples, generator: torch.Generator) -> float:
    """Peak signal-to-noise ratio of the colours at points that were trained on, in dB."""
    index = torch.randperm(len(samples.points), generator=generator)[:100_000].to(samples.points.device)
    error = color_loss(network.value(samples.points[index]).clamp(0, 1), samples.colors[index]).mean()
    return round(-10 * math.log10(max(float(error), 1e-12)), 3)
