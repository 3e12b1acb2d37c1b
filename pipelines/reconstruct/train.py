"""``reconstruct``: from posed photographs to a surface with colours, by volume rendering (NeuS) of a multiscale SDF."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...datasets import PointCloud
from ...datasets.views.formats.shots import DepthSource
from ...datasets.views.images import PosedImage, PosedImages, read_posed_images
from ...neural_fields import Field, InputError, Jet, NoSurfaceError, TextureField, extract_mesh
from ...neural_fields.backend.devices import choose_device
from ...neural_fields.checkpoint import radiance_bytes, texture_bytes
from ..render.picture import picture_bytes
from ..surface.surface import in_region, sample_points, thinned
from ..texture.train import FittedTexture, fit_texture, texture_step_seconds
from ..training.folder import RADIANCE_FILE, SUPPORT_FILE, TEXTURE_FILE, RunFolder, digest_of
from ..training.progress import Progress, Report, reported, silent
from ..training.result import Run
from ..training.scaffold import BUDGET, Budget, Training
from ..training.settings import ReconstructConfig, TextureConfig
from ..training.trainer import Interrupted, load_compiler, parameter_count, stop_on_signals
from .consistency import GreyPictures
from .hull import Agreement, begin
from .measured import MeasuredDepths
from .model import RayPool, SceneModel, build_scene
from .objective import GraphTrainer, scene_trainer
from .views import (
    MaskedCamera,
    ViewImage,
    comparison_sheet,
    exposed_as,
    held_out,
    measure,
    reduced,
    render_camera,
    spread,
    visible_points,
)

HELD_OUT_FILE = "held_out.png"
MESH_FILE = "mesh.ply"  # that the command makes of a finished run


@dataclass(frozen=True)
class FinishOptions:
    """Held-out views, the texture, and what of a time budget is kept for the end."""

    sheet_views: int = 4  # rows of the sheet of held-out views
    texture_resolution: int = 128  # of the mesh whose points are coloured: finer than the texture's band is wide
    texture_samples: int = 100_000  # points on it
    batch: int = 1 << 13  # points that are coloured at a time
    least_views: int = 3  # cameras that decide the colour of a point, at least
    most_views: int = 9  # the same at most
    facing: float = 0.5  # cosine within which they face it
    darker: float = 0.25  # which of their colours it is, as a quantile from dark to light
    after_share: float = 0.15  # share of a time budget for held-out views and the texture, at most
    surface_share: float = 0.5  # the same for what photographs see of the surface, and its meshes
    timed_pixels: int = 1024  # of the picture by which its time is estimated
    timed_resolution: int = 32  # of the mesh by which the time of meshes is estimated, whose cost grows with its square
    mesh_resolution: int = 256  # of the mesh that the command makes of a finished run
    traced_views: int = 30  # views whose cost `visible_points` does not exceed
    texture_factor: float = 2.0  # time of the texture, surface and samples included, over that of its steps


FINISH = FinishOptions()


@dataclass(frozen=True)
class Reconstruction(Run[Field]):
    """A finished reconstruction; its field is the geometry of the model.

    Attributes:
        model: geometry, colour and background, on the CPU.
        texture: the colours of the surface as a field, or None.
        images: what it was trained on, and held-out views.
    """

    model: SceneModel
    texture: TextureField | None
    images: PosedImages


def reconstruct(
    data: str | Path | PosedImages,
    config: ReconstructConfig | None = None,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> Reconstruction:
    """Train geometry and colour on posed photographs.

    Args:
        data: a data set (see `read_posed_images`), or images in memory.
        config: settings; the defaults are those of the ``default`` preset.
        out: run directory for field, texture, pictures, checkpoints and ``run.json``; None writes nothing.
        resume: continue the interrupted run in ``out`` with its own settings; ``config`` is then ignored.
        progress: called now and then with how far the training is.

    Raises:
        InputError: the data cannot be read or used, or there is nothing to resume.
        Interrupted: Ctrl-C or SIGTERM; ``out`` then holds a checkpoint and a usable field.

    Example:
        >>> run = reconstruct("data/dtu_scan24")  # doctest: +SKIP
        >>> run.record["held_out"]["psnr"]  # doctest: +SKIP
    """
    started, folder = time.monotonic(), RunFolder(out, resume=resume)
    config = folder.config(ReconstructConfig, config)
    choose_device(config.device)  # refused before the pictures are read
    budget = Budget(config.time_budget, started=started)
    with reported(progress, "reading the pictures"):
        maps = None if config.depth_maps is None else Path(config.depth_maps)
        depths = DepthSource(maps, config.depth_kind, config.depth_scale)
        images = data
        if not isinstance(images, PosedImages):
            images = read_posed_images(images, width=config.width, depths=depths, allow_missing=config.allow_missing)
    load_compiler()
    training = _Reconstruction(images, config, folder, progress or silent, budget, resume=resume)
    with folder.writing(HELD_OUT_FILE, MESH_FILE):
        if resume:
            training.restore()
        return training.run()


def _pixels(view: PosedImage) -> int:
    return view.camera.height * view.camera.width


class _Reconstruction(Training[ReconstructConfig, Field]):
    """One reconstruction under way."""

    def __init__(
        self,
        images: PosedImages,
        config: ReconstructConfig,
        folder: RunFolder,
        report: Report,
        budget: Budget,
        *,
        resume: bool,
    ) -> None:
        super().__init__(config, folder, budget, report)
        self.images, self.similarity, device = images, images.similarity, self.device
        self.train_views, self.test_views = held_out(images.views, config.test_every)
        has_masks = all(view.mask is not None for view in self.train_views)
        agreement = Agreement.of(self.train_views, images.similarity) if has_masks else None
        self.odd = agreement.outliers() if agreement else []
        if agreement:
            agreement = agreement.without(self.odd)
            self.train_views = [*agreement.views]
        self.model = build_scene(config, has_masks=has_masks, views=len(self.train_views)).to(device)
        whole = self.model.outside is not None
        self.holes = agreement.holes() if agreement else {}
        pool = RayPool(self.train_views, images.similarity, device, whole=whole, left_out=self.holes)
        measured = MeasuredDepths(self.train_views, images, device, seed=config.seed) if config.depth_weight else None
        self.measured = measured or None
        with reported(report, "initial surface"):
            self.start = (
                "sphere" if resume else begin(self.model, self.train_views, images, config, self.measured, agreement)
            )
        pictures = GreyPictures(self.train_views, device) if config.consistency else None
        self.trainer = scene_trainer(self.model, pool, config, measured=self.measured, pictures=pictures)
        # Of the training pixels, their masks, the cameras and what was measured.
        inputs = [pool.colors, pool.eyes, pool.axes, pool.lens, *([] if pool.masks is None else [pool.masks])]
        if self.measured is not None:
            inputs += [self.measured.along, self.measured.numbers]
        self.fingerprint = digest_of(tensor.cpu().numpy() for tensor in inputs)
        self.reserved = 0.0  # seconds of the time budget for the surface, which comes after the training

    def training_seconds(self) -> float | None:
        """How long the training may take within the time budget: all but what comes after it.

        The surface's part of that cannot be shortened; held-out views and the texture can.
        """
        if (left := self.budget.left()) is None:
            return None
        self.reserved = min(self.surface_seconds(), FINISH.surface_share * left)
        after = min(self.picture_seconds(left), FINISH.after_share * left)
        return max((self.left() or 0.0) - after, BUDGET.least_seconds) + self.elapsed

    def left(self) -> float | None:
        """Seconds left but for the surface; None without a budget."""
        left = self.budget.left()
        return None if left is None else max(left - self.reserved, 0.0)

    def picture_seconds(self, left: float) -> float:
        """Seconds for the held-out views and the texture, from the time of a small picture and a few steps."""
        seconds = 0.0
        if self.test_views:
            seconds += self._pixel_seconds() * sum(map(_pixels, self.test_views))
        if self.config.texture_steps:
            step = texture_step_seconds(texture_settings(self.config), self.device, left)
            seconds += FINISH.texture_factor * self.config.texture_steps * step
        return seconds

    def _pixel_seconds(self) -> float:
        """Seconds for a pixel of a held-out view, at the finest level, from a small picture."""
        started, small = time.monotonic(), reduced(self.test_views[0], FINISH.timed_pixels)
        self._image(small)
        return (time.monotonic() - started) / _pixels(small)

    def surface_seconds(self) -> float:
        """Seconds for the visibility test and for the meshes, measured on one view and a coarse mesh."""
        started = time.monotonic()
        visible_points(self.model.geometry, self._masked_cameras()[:1])
        traced = time.monotonic()
        with suppress(NoSurfaceError):
            extract_mesh(self.model.geometry, resolution=FINISH.timed_resolution)
        meshed = time.monotonic() - traced
        cells = FINISH.mesh_resolution**2 + FINISH.texture_resolution**2 * bool(self.config.texture_steps)
        views = min(len(self.train_views), FINISH.traced_views)
        return (traced - started) * views + meshed * cells / FINISH.timed_resolution**2

    def _masked_cameras(self) -> list[MaskedCamera]:
        """The cameras that were trained on, in unit-sphere coordinates, and their masks."""
        return [(view.camera.moved(self.similarity), view.mask_bytes) for view in self.train_views]

    def run(self) -> Reconstruction:
        """Train to the end, measure, colour, write."""
        with stop_on_signals() as flag:
            self.trainer.seconds = self.training_seconds()
            if not self.take_steps(self.trainer, flag, lambda: self.model.geometry, self.report):
                raise Interrupted(self.folder.out)
            # What was trained is safe before pictures and texture are made, which may be interrupted or fail too.
            self.save(self.model.geometry, self.trainer)
        self.model.requires_grad_(False)
        return self._finish()

    def _finish(self) -> Reconstruction:
        """Measure, colour, write."""
        pairs = self._render_held_out()
        record = self.record(finished=True) | {"held_out": self._figures(pairs)}
        with reported(self.report, "visible surface"):
            points, within = visible_points(self.model.geometry, self._masked_cameras())
            if len(points):
                self.folder.keep_tensors(SUPPORT_FILE, thinned(points.numpy(), visible_within=within))
        self.model.cpu()
        texture, record["texture"] = self._texture()
        if texture is not None:
            self.folder.keep(TEXTURE_FILE, texture_bytes(texture, metadata={"texture": record["texture"]}))
        about = {name: getattr(self.config, name) for name in ("uniform", "importance", "march_grid")}
        content = radiance_bytes(self.model.radiance(), self.model.geometry, metadata={"sampling": about})
        self.folder.keep(RADIANCE_FILE, content)
        if pairs:
            sheet = comparison_sheet(pairs[: FINISH.sheet_views], self.model.background)
            self.folder.keep(HELD_OUT_FILE, picture_bytes(sheet))
        record = self.folder.finish(self.model.geometry, self.images.similarity, record)
        model, images = self.model.cpu(), self.images
        return Reconstruction(model.geometry, images.similarity, self.folder.out, record, model, texture, images)

    def _image(self, view: PosedImage) -> ViewImage:
        """A view as all levels show it."""
        objective, camera = self.trainer.objective, view.camera.moved(self.similarity)
        image = render_camera(self.model, camera, objective.sampling, sdf_grid=objective.grid)
        # The exposure of a view that is not trained on is unknown.
        return image if self.model.exposures is None else exposed_as(image, view, self.model.background)

    def _render_held_out(self) -> list[tuple[PosedImage, ViewImage]]:
        """The held-out views and their pictures: smaller ones, where those of full size exceed a time budget."""
        pairs, views, limit = [], spread(self.test_views), self.left()
        if self.trainer.objective.grid is not None:
            self.trainer.objective.grid.refresh(self.model.geometry)
        if views and limit is not None:
            # Fewer views, not smaller ones: rays have no width, and a pixel of a smaller picture is a mean.
            room = limit / (2 if self.config.texture_steps else 1) / self._pixel_seconds()  # half is for a texture
            most = int(np.searchsorted(np.cumsum([*map(_pixels, views)]), room, side="right"))
            if most < len(views):
                views = views[:most] or [reduced(views[0], max(int(room), FINISH.timed_pixels))]
                held, camera = len(self.test_views), views[0].camera
                size = f"{camera.width} × {camera.height} pixels"
                self.budget.notes.append(f"{len(views)} of {held} held-out views are measured, at {size}")
        for index, view in enumerate(views):
            self.report(Progress("held-out views", index, len(views), index / len(views), {}))
            pairs.append((view, self._image(view)))
        if views:
            self.report(Progress("held-out views", len(views), len(views), 1.0, {}))
        return pairs

    def _figures(self, pairs: Sequence[tuple[PosedImage, ViewImage]]) -> dict[str, Any] | None:
        """Means over the held-out views, and each one's figures; None without such views."""
        if not pairs:
            return None
        views = {view.name: measure(image, view, self.model.background) for view, image in pairs}
        names = sorted({name for figures in views.values() for name in figures})
        means = {
            name: float(np.mean([figures[name] for figures in views.values() if name in figures])) for name in names
        }
        return means | {"views": views}

    def _texture(self) -> tuple[TextureField | None, dict[str, Any] | None]:
        if self.config.texture_steps == 0:
            return None, None
        try:
            fitted = scene_texture(self.model, self.images, self.config, progress=self.report, seconds=self.left())
        except NoSurfaceError as error:
            raise InputError(
                f"{self.images.source}: the training found no surface ({error}); see `mplicits check-cameras`, "
                "and train longer (--steps)"
            ) from error
        if not fitted.record["finished"]:
            raise Interrupted(self.folder.out)
        return fitted.texture, fitted.record

    def kept(self) -> dict[str, Any]:
        """See `Training.kept`."""
        return {"losses": self.trainer.losses, "start": self.start}

    def restore(self) -> None:
        """Take up an interrupted run."""
        mismatch = f"{self.images.source}: not the pictures that {self.folder.path} was trained on; resume with those"
        _, progress = self.restored(mismatch)
        self.start = progress.get("start", self.start)
        self.trainer.losses = progress["losses"]

    def _by_view(self, names: tuple[str, str], found: tuple[Tensor, Tensor]) -> dict[str, dict[str, list[float]]]:
        """What was learnt of each photograph, three numbers each."""
        rows = [part.detach().cpu().double().numpy().round(5).tolist() for part in found]
        views = [view.name for view in self.train_views]
        return {view: {name: row[k] for name, row in zip(names, rows, strict=True)} for k, view in enumerate(views)}

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        model, trainer = self.model, self.trainer
        parts = {"geometry": model.geometry, "color": model.color}
        left_out = {self.train_views[index].name: int(hole.sum()) for index, hole in self.holes.items()}
        return {
            "data": str(self.images.source),
            "reading": self.images.reading,
            "views": {"trained": len(self.train_views), "held_out": len(self.test_views)},
            "region": self.images.region,
            "start": self.start,
            **self.common_record(finished=finished),
            "parameters": {name: parameter_count(part) for name, part in parts.items()},
            "deltas": model.geometry.deltas.tolist(),
            **({} if model.exposures is None else {"exposures": self._by_view(("gain", "offset"), model.exposures())}),
            **({"left_out": [view.name for view in self.odd]} if self.odd else {}),
            **({"mask_holes": left_out} if left_out else {}),
            **({} if self.measured is None else {"measured_depths": len(self.measured)}),
            **({} if model.poses is None else {"poses": self._by_view(("turn", "shift"), model.poses())}),
            "inv_std": float(model.inv_std.detach()),
            "steps": trainer.step,
            "training_seconds": round(trainer.elapsed, 3),
            **({"replayed": trainer.facts()} if isinstance(trainer, GraphTrainer) else {}),
            "losses": trainer.losses,
        }


