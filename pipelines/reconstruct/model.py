"""What ``reconstruct`` learns, and from what: a scene of geometry, colours and uncertainty, and rays of pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ...datasets.cameras import Camera
from ...datasets.views.images import PosedImage
from ...neural_fields import Field, InputError, Jet, MultiscaleSDF, Similarity, Siren
from ...neural_fields.backend.devices import precise
from ...neural_fields.networks.colors import BackgroundField, ColorNetwork, Radiance
from ...neural_fields.networks.grids import HashEncoding
from ...neural_fields.networks.multiscale import fit_sphere
from ...neural_fields.networks.neus_mlp import NeusSDF
from ...neural_fields.volume.render import Rendered, Sampling, render_volume
from ..training.settings import ReconstructConfig
from ..training.trainer import ErrorWeightedSampler, seeded

# Kinds of devices on which matrix products of colours are in bfloat16.
HALF_PRECISION = ("cuda",)


class Exposures(nn.Module):
    """Brightness and white balance of each photograph: p = g_v c + o_v for each channel, g_v > 0.

    The geometric mean of all gains is 1 and the mean of all offsets 0, so that colours stay those of the usual
    photograph.
    """

    def __init__(self, views: int) -> None:
        super().__init__()
        self.logs, self.shifts = nn.Parameter(torch.zeros(views, 3)), nn.Parameter(torch.zeros(views, 3))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Gains and offsets, ``(V, 3)`` each."""
        return (self.logs - self.logs.mean(dim=0)).exp(), self.shifts - self.shifts.mean(dim=0)


class PoseCorrections(nn.Module):
    """Small rotations and shifts of the cameras: v → exp([ω_v]×) v for directions, o → o + t_v for eyes.

    The means of all ω and of all t are 0, so that the scene as a whole stays where it is (to the first order).
    """

    def __init__(self, views: int) -> None:
        super().__init__()
        self.turns, self.shifts = nn.Parameter(torch.zeros(views, 3)), nn.Parameter(torch.zeros(views, 3))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Rotation vectors ω in radians, and shifts in radii of the region, ``(V, 3)`` each."""
        return self.turns - self.turns.mean(dim=0), self.shifts - self.shifts.mean(dim=0)

    def moved(self, origins: Tensor, directions: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and directions ``(R, 3)`` of rays of the cameras with the numbers ``view`` ``(R,)``, corrected."""
        turns, shifts = self()
        # Rodrigues: v cos θ + (ω × v) sin θ / θ + ω ⟨ω, v⟩ (1 − cos θ) / θ², the last factor as half a sinc squared.
        # (PyTorch's exponential of matrices would make a GPU wait.) The root has a slope at 0, too.
        angle = (turns.square().sum(dim=1, keepdim=True) + 1e-20).sqrt()
        first, second = torch.sinc(angle / math.pi), 0.5 * torch.sinc(0.5 * angle / math.pi).square()
        turn, cosine, first, second, shift = (
            part.index_select(0, view) for part in (turns, angle.cos(), first, second, shifts)
        )
        along = (turn * directions).sum(dim=1, keepdim=True)
        turned = cosine * directions + first * torch.linalg.cross(turn, directions) + second * along * turn
        return origins + shift, turned


