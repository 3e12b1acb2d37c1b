"""Multi-view consistency: patches of neighbouring photographs, warped by the surface's tangent planes, correlate.

Two photographs that show the same texture place a surface to a fraction of a pixel. A pixel's surface point and normal
give a tangent plane. If it is right, its homography maps the patch around the pixel onto the same patch of a neighbour.
Sources: Goesele et al. 2007; for neural surfaces Fu et al., "Geo-Neus", 2022.

Where photographs are plain nothing places a surface. There it shall be flat, see `flatness_loss`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...datasets.views.images import PosedImage
from ...neural_fields.backend.devices import few_numbers, uniform
from ...neural_fields.fields.field import FieldLike, as_field
from ...neural_fields.fields.losses import pseudo_huber
from ...neural_fields.volume.render import Rendered


@dataclass(frozen=True)
class ConsistencyOptions:
    """How patches are chosen and compared. The values are this project's own, by experiment."""

    start: float = 0.25  # share of the training after which the term counts: the surface exists by then
    patches: int = 96  # pixels per step whose patches are compared, at most
    reach: int = 3  # pixels of a patch on each side of its middle: 7 × 7
    neighbours: int = 6  # photographs that a patch is compared with
    best: int = 3  # of them that count, at most: others may show something in between
    least_angle: float = 5.0  # degrees between the lines of sight of two photographs
    usual_angle: float = 12.0  # the nearest to this are taken
    most_angle: float = 25.0
    facing: float = 0.3  # cosine between the normal and a line of sight, at least
    texture: float = 0.02  # standard deviation of a patch's grey values in [0, 1], at least
    floor: float = 0.3  # correlation below which two patches show different things
    residual: float = 0.002  # error of a surface point between two samples, at most, in radii of the region
    clearance: float = 0.04  # from which on a ray to a neighbour is tested for occlusion, in radii of the region
    marches: int = 10  # steps of that test
    stride: float = 0.02  # least length of a step, in radii of the region
    flatness: float = 0.2  # weight of `flatness_loss` over that of `consistency_loss`
    nearest: float = 0.02  # from a surface point to where it is compared with the tangent plane, in radii of the region
    furthest: float = 0.3  # the same at most
    plain: float = 0.02  # standard deviation of grey values in [0, 1] that are alike
    bend: float = 0.05  # changes of slope below which errors count by their squares


class Surface(NamedTuple):
    """Surface points on rays, differentiable in the parameters of the field and in the rays."""

    position: Tensor  # (R, 3)
    normal: Tensor  # (R, 3) unit vectors
    found: Tensor  # (R,) bool


class Cameras(NamedTuple):
    """Pinholes in unit-sphere coordinates."""

    eyes: Tensor  # (V, 3)
    axes: Tensor  # (V, 3, 3) columns are right, down and forward
    lens: Tensor  # (V, 4) fx, fy, cx, cy in pixels


class Pixels(NamedTuple):
    """Pixels of photographs: numbers of the pictures ``(R,)`` int64, and columns and rows ``(R, 2)`` int64."""

    view: Tensor
    place: Tensor