@torch.no_grad()
def surface_colors(model: SceneModel, points: Tensor, eyes: Tensor) -> Tensor:
    """Colours ``(N, 3)`` of points ``(N, 3)`` near the surface, as cameras at ``eyes`` ``(V, 3)`` see them.

    The lower quartile, for each channel, of what up to nine cameras see whose rays are within 60° of the normal: a
    highlight, which up to half of them may see, only adds light. Where fewer than three face it, the colour along the
    normal. All in unit-sphere coordinates; the first eyes should be all around.
    """
    parts = []
    for part in points.split(FINISH.batch):
        jet: Jet = model.geometry.jet(part)
        normal = torch.nn.functional.normalize(jet.gradient, dim=-1)
        along = torch.nn.functional.normalize(part[:, None] - eyes, dim=-1)  # (B, V, 3)
        facing = -(along * normal[:, None]).sum(dim=-1) >= FINISH.facing
        # The first of the cameras that face a point: they count the more, the earlier they come.
        count = min(FINISH.most_views, len(eyes))
        ranks, chosen = (torch.arange(len(eyes), 0, -1, device=part.device) * facing).topk(count, dim=1)
        directions = along.gather(1, chosen[:, :, None].expand(-1, -1, 3))
        row, view = (ranks > 0).nonzero(as_tuple=True)
        colors = part.new_full((len(part), count, 3), torch.nan)
        colors[row, view] = model.color(part[row], directions[row, view], Jet(*(held[row] for held in jet)))
        ahead = model.color(part, -normal, jet)
        enough = (ranks > 0).sum(dim=1, keepdim=True) >= FINISH.least_views
        parts.append(torch.where(enough, colors.nanquantile(FINISH.darker, dim=1), ahead))
    return torch.cat(parts)