class SceneModel(nn.Module):
    """Everything that a pixel's colour depends on, in unit-sphere coordinates.

    ``outside`` is the background field, None without one; ``background`` ``(3,)`` is the colour behind everything.
    """

    def __init__(
        self,
        geometry: Field,
        color: ColorNetwork,
        outside: BackgroundField | None,
        background: Tensor,
        exposures: Exposures | None = None,
        poses: PoseCorrections | None = None,
    ) -> None:
        super().__init__()
        self.geometry, self.color, self.outside = geometry, color, outside
        self.exposures, self.poses = exposures, poses
        self.variance = nn.Parameter(torch.tensor(0.3))  # NeuS's, so that s begins at 20
        self.register_buffer("background", background)
        self.background: Tensor

    @classmethod
    def of(cls, geometry: Field, radiance: Radiance) -> SceneModel:
        """A scene that was trained, of its geometry and its `Radiance`."""
        model = cls(geometry, radiance.color, radiance.outside, radiance.background).to(radiance.background.device)
        with torch.no_grad():
            model.variance.fill_(math.log(radiance.inv_std) / 10)
        return model.requires_grad_(False)

    def radiance(self) -> Radiance:
        """The `Radiance` of the scene, without the exposures and poses of its photographs."""
        return Radiance(self.color, self.outside, self.background, float(self.inv_std.detach()))

    @property
    def inv_std(self) -> Tensor:
        """The s of NeuS, exp(10 v), 0-d: one learning rate serves v and the networks."""
        return (10 * self.variance).exp().clamp(max=1e6)

    def widen(self, band: float, least: float) -> None:
        """Make all bands ``band`` / s wide, but at least ``least``: as wide as the surface is unsure."""
        if len(self.geometry.deltas):
            inv_std = self.inv_std.detach()
            width = (band / inv_std.to(precise(inv_std.device))).clamp(min=least)
            self.geometry.deltas.copy_(width.expand_as(self.geometry.deltas))

    def photographed(self, rendered: Rendered, view: Tensor) -> Tensor:
        """Colours ``(R, 3)`` of rendered rays with the exposures of the photographs with numbers ``view`` ``(R,)``.

        A known background has the same colour in all photographs; a learnt one has their exposures too.
        """
        if self.exposures is None:
            return rendered.color
        gain, offset = (part.index_select(0, view) for part in self.exposures())
        if self.outside is not None:
            return gain * rendered.color + offset
        behind = (1 - rendered.opacity)[:, None] * self.background
        return gain * (rendered.color - behind) + rendered.opacity[:, None] * offset + behind

    def render(self, origins: Tensor, directions: Tensor, sampling: Sampling, **options: Any) -> Rendered:
        """`render_volume` of this scene, with its ``options``, and with colours in half precision on a GPU."""

        def color(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
            with torch.autocast(x.device.type, torch.bfloat16, enabled=x.device.type in HALF_PRECISION):
                return self.color(x, direction, jet).float()

        behind = {"background": self.background, "outside": self.outside}
        rays = (origins, directions)
        return render_volume(self.geometry, color, *rays, inv_std=self.inv_std, sampling=sampling, **behind, **options)


def build_scene(config: ReconstructConfig, *, has_masks: bool, views: int = 0) -> SceneModel:
    """An untrained scene: a sphere of unknown colour, with exposures and poses for ``views`` photographs."""
    background = config.background
    if background == "auto":
        background = "white" if has_masks else "outside"
    with seeded(config.seed):
        if config.geometry == "neus":
            geometry: Field = NeusSDF(radius=config.radius)
            features = 256
        else:
            features = config.features
            geometry = MultiscaleSDF.from_widths(
                list(zip(config.widths, config.depths, strict=True)),
                omegas=config.omegas,
                deltas=[config.radius] * (len(config.widths) - 1),
                taper=config.taper,
                num_features=features,
                residual_gain=0.01,
            )
            base = geometry.base
            assert isinstance(base, Siren)
            fit_sphere(base, config.radius)
        finest = config.color_grid
        color = ColorNetwork(
            features,
            width=config.color_width,
            depth=config.color_depth,
            point_frequencies=config.color_frequencies,
            grid=HashEncoding.up_to(finest) if finest else None,
        )
        outside = None
        if background == "outside" and finest:
            around = HashEncoding.up_to(finest, extent=2.0)
            outside = BackgroundField(width=64, depth=2, point_frequencies=4, grid=around)
        elif background == "outside":
            outside = BackgroundField()
    exposures = Exposures(views) if config.exposure == "affine" else None
    poses = PoseCorrections(views) if config.cameras == "refined" else None
    return SceneModel(geometry, color, outside, torch.full((3,), float(background == "white")), exposures, poses)


class Rays(NamedTuple):
    """Rays in unit-sphere coordinates, and what the pictures say about them."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3) unit vectors
    color: Tensor  # (R, 3) display RGB in [0, 1]
    mask: Tensor  # (R,) how much of the pixel is object; 1 everywhere without masks
    view: Tensor  # (R,) number of the picture
    row: Tensor  # (R,) number of the pixel in the pool


def meets_sphere(camera: Camera) -> NDArray[np.bool_]:
    """Which pixels ``(H, W)`` of a pinhole in unit-sphere coordinates have rays that meet the unit sphere.

    Those along l = (x, y, 1) from an eye e, both in the camera's axes, do if |e| < 1, or if ⟨e, l⟩ < 0 and
    ⟨e, l⟩² > (|e|² − 1) |l|².
    """
    fx, fy, cx, cy = camera.fx_fy_cx_cy
    x, y = (np.arange(camera.width) - cx) / fx, (np.arange(camera.height)[:, None] - cy) / fy
    right, down, forward = (camera.world_from_camera[:3, :3].T @ camera.eye).tolist()
    beyond = float(camera.eye.square().sum()) - 1
    along = right * x + (down * y + forward)
    return (beyond < 0) | ((along < 0) & (along * along > beyond * x * x + beyond * (y * y + 1)))


class RayPool:
    """The pixels whose rays meet the unit sphere; ``whole``: all of them, where what lies outside is learnt too.

    Of a view, by its number, pixels ``(H, W)`` are ``left_out``. Of each pixel only colour and mask are kept, in four
    bytes. Their places follow from those of the runs of consecutive pixels, and directions from the places.

    Raises:
        InputError: no ray of any picture meets the region of interest.
    """

    def __init__(
        self,
        views: Sequence[PosedImage],
        similarity: Similarity,
        device: torch.device,
        *,
        whole: bool = False,
        left_out: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        self.device, self.has_masks = device, all(view.mask is not None for view in views)
        cameras = [view.camera.moved(similarity) for view in views]
        self.eyes = torch.stack([camera.eye for camera in cameras]).float().to(device)
        self.axes = torch.stack([camera.world_from_camera[:3, :3] for camera in cameras]).float().to(device)
        lens = [camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras]
        self.lens = torch.stack(lens).float().to(device)  # (V, 4): fx, fy, cx, cy
        self.widths = torch.tensor([camera.width for camera in cameras], device=device)
        if not any(meets_sphere(camera).any() for camera in cameras):
            raise InputError("no pixel of any picture sees the region of interest; see `mplicits check-cameras`")
        runs = []
        for index, camera in enumerate(cameras):
            chosen = np.ones((camera.height, camera.width), bool) if whole else meets_sphere(camera)
            if left_out and index in left_out:
                chosen &= ~left_out[index]
            # The numbers of pixels from which on, and before which, pixels are chosen.
            runs.append(np.flatnonzero(np.diff(chosen.reshape(-1), prepend=False, append=False)).reshape(-1, 2))
        first, last = np.concatenate(runs).T
        ends = (last - first).cumsum()
        owners = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        # By run: how many pixels there are up to its end, the pixel's number less that in the pool, and the picture's.
        self.ends, self.offsets, self.owners = (
            torch.from_numpy(part).to(device) for part in (ends, last - ends, owners)
        )

        def joined(pictures: Iterable[NDArray[np.uint8] | None], *shape: int) -> Tensor:
            flat = (np.reshape(picture, (-1, *shape)) for picture in pictures if picture is not None)
            parts = [rows[start:end] for rows, run in zip(flat, runs, strict=True) for start, end in run]
            return torch.from_numpy(np.concatenate(parts)).to(device)

        self.colors = joined((view.color_bytes for view in views), 3)
        self.masks = joined(view.mask_bytes for view in views) if self.has_masks else None

    def __len__(self) -> int:
        return len(self.colors)

    def draw(self, count: int, generator: torch.Generator, sampler: ErrorWeightedSampler | None = None) -> Rays:
        """``count`` rays at random, with replacement; ``sampler`` chooses the pixels."""
        rows = (sampler or ErrorWeightedSampler(len(self), 0.0, self.device)).rows(count, generator)
        view, place = self.places(rows)
        fx, fy, cx, cy = self.lens[view].unbind(dim=1)
        x, y = place.unbind(dim=1)
        local = torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(fx)), dim=1)
        directions = torch.nn.functional.normalize(torch.einsum("rij,rj->ri", self.axes[view], local), dim=1)
        mask = torch.ones(len(rows), device=self.device) if self.masks is None else self.masks[rows] / 255
        return Rays(self.eyes[view], directions, self.colors[rows] / 255, mask, view, rows)

    def places(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Pictures ``(R,)`` of the pixels with these numbers ``(R,)``, and columns and rows ``(R, 2)``; all int64."""
        run = torch.searchsorted(self.ends, rows, right=True)
        view, pixel = self.owners[run], rows + self.offsets[run]
        width = self.widths[view]
        return view, torch.stack((pixel % width, pixel // width), dim=1)
