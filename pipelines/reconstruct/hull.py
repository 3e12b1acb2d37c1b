"""Silhouettes, the masks that contradict the others, and the start of the geometry: their visual hull on a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.views.images import OBJECT, PosedImage, PosedImages
from ...neural_fields import InputError, MultiscaleSDF, Similarity, Siren
from ...neural_fields.fields.losses import data_loss, eikonal_loss
from ...neural_fields.networks.grids import ValueGrid
from ...neural_fields.tracing.sphere import ball_points
from ...neural_fields.volume.weights import sphere_span
from ..training.settings import ReconstructConfig
from ..training.trainer import seeded
from .measured import MeasuredDepths
from .model import SceneModel


@dataclass(frozen=True)
class Limits:
    """When a silhouette is wrong; right ones of the synthetic scenes keep a third or more below each limit."""

    cells: int = 32  # along the grid on which silhouettes are compared
    agreed: float = 0.25  # share of the views that may contradict a point on which the views still agree
    # a view is wrong that contradicts more than this share of the points on which the others agree, or has more
    # than this share of its object outside of the visual hull
    wrong: float = 0.4
    most_wrong: float = 0.1  # share of the views that may be left out as wrong; of more, nothing says which ones are
    lone: float = 0.02  # a mask has a hole if it alone contradicts more than this share of the visual hull
    few: int = 20  # views from which one may have a hole: of fewer, each may carve much
    bare: float = 0.005  # share of the object, in the median view, that may lie outside of the visual hull
    sure: float = 0.05  # share of the views that may contradict a point of that hull


def grid_in_ball(resolution: int) -> tuple[Tensor, Tensor]:
    """Vertices of the unit ball ``(N, 3)`` float64, of a grid over [−1, 1]³, and their places in it ``(N,)``."""
    axis = torch.linspace(-1, 1, resolution + 1, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    places = (points.square().sum(dim=1) <= 1).nonzero()[:, 0]
    return points[places], places


def silhouette(view: PosedImage, similarity: Similarity, points: Tensor, edge: float) -> tuple[Tensor, Tensor]:
    """Which points ``(N, 3)`` a view sees, and which have object within half an ``edge``, ``(N,)`` each."""
    camera, mask = view.camera.moved(similarity), _object_in(view)
    cut = bool(_border(mask).any())
    mask = _widened(mask, camera, 0.5 * edge, edge)
    pixels, depth, inside = camera.in_view(points.numpy())
    column, row = np.rint(pixels[inside]).astype(np.int64).T
    objects = inside.copy()
    objects[inside] = mask[row, column]
    # What a picture does not show is no object, unless its rim cuts the object.
    return torch.from_numpy(inside if cut else depth > 0), torch.from_numpy(objects)


def _widened(mask: NDArray[np.bool_], camera: Camera, length: float, nearest: float) -> NDArray[np.bool_]:
    """What is within a length, seen in the middle of the region, of something ``(H, W)``."""
    reach = math.ceil(length * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=nearest)))
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), window)) > 0


@dataclass(frozen=True, eq=False)
class Agreement:
    """What silhouettes say of the same points, and which of them the others contradict.

    A view contradicts a point that it sees and takes for background.
    """

    views: Sequence[PosedImage]  # pictures, all with masks
    similarity: Similarity  # from world to unit-sphere coordinates
    visible: Tensor  # (V, N) visibility of the points of a grid in the unit ball, in each view
    against: Tensor  # (V, N) which of them it contradicts
    limits: Limits = Limits()  # when a silhouette is wrong

    @classmethod
    def of(cls, views: Sequence[PosedImage], similarity: Similarity, limits: Limits | None = None) -> Agreement:
        """Compare views at the points of the grid."""
        limits = limits or Limits()
        points = grid_in_ball(limits.cells)[0]
        masks = [silhouette(view, similarity, points, 2 / limits.cells) for view in views]
        visible, objects = (torch.stack(parts) for parts in zip(*masks, strict=True))
        return cls(views, similarity, visible, visible & ~objects, limits)

    def without(self, some: Sequence[PosedImage]) -> Agreement:
        """That of the other views."""
        if not some:
            return self
        left_out = {id(view) for view in some}
        rows = [row for row, view in enumerate(self.views) if id(view) not in left_out]
        views = [self.views[row] for row in rows]
        return Agreement(views, self.similarity, self.visible[rows], self.against[rows], self.limits)

    @cached_property
    def is_inverted(self) -> bool:
        """Whether the usual mask is object along its border, more than in the picture as a whole."""
        borders, wholes = zip(
            *((_border(mask).mean(), mask.mean()) for mask in map(_object_in, self.views)), strict=True
        )
        return bool(np.median(borders) > max(0.5, np.median(wholes)))

    def contradictions(self) -> list[PosedImage]:
        """Views that contradict much on which the others agree, or whose object lies mostly outside of the visual hull.

        None where all masks are inverted.
        """
        times, count = self.against.sum(dim=0), self.visible.sum(dim=0)
        agreed = self._enough_views & (times <= self.limits.agreed * count)
        shares = (self.against & agreed).sum(dim=1) / (self.visible & agreed).sum(dim=1).clamp(min=1)
        wrong = (shares > self.limits.wrong) | (self._bare > self.limits.wrong)
        return [] if self.is_inverted else self._those(wrong)

    def outliers(self) -> list[PosedImage]:
        """`contradictions`, if they are a tenth of the views at most: with more, it is unknown which are right."""
        odd = self.contradictions()
        return odd if len(odd) <= self.limits.most_wrong * len(self.views) else []

    def trusted(self) -> Sequence[PosedImage]:
        """Views that may carve a visual hull: neither `contradictions` nor those with `holes`."""
        rest = self.without(self.contradictions())
        return rest.without(rest._those(rest._cuts_alone)).views

    def holes(self) -> dict[int, NDArray[np.bool_]]:
        """Holes ``(H, W)`` in masks, by the view's number: enclosed background where all others see object."""
        alone = self.against & (self.against.sum(dim=0) == 1)
        points, found = grid_in_ball(self.limits.cells)[0], {}
        for index in self._cuts_alone.nonzero()[:, 0].tolist():
            hole = self._shadow(self.views[index], points[alone[index]]) & _enclosed(~_object_in(self.views[index]))
            if hole.any():
                found[index] = hole
        return found

    def misfit(self) -> float:
        """Share of the object's pixels with no visual hull behind them, in the median view.

        It is 0 to a cell if poses and pictures belong together, and not if the pictures are mirrored or turned.
        """
        return float(self._bare.median())

    @cached_property
    def _bare(self) -> Tensor:
        """Share of the object's pixels with no visual hull behind them, to a cell of it ``(V,)``."""
        most = (self.limits.sure * self.visible.sum(dim=0)).clamp(min=1)  # one wrong view of few may not take the hull
        agreed = self._enough_views & (self.against.sum(dim=0) <= most)
        hull, shares = grid_in_ball(self.limits.cells)[0][agreed], []
        for view in self.views:
            mask = _object_in(view)
            shares.append(float((mask & ~self._shadow(view, hull)).sum() / max(mask.sum(), 1)))
        return torch.tensor(shares)

    @property
    def _cuts_alone(self) -> Tensor:
        """Which of many views contradict much that no other one does ``(V,)``."""
        times = self.against.sum(dim=0)
        hull = ((times == 0) & self.visible.any(dim=0)).sum().clamp(min=1)
        share = (self.against & (times == 1)).sum(dim=1) / hull
        return (share > self.limits.lone) & (len(self.views) >= self.limits.few) & (not self.is_inverted)

    @property
    def _enough_views(self) -> Tensor:
        return self.visible.sum(dim=0) >= max(1.0, self.limits.agreed * len(self.views))

    def _those(self, which: Tensor) -> list[PosedImage]:
        return [view for view, is_meant in zip(self.views, which.tolist(), strict=True) if is_meant]

    def _shadow(self, view: PosedImage, points: Tensor) -> NDArray[np.bool_]:
        """Where a view sees points ``(N, 3)``, and all within a cell of them ``(H, W)``."""
        camera, edge = view.camera.moved(self.similarity), 2 / self.limits.cells
        pixels, _, inside = camera.in_view(points.numpy())
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        there = np.zeros((camera.height, camera.width), dtype=bool)
        there[row, column] = True
        return _widened(there, camera, edge, edge)