class GreyPictures:
    """Grey values and masks ``(V, H, W)`` of photographs in 8 bits, padded to one size; masks are full without one."""

    def __init__(self, views: Sequence[PosedImage], device: torch.device) -> None:
        self.sizes = torch.tensor([[view.camera.width, view.camera.height] for view in views], device=device)
        grey, masks = np.zeros((2, len(views), *self.sizes.amax(dim=0).tolist()[::-1]), np.uint8)
        for index, view in enumerate(views):
            part = (index, slice(view.camera.height), slice(view.camera.width))
            grey[part] = np.rint(view.color_bytes.mean(axis=2, dtype=np.float32))
            masks[part] = 255 if view.mask_bytes is None else view.mask_bytes
        self.grey, self.masks = torch.from_numpy(grey).to(device), torch.from_numpy(masks).to(device)

    def contains(self, view: Tensor, pixels: Tensor, margin: float = 0.0) -> Tensor:
        """Which pixels ``(..., 2)`` lie in pictures ``(...,)``, at least ``margin`` from the middles of the border."""
        return ((pixels >= margin) & (pixels <= self.sizes[view] - 1 - margin)).all(dim=-1)

    def at(self, view: Tensor, pixels: Tensor) -> Tensor:
        """Grey values ``(...,)`` at pixels ``(..., 2)`` of pictures ``(...,)``, bilinear; differentiable in pixels."""
        place = torch.minimum(pixels.nan_to_num().clamp(min=0), (self.sizes[view] - 1).to(pixels))
        first = place.detach().long()
        (x, y), (u, v) = first.unbind(dim=-1), (place - first).unbind(dim=-1)
        below, right = ((at + 1).clamp(max=size - 1) for at, size in zip((y, x), self.grey.shape[1:], strict=True))
        rows = ([self.grey[view, row, column].to(pixels) for column in (x, right)] for row in (y, below))
        upper, lower = (torch.lerp(one, other, u) for one, other in rows)
        return torch.lerp(upper, lower, v) / 255

    def weights(self, view: Tensor, pixels: Tensor) -> Tensor:
        """The share of object ``(...,)`` at pixels ``(..., 2)`` int64 within pictures ``(...,)``; 1 without masks."""
        x, y = torch.minimum(pixels.clamp(min=0), self.sizes[view] - 1).unbind(dim=-1)
        return self.masks[view, y, x] / 255


def surface_between(rendered: Rendered, origins: Tensor, directions: Tensor, options: ConsistencyOptions) -> Surface:
    """Where rays ``(R, 3)`` first enter, by linear interpolation between two rendered samples; no field is evaluated.

    With values f₀ > 0 > f₁ at depths t₀ and t₁ it is t = (f₀ t₁ − f₁ t₀) / (f₀ − f₁). Gradients are interpolated
    alike. With slopes s along the ray, f is wrong there by up to (t₁ − t₀) |s₁ − s₀| / 8 where f'' is constant.
    """
    values, gradients, _ = rendered.jet
    enters = (values[:, :-1] > 0) & (values[:, 1:] < 0)  # of skipped samples values are 0
    found, outer = enters.any(dim=1), enters.int().argmax(dim=1, keepdim=True)
    pair = torch.cat((outer, outer + 1), dim=1)  # (R, 2)
    depth = rendered.depths.gather(1, pair)
    before, after = values.gather(1, pair).unbind(dim=1)
    gradient = gradients.gather(1, pair[:, :, None].expand(-1, -1, 3))
    share = (before / torch.where(found, before - after, 1.0))[:, None]
    position = origins + torch.lerp(depth[:, :1], depth[:, 1:], share) * directions
    normal = torch.lerp(gradient[:, 0], gradient[:, 1], share)
    normal = torch.where(found[:, None], normal, -directions)  # any that faces the eye, so that derivatives are finite
    with torch.no_grad():
        length = normal.norm(dim=1)
        bend = (gradient @ directions[:, :, None])[..., 0].diff(dim=1) * depth.diff(dim=1) / 8
        sure = (bend.abs()[:, 0] < options.residual * length) & (position.norm(dim=1) < 1)
        facing = (normal * directions).sum(dim=1) < -options.facing * length
    return Surface(position, torch.nn.functional.normalize(normal, dim=1), found & sure & facing)