def scene_texture(
    model: SceneModel,
    images: PosedImages,
    config: ReconstructConfig,
    *,
    progress: Report | None = None,
    seconds: float | None = None,
) -> FittedTexture:
    """Train a `TextureField` on the colours of a scene's surface, see `surface_colors`, within ``seconds``.

    Raises:
        NoSurfaceError: the geometry has no surface.
    """
    started = time.monotonic()
    with reported(progress, "texture: surface"):
        mesh = in_region(extract_mesh(model.geometry, resolution=FINISH.texture_resolution))
        if mesh is None:
            raise NoSurfaceError("all of it is outside the region of interest")
        points, _ = sample_points(mesh, FINISH.texture_samples, np.random.default_rng(config.seed))
        random = np.random.default_rng(config.seed)
        eyes = np.stack([view.camera.eye.numpy() for view in images.views])[random.permutation(len(images.views))]
        seen_from = torch.from_numpy(images.similarity.to_unit(eyes)).float()
        colors = surface_colors(model, torch.from_numpy(points).float(), seen_from).numpy()
        cloud = PointCloud(images.similarity.to_input(points), colors=colors, source=str(images.source))
    settings = texture_settings(config)
    if seconds is not None:
        settings = dataclasses.replace(settings, time_budget=max(seconds, BUDGET.least_seconds))
    return fit_texture(
        model.geometry, cloud, settings, similarity=images.similarity, progress=progress, started=started
    )


def texture_settings(config: ReconstructConfig) -> TextureConfig:
    """Settings of the texture that a reconstruction ends with; one step of it, where there is none."""
    return TextureConfig(
        steps=max(config.texture_steps, 1), samples=FINISH.texture_samples, seed=config.seed, device=config.device
    )