def _object_in(view: PosedImage) -> NDArray[np.bool_]:
    assert view.mask is not None
    return view.mask > OBJECT


def _border(picture: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.concatenate([*picture[[0, -1]], *picture[:, [0, -1]].T])


def _enclosed(background: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of it that reach no border of the picture ``(H, W)``."""
    labels = np.asarray(cv2.connectedComponents(background.astype(np.uint8), connectivity=4)[1])
    return background & ~np.isin(labels, _border(labels))


def named(names: Sequence[str]) -> str:
    """The first three of the views that a warning is about, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def free_space(measured: MeasuredDepths, resolution: int, *, rays: int = 1 << 18, least: int = 2) -> Tensor:
    """Which vertices of a grid over [−1, 1]³ measured rays pass ``(resolution + 1,) * 3``, on the CPU.

    A vertex is passed where at least ``least`` of up to ``rays`` rays go through the cell around it before they end
    beyond it, and no fewer than end there: one wrong measurement carves no hole. Right measurements pass no vertex that
    lies deeper inside than half the diagonal of a cell. Rays whose depth is not known yet are left out.
    """
    count, edge = resolution + 1, 2 / resolution
    passed, ended = (torch.zeros(count**3, dtype=torch.int64, device=measured.device) for _ in range(2))
    rows = torch.arange(len(measured), device=measured.device)[:: max(1, len(measured) // rays)]
    steps = torch.arange(round(2 / edge) * 2, device=measured.device) * (edge / 2)
    for part in rows.split(1 << 14):
        origins, directions, reach = measured.at(part)[:3]
        near, far = sphere_span(origins, directions)
        depths = near[:, None] + steps
        # Not the last cell and a half: that is where the surface is, as well as it was measured.
        kept = depths < torch.minimum(reach - 1.5 * edge, far)[:, None]
        cells = _cell(origins[:, None] + depths[..., None] * directions[:, None], resolution)
        # Half-cell steps meet a cell more than once; a ray counts once.
        first = torch.ones_like(kept)
        first[:, 1:] = cells[:, 1:] != cells[:, :-1]
        passed += torch.bincount(cells[kept & first], minlength=count**3)
        inside = (reach > near) & (reach < far)
        ends = _cell(origins + reach[:, None] * directions, resolution)
        ended += torch.bincount(ends[inside], minlength=count**3)
    return ((passed >= least) & (passed >= ended)).reshape(count, count, count).cpu()


def _cell(points: Tensor, resolution: int) -> Tensor:
    """Number of the vertex that is next to each point ``(...,)``."""
    x, y, z = ((points.clamp(-1, 1) + 1) * (0.5 * resolution)).round().long().unbind(dim=-1)
    return (x * (resolution + 1) + y) * (resolution + 1) + z


@dataclass(frozen=True)
class HullOptions:
    """How a start is carved and learnt. The values are this project's own."""

    resolution: int = 48  # cells along the grid that measured rays carve
    coarsest: int = 32  # cells along the coarsest grid that silhouettes carve; doubled until they suit the pixels
    finest: int = 128  # the same at most: the coarse level could not follow a finer one
    pixels: float = 1.5  # largest cells, in pixels
    # share of the views that must take a point for object: through a gap often one camera looks alone
    agree: float = 0.99
    seeing: float = 0.25  # share of all views that must see it
    margin: float = 3.0  # edges of a cell within which a coarse vertex must see object, to have finer ones tried
    least: float = 1e-3  # share of the unit ball that a hull fills at least
    most: float = 0.5  # the same at most, of silhouettes
    # the same of what no measured ray passes: much of a scene is hidden from cameras on one side
    most_hidden: float = 0.9
    steps: int = 250  # of Adam, in which the network learns the distances
    batch: int = 1024  # points per step
    rate: float = 2e-3  # of Adam, at first
    data_weight: float = 100.0  # weight of the squared error of the distance
    eikonal_weight: float = 0.1  # weight of (|∇f| − 1)²


HULL = HullOptions()


def begin(
    model: SceneModel,
    views: Sequence[PosedImage],
    images: PosedImages,
    config: ReconstructConfig,
    measured: MeasuredDepths | None = None,
    agreement: Agreement | None = None,
) -> str:
    """Give an untrained scene, in place, the start that its settings ask for; it is a sphere already.

    Returns "hull" (carved by measured rays too, unless the setting names it), "depths" (what no measured ray
    passes) or "sphere". ``agreement`` is that of the ``views``, if it is known.

    Raises:
        InputError: the setting names a start that these data do not give.
    """
    base = model.geometry.base if isinstance(model.geometry, MultiscaleSDF) else None
    masked = all(view.mask is not None for view in views) and config.start != "depths"
    carving = None if config.start == "hull" else measured
    if config.start != "sphere" and isinstance(base, Siren) and (masked or carving is not None):
        empty = None if carving is None else free_space(carving, HULL.resolution).numpy()
        carved = (agreement or Agreement.of(views, images.similarity)).trusted() if masked else ()
        if (distances := carve(carved, images.similarity, empty=empty)) is not None:
            start_at_hull(base, distances, seed=config.seed)
            return "hull" if masked else "depths"
    if config.start in ("hull", "depths"):
        wants = {
            "hull": "visual hull to begin with, which wants masks on all pictures that leave a part of the region",
            "depths": "start by measured depths, which wants depth maps in the cameras' units or COLMAP's points",
        }
        raise InputError(
            f"{images.source}: no {wants[config.start]}, and --geometry multiscale; see `mplicits check-cameras`, or "
            "take --start sphere"
        )
    return "sphere"


def carve(
    views: Sequence[PosedImage],
    similarity: Similarity,
    *,
    resolution: int | None = None,
    empty: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64] | None:
    """Signed distances to the carved unit ball at the vertices of a grid over [−1, 1]³, negative inside.

    A vertex of the unit ball is inside where `HullOptions.agree` of the views that see it find object within half a
    cell, so that thin parts stay. A vertex that no view sees is inside unless ``empty`` ``(E, E, E)``, a grid over the
    same cube, excludes it. Grids of half as many cells come first, so that most vertices are decided by a few.

    Returns:
        ``(resolution + 1,) * 3`` distances by x, y and z, exact to about a cell; None where too little or too much of
        the ball is left, as by empty and full masks.
    """
    if resolution is None:
        resolution = fitting_resolution(views, similarity) if views or empty is None else len(empty) - 1
    solid, ball = _object_vertices(views, similarity, resolution)
    if empty is not None:
        solid &= ~_all_around(empty, resolution)
    if not HULL.least < solid.sum() / ball < (HULL.most if views else HULL.most_hidden):
        return None
    # The surface lies half a cell from the outermost vertices inside.
    outer, inner = (np.asarray(distance_transform_edt(part), dtype=np.float64) for part in (~solid, solid))
    return 2 / resolution * np.where(solid, 0.5 - inner, outer - 0.5)


def fitting_resolution(views: Sequence[PosedImage], similarity: Similarity) -> int:
    """Cells along an edge of [−1, 1]³ that are hardly larger than what a pixel sees in its middle."""
    cameras = [view.camera.moved(similarity) for view in views]
    pixel = float(np.median([float(camera.eye.norm() / camera.intrinsics[0, 0]) for camera in cameras] or [1.0]))
    resolution = HULL.coarsest
    while resolution < HULL.finest and 2 / resolution > HULL.pixels * pixel:
        resolution *= 2
    return resolution


def _object_vertices(
    views: Sequence[PosedImage], similarity: Similarity, resolution: int
) -> tuple[NDArray[np.bool_], int]:
    """Vertices that enough views take for object ``(resolution + 1,) * 3``, and how many views count.

    Those in the unit ball are; without views all of them are object.
    """
    ball, sizes = 0, [resolution]
    while views and sizes[0] > HULL.coarsest and sizes[0] % 2 == 0:
        sizes.insert(0, sizes[0] // 2)
    solid = np.ones(3 * (sizes[0] + 1,), dtype=bool)
    for size in sizes:
        count = size + 1
        points, places = grid_in_ball(size)
        ball = len(places)
        if count > len(solid):
            # Beside a vertex that is object there is one of the coarser grid that is, with room to spare.
            near = binary_dilation(solid, np.ones((3, 3, 3)))
            for axis in range(3):
                near = near.repeat(2, axis=axis)
            among = torch.from_numpy(near[:count, :count, :count].reshape(-1))[places]
            points, places = points[among], places[among]
        if views:
            places = places[_agreed(views, similarity, points, 2 / size * (1 if size == resolution else HULL.margin))]
        solid = np.zeros(count**3, dtype=bool)
        solid[places.numpy()] = True
        solid = solid.reshape(count, count, count)
    return solid, ball


def _agreed(views: Sequence[PosedImage], similarity: Similarity, points: Tensor, edge: float) -> Tensor:
    """Which points ``(N, 3)`` are object for enough of the views that see them, if enough do ``(N,)``."""
    kept, (visible, object_in) = torch.arange(len(points)), torch.zeros(2, len(points))
    for view in views:
        sees, objects = silhouette(view, similarity, points[kept], edge)
        visible, object_in = visible + sees, object_in + objects
        # Others stay below the share, even if all further views see object.
        may = object_in + (len(views) - visible) >= HULL.agree * len(views)
        kept, visible, object_in = kept[may], visible[may], object_in[may]
    kept = kept[(object_in >= HULL.agree * visible) & (visible >= max(1.0, HULL.seeing * len(views)))]
    return torch.zeros(len(points), dtype=torch.bool).index_fill(0, kept, value=True)


def _all_around(empty: NDArray[np.bool_], resolution: int) -> NDArray[np.bool_]:
    """Vertices of another grid over the same cube whose neighbours in this one are all empty."""
    for axis in range(3):
        place = np.linspace(0, empty.shape[axis] - 1, resolution + 1)
        below, above = (np.take(empty, end(place).astype(int), axis=axis) for end in (np.floor, np.ceil))
        empty = below & above
    return empty


def start_at_hull(network: Siren, distances: NDArray[np.float64], *, seed: int = 0, steps: int = HULL.steps) -> None:
    """Train a SIREN in place to the distances of `carve`, smoothed as far as it cannot follow."""
    place = network.output.weight
    grid = ValueGrid(len(distances) - 1, place.device)
    grid.kept.copy_(torch.from_numpy(distances).to(place))
    units = network.units
    network.set_units()
    adam = torch.optim.Adam(network.parameters(), lr=HULL.rate, betas=(0.9, 0.99))
    with seeded(seed):
        for step in range(steps):
            points = ball_points(HULL.batch, radius=1.0, generator=torch.default_generator).to(place)
            jet = network.jet(points)
            loss = HULL.data_weight * data_loss(jet.value, grid(points))
            loss = loss + HULL.eikonal_weight * eikonal_loss(jet.gradient)
            for group in adam.param_groups:
                group["lr"] = HULL.rate * (1 - step / steps)
            adam.zero_grad(set_to_none=True)
            loss.mean().backward()
            adam.step()
    network.set_units(*units)