@torch.no_grad()
def choose_neighbours(
    surface: Surface,
    view: Tensor,
    cameras: Cameras,
    pictures: GreyPictures,
    distance: Callable[[Tensor], Tensor],
    options: ConsistencyOptions,
) -> tuple[Tensor, Tensor]:
    """Photographs ``(R, K)`` that a patch around each surface point is compared with, and a mask of those that see it.

    They see the point from another direction than the photograph ``view`` ``(R,)``, by 5° to 25°; those nearest to 12°
    are taken. ``distance`` is a signed distance, for example a `ValueGrid`, along which rays to them are marched.
    """
    away = cameras.eyes - surface.position[:, None]  # (R, V, 3)
    towards = torch.nn.functional.normalize(away, dim=2)
    own = towards.gather(1, view[:, None, None].expand(-1, 1, 3))
    angle = torch.rad2deg((towards * own).sum(dim=2).clamp(-1, 1).acos())
    pixels, ahead = _projected(surface.position[:, None], cameras)
    every = torch.arange(len(cameras.eyes), device=view.device).expand_as(angle)
    fit = (angle >= options.least_angle) & (angle <= options.most_angle) & (ahead > 0)
    fit &= ((towards * surface.normal[:, None]).sum(dim=2) > options.facing) & surface.found[:, None]
    fit &= pictures.contains(every, pixels, options.reach)
    rank = torch.where(fit, (angle - options.usual_angle).abs(), math.inf)
    rank, chosen = rank.topk(min(options.neighbours, rank.shape[1]), dim=1, largest=False)
    visible = rank < math.inf
    along = towards.gather(1, chosen[:, :, None].expand(-1, -1, 3))
    reached = torch.full_like(rank, options.clearance)
    for _ in range(options.marches):
        value = distance(surface.position[:, None] + reached[..., None] * along)
        visible &= value > 0
        reached = reached + value.clamp(min=options.stride)
    return chosen, visible


def _projected(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Pixels ``(R, V, 2)`` and depths ``(R, V)`` of points ``(R, 1, 3)`` in all cameras, or ``(R, V, 3)`` in one."""
    seen = torch.einsum("...i,...ij->...j", points - cameras.eyes, cameras.axes)
    depth = seen[..., 2]
    slopes = seen[..., :2] / torch.where(depth > 0, depth, 1.0)[..., None]
    return slopes * cameras.lens[..., :2] + cameras.lens[..., 2:], depth


def warp(surface: Surface, pixels: Pixels, offsets: Tensor, neighbours: Tensor, cameras: Cameras) -> Tensor:
    """Where patches fall in other photographs if the surface is its tangent plane: ``(R, K, P, 2)`` pixels.

    The patch of a pixel is itself plus ``offsets`` ``(P, 2)``; ``neighbours`` are ``(R, K)`` numbers of pictures. With
    the point X and the normal n in the camera's axes, the homography is K' (R' + t' nᵀ / ⟨n, X⟩) K⁻¹. See Hartley and
    Zisserman 2003, Eq. 13.2.
    """
    eyes, axes, lens = (part[pixels.view] for part in cameras)
    lines = (pixels.place[:, None] + offsets - lens[:, None, 2:]) / lens[:, None, :2]  # (R, P, 2)
    lines = torch.cat((lines, torch.ones_like(lines[..., :1])), dim=2)
    normal = torch.einsum("ri,rij->rj", surface.normal, axes)
    place = torch.einsum("ri,rij->rj", surface.position - eyes, axes)
    height = (normal * place).sum(dim=1, keepdim=True)
    there = cameras.axes[neighbours]  # (R, K, 3, 3)
    turn = torch.einsum("rkij,ril->rkjl", there, axes)
    shift = torch.einsum("rkij,rki->rkj", there, eyes[:, None] - cameras.eyes[neighbours])
    plane = turn + shift[..., None] * (normal / height)[:, None, None]
    seen = torch.einsum("rkij,rpj->rkpi", plane, lines)
    depth = seen[..., 2:]
    lens = cameras.lens[neighbours][:, :, None]
    return seen[..., :2] / torch.where(depth > 1e-3, depth, 1.0) * lens[..., :2] + lens[..., 2:]


def correlation(first: Tensor, second: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised cross-correlation of patches ``(..., P)`` with ``weights``, and the smaller standard deviation."""
    weights = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-6)

    def moment(a: Tensor, b: Tensor) -> Tensor:
        return (weights * a * b).sum(dim=-1)

    a, b = (patch - (weights * patch).sum(dim=-1, keepdim=True) for patch in (first, second))
    # A patch without texture counts nothing; the bound keeps its derivatives finite.
    variances = [moment(patch, patch).clamp(min=1e-8) for patch in (a, b)]
    return moment(a, b) / (variances[0] * variances[1]).sqrt(), torch.minimum(*variances).detach().sqrt()


def consistency_loss(
    surface: Surface,
    pixels: Pixels,
    cameras: Cameras,
    pictures: GreyPictures,
    distance: Callable[[Tensor], Tensor],
    options: ConsistencyOptions,
) -> Tensor:
    """Σ (1 − NCC) / n of the n best neighbours of each pixel ``(R,)``; what does not count adds 0.

    A neighbour counts that sees the point (see `choose_neighbours`), holds the whole patch, has texture there, and
    whose correlation is not below the floor. With masks, pixels of a patch weigh as much as they are object.
    """
    span = torch.arange(-options.reach, options.reach + 1, device=pixels.view.device)
    offsets = torch.cartesian_prod(span, span)
    chosen, visible = choose_neighbours(surface, pixels.view, cameras, pictures, distance, options)
    own = pixels.place[:, None] + offsets
    view = pixels.view[:, None].expand(own.shape[:2])
    inside = pictures.contains(view, own).all(dim=1)
    patch, weights = pictures.at(view, own.to(surface.position)), pictures.weights(view, own)
    warped = warp(surface, pixels, offsets, chosen, cameras)
    there = chosen[:, :, None].expand(warped.shape[:3])
    alike, texture = correlation(patch[:, None], pictures.at(there, warped), weights[:, None])
    counts = visible & inside[:, None] & pictures.contains(there, warped.detach()).all(dim=2)
    counts &= (texture > options.texture) & (alike.detach() > options.floor)
    best, row = torch.where(counts, alike, -1.0).topk(min(options.best, alike.shape[1]), dim=1)
    return torch.where(counts.gather(1, row), 1 - best, 0.0).sum(dim=1) / best.shape[1]


def flatness_loss(
    field: FieldLike,
    surface: Surface,
    pixels: Pixels,
    cameras: Cameras,
    pictures: GreyPictures,
    options: ConsistencyOptions,
    generator: torch.Generator,
    *,
    level: int = -1,
) -> Tensor:
    """How the surface bends where its picture is plain ``(R,)``: √(b² + ε²) − ε of a change of slope b.

    b = (f(x + h t) + f(x − h t) − 2 f(x)) / h at each surface point x. Tangent t and length h are random. It counts as
    far as the photograph has one grey value at x, x ± h t / 2 and x ± h t. In texture and across edges it has not.
    """
    rows, device = len(pixels.view), pixels.view.device
    number, *aside = uniform((4, rows), generator, device).to(surface.position)
    length = options.nearest * (options.furthest / options.nearest) ** number
    middle, normal = surface.position.detach(), surface.normal.detach()
    across = torch.linalg.cross(normal, 2 * torch.stack(aside, dim=1) - 1)
    tangent = torch.nn.functional.normalize(across, dim=1)
    steps = few_numbers((-1.0, 0.0, 1.0, -0.5, 0.5), middle)
    places = middle[:, None] + (steps * length[:, None])[..., None] * tangent[:, None]
    with torch.no_grad():
        own = Cameras(*(part[pixels.view][:, None] for part in cameras))
        there, ahead = _projected(places, own)
        view = pixels.view[:, None].expand(ahead.shape)
        grey = pictures.at(view, there)
        alike = torch.exp(-((grey - grey[:, 1:2]) ** 2) / (2 * options.plain**2)) * pictures.contains(view, there)
        weight = (alike * pictures.weights(view, there.round().long()) * (ahead > 0)).prod(dim=1) * surface.found
    value = as_field(field).value(places[:, :3].reshape(-1, 3), level=level).reshape(rows, 3)
    bend = (value[:, 0] + value[:, 2] - 2 * value[:, 1]) / length
    return weight * pseudo_huber(bend.square() / (2 * options.bend), options.bend)
