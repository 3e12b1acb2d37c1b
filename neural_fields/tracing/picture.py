"""A whole picture in some dozen launches without waiting, recorded as one CUDA graph.

Rays of a pinhole camera, cones for tiles of pixels, the march, and the jets at the hits: each stage writes arrays of
one entry for each pixel, and counts on the device how many are in use. The host reads one number at the end.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false
# pyright: reportOperatorIssue=false, reportIndexIssue=false

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..backend.kernels.cones import march_cones
from ..backend.kernels.launch import on_device
from ..backend.kernels.levels import Levels, walk_rows
from ..backend.kernels.paths import march_fused
from ..backend.kernels.tracing import March, Marched, Queue, RayTensors
from ..fields.field import Field
from .cones import TILES

# Entries of the tensor of a view, float64: fx, fy, cx, cy; the pose's axes, a row for each world coordinate; the eye;
# then tolerance, resolution and Lipschitz constant of the march, the reach of a Newton step, and two ones of the cones:
# the radius of the ball that holds the surface, and how far the eye and that ball reach.
CAMERA = 22
PROGRAM_PIXELS = 1024  # of a program of the elementwise stages
GRAPHS = 4  # kept for a field; one of 1920 × 1080 pixels holds about 0.3 GB


@triton.jit
def _ball(ox, oy, oz, dx, dy, dz, radius):
    """Where a line enters and leaves the ball around 0; one that misses it enters after it leaves."""
    middle = -(ox * dx + oy * dy + oz * dz)
    x, y, z = ox + middle * dx, oy + middle * dy, oz + middle * dz
    squared = radius * radius - (x * x + y * y + z * z)
    half = tl.sqrt(tl.maximum(squared, 0.0))
    missed = half == 0
    infinite = float("inf")
    return tl.where(missed, infinite, middle - half), tl.where(missed, -infinite, middle + half)


@triton.jit
def make_rays(view, origin, directions, entries, ends, width, count, PIXELS: tl.constexpr):
    """Rays of pixels, and where they enter and leave the ball; computed in float64 and rounded once."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    real = pixel < count
    x = ((pixel % width).to(tl.float64) - tl.load(view + 2)) / tl.load(view)
    y = ((pixel // width).to(tl.float64) - tl.load(view + 3)) / tl.load(view + 1)
    length = tl.sqrt(x * x + y * y + 1.0)
    x, y, z = x / length, y / length, 1.0 / length
    ox, oy = tl.load(view + 13).to(tl.float32), tl.load(view + 14).to(tl.float32)
    oz = tl.load(view + 15).to(tl.float32)
    dx = (x * tl.load(view + 4) + y * tl.load(view + 5) + z * tl.load(view + 6)).to(tl.float32)
    dy = (x * tl.load(view + 7) + y * tl.load(view + 8) + z * tl.load(view + 9)).to(tl.float32)
    dz = (x * tl.load(view + 10) + y * tl.load(view + 11) + z * tl.load(view + 12)).to(tl.float32)
    tl.store(directions + pixel * 3, dx, mask=real)
    tl.store(directions + pixel * 3 + 1, dy, mask=real)
    tl.store(directions + pixel * 3 + 2, dz, mask=real)
    entry, leave = _ball(ox, oy, oz, dx, dy, dz, tl.load(view + 20).to(tl.float32))
    tl.store(entries + pixel, tl.maximum(entry, 0.0), mask=real)
    tl.store(ends + pixel, leave, mask=real)
    for axis in tl.static_range(3):
        tl.store(origin + pixel + axis, tl.load(view + 13 + axis).to(tl.float32), mask=pixel == 0)


@triton.jit
def _away(directions, pixel, dx, dy, dz, real):
    """How far the directions of pixels are from others."""
    x = tl.load(directions + pixel * 3, mask=real, other=0.0) - dx
    y = tl.load(directions + pixel * 3 + 1, mask=real, other=0.0) - dy
    z = tl.load(directions + pixel * 3 + 2, mask=real, other=0.0) - dz
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def make_cones(
    view, directions, before, axes, spreads, leaves, depths, width, height, count,
    SIDE: tl.constexpr, LARGER: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Cones of tiles of SIDE pixels, beginning where those of tiles of LARGER pixels ended, if that is not 0.

    All directions of a tile are within the angle of its corners: a cone meets the image in a convex region.
    """
    cone = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    real = cone < count
    across = tl.cdiv(width, SIDE)
    left, top = (cone % across) * SIDE, (cone // across) * SIDE
    right, bottom = tl.minimum(left + SIDE, width) - 1, tl.minimum(top + SIDE, height) - 1
    middle = tl.minimum(top + SIDE // 2, height - 1) * width + tl.minimum(left + SIDE // 2, width - 1)
    dx = tl.load(directions + middle * 3, mask=real, other=0.0)
    dy = tl.load(directions + middle * 3 + 1, mask=real, other=0.0)
    dz = tl.load(directions + middle * 3 + 2, mask=real, other=0.0)
    spread = tl.maximum(
        tl.maximum(
            _away(directions, top * width + left, dx, dy, dz, real),
            _away(directions, top * width + right, dx, dy, dz, real),
        ),
        tl.maximum(
            _away(directions, bottom * width + left, dx, dy, dz, real),
            _away(directions, bottom * width + right, dx, dy, dz, real),
        ),
    )
    ox, oy = tl.load(view + 13).to(tl.float32), tl.load(view + 14).to(tl.float32)
    oz = tl.load(view + 15).to(tl.float32)
    # A ray of the cone may be in the ball where its axis is not; spread times the reach is the most they are apart.
    radius = tl.load(view + 20).to(tl.float32) + spread * tl.load(view + 21).to(tl.float32)
    entry, leave = _ball(ox, oy, oz, dx, dy, dz, radius)
    depth = tl.maximum(entry, 0.0)
    if LARGER > 0:
        parent = (top // LARGER) * tl.cdiv(width, LARGER) + left // LARGER
        depth = tl.maximum(depth, tl.load(before + parent, mask=real, other=0.0))
    depth = tl.where(depth >= leave, float("inf"), depth)
    tl.store(axes + cone * 3, dx, mask=real)
    tl.store(axes + cone * 3 + 1, dy, mask=real)
    tl.store(axes + cone * 3 + 2, dz, mask=real)
    tl.store(spreads + cone, spread, mask=real)
    tl.store(leaves + cone, leave, mask=real)
    tl.store(depths + cone, depth, mask=real)


@triton.jit
def begin_rays(
    free, entries, ends, starts, listed, queue, mask, width, count, SIDE: tl.constexpr, PIXELS: tl.constexpr
):
    """Begin the rays where the cones of their tiles end, and list those that begin before they end."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    real = pixel < count
    tile = (pixel // width // SIDE) * tl.cdiv(width, SIDE) + (pixel % width) // SIDE
    start = tl.maximum(tl.load(free + tile, mask=real, other=0.0), tl.load(entries + pixel, mask=real, other=0.0))
    begins = real & (start < tl.load(ends + pixel, mask=real, other=0.0))
    tl.store(starts + pixel, start, mask=real)
    tl.store(mask + pixel, tl.zeros((PIXELS,), tl.int8), mask=real)
    chosen = begins.to(tl.int32)
    first = tl.atomic_add(queue, tl.sum(chosen, axis=0))
    tl.store(listed + first + tl.cumsum(chosen, axis=0) - 1, pixel, mask=begins)


@triton.jit
def count_hits(mask, counts, count, PIXELS: tl.constexpr):
    """How many pixels of each program see the surface."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    hit = tl.load(mask + pixel, mask=pixel < count, other=0).to(tl.int32)
    tl.store(counts + tl.program_id(0), tl.sum(hit, axis=0))


@triton.jit
def place_hits(
    origin, directions, mask, hit_depth, counts, hits, pixels, depths, positions, count,
    PROGRAMS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Rows of the pixels that see the surface, in their order, and how many there are."""
    program = tl.program_id(0)
    pixel = program * PIXELS + tl.arange(0, PIXELS)
    hit = tl.load(mask + pixel, mask=pixel < count, other=0).to(tl.int32)
    other = tl.arange(0, PROGRAMS)
    first = tl.sum(tl.load(counts + other, mask=other < program, other=0), axis=0)
    row = first + tl.cumsum(hit, axis=0) - 1
    visible = hit > 0
    depth = tl.load(hit_depth + pixel, mask=visible, other=0.0)
    tl.store(pixels + row, pixel.to(tl.int64), mask=visible)
    tl.store(depths + row, depth, mask=visible)
    for axis in tl.static_range(3):
        d = tl.load(directions + pixel * 3 + axis, mask=visible, other=0.0)
        tl.store(positions + row * 3 + axis, tl.load(origin + axis) + depth * d, mask=visible)
    tl.store(hits, first + tl.sum(hit, axis=0), mask=program == tl.num_programs(0) - 1)


@triton.jit
def see_hits(
    view, directions, pixels, hits, values, gradients, depths, positions, normals, sights,
    SHALLOW: tl.constexpr, NEWTON: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Normals, and with NEWTON the last step along the ray, from the jets at the hits."""
    row = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    real = row < tl.load(hits)
    pixel = tl.load(pixels + row, mask=real, other=0)
    gx = tl.load(gradients + row * 3, mask=real, other=1.0)
    gy = tl.load(gradients + row * 3 + 1, mask=real, other=0.0)
    gz = tl.load(gradients + row * 3 + 2, mask=real, other=0.0)
    dx = tl.load(directions + pixel * 3, mask=real, other=0.0)
    dy = tl.load(directions + pixel * 3 + 1, mask=real, other=0.0)
    dz = tl.load(directions + pixel * 3 + 2, mask=real, other=0.0)
    size = tl.sqrt(gx * gx + gy * gy + gz * gz)
    if NEWTON:
        slope = gx * dx + gy * dy + gz * dz
        trusted = tl.abs(slope) > SHALLOW * size
        reach = tl.load(view + 19).to(tl.float32)
        value = tl.load(values + row, mask=real, other=0.0)
        step = tl.where(trusted, -value / tl.where(trusted, slope, 1.0), 0.0)
        step = tl.minimum(tl.maximum(step, -reach), reach)
        tl.store(depths + row, tl.load(depths + row, mask=real, other=0.0) + step, mask=real)
        for axis in tl.static_range(3):
            d = tl.load(directions + pixel * 3 + axis, mask=real, other=0.0)
            place = tl.load(positions + row * 3 + axis, mask=real, other=0.0)
            tl.store(positions + row * 3 + axis, place + step * d, mask=real)
    size = tl.maximum(size, 1e-12)
    for axis in tl.static_range(3):
        tl.store(normals + row * 3 + axis, tl.load(gradients + row * 3 + axis, mask=real) / size, mask=real)
        tl.store(sights + row * 3 + axis, tl.load(directions + pixel * 3 + axis, mask=real), mask=real)


class Setting(NamedTuple):
    """Compile-time setting of a picture, beside the levels."""

    width: int  # of the image, in pixels
    height: int
    newton: bool  # whether hits take a last Newton step, by jets of the level that is traced
    max_steps: int  # of each ray
    cone_steps: int  # of each cone
    lipschitz: float  # of the cones
    shallow: float  # slope along the ray below which no Newton step is taken
    march: tuple[tuple[str, float], ...]  # see `march_constants`


class Drawn(NamedTuple):
    """One row for each pixel that sees the surface; see `pipelines.render.trace.Seen`."""

    pixel: Tensor
    depth: Tensor
    position: Tensor
    normal: Tensor
    direction: Tensor


class Picture:
    """The memory of pictures of one size and level, and the graph that draws them."""

    def __init__(self, traced: Levels, shown: Levels, setting: Setting, device: torch.device) -> None:
        self.traced, self.shown, self.setting = traced, shown, setting
        count = setting.width * setting.height
        programs = triton.cdiv(count, PROGRAM_PIXELS)
        numbers = {"dtype": torch.float32, "device": device}
        whole = {"dtype": torch.int32, "device": device}
        self.view = torch.zeros(CAMERA, dtype=torch.float64, device=device)
        self.rays = RayTensors(
            torch.zeros(1, 3, **numbers),
            torch.empty(count, 3, **numbers),
            *(torch.empty(count, **numbers) for _ in range(3)),
        )
        self.queue = Queue(torch.empty(count, **whole), torch.zeros(2, **whole))
        self.marched = Marched.nothing(torch.empty(count, **numbers))
        self.counts, self.hits = torch.zeros(programs, **whole), torch.zeros(1, **whole)
        self.values, self.gradients = torch.empty(count, **numbers), torch.empty(count, 3, **numbers)
        self.margin = traced.deltas[:1] if len(traced.networks) > 1 else torch.zeros(1, **numbers)
        self.drawn = Drawn(
            torch.empty(count, dtype=torch.int64, device=device),
            torch.empty(count, **numbers),
            *(torch.empty(count, 3, **numbers) for _ in range(3)),
        )
        # Recorded with the second picture: a size that is drawn once is not worth it.
        self.graph: torch.cuda.CUDAGraph | None = None
        self.begun = False
        # Where the host writes a view; memory that the device reads without a stop.
        self.staged = torch.zeros(CAMERA, dtype=torch.float64, pin_memory=device.type == "cuda")

    def draw(self, view: list[float]) -> Drawn:
        """The rows of a view (see `CAMERA`), in tensors of their own."""
        self.staged.copy_(torch.tensor(view, dtype=torch.float64))
        self.view.copy_(self.staged, non_blocking=True)
        if self.graph is None and self.begun and self.view.is_cuda:
            torch.cuda.synchronize(self.view.device)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self._launch()
            self.graph = graph
        if self.graph is None:
            self._launch()
        else:
            self.graph.replay()
        self.begun = True
        rows = int(self.hits)
        return Drawn(*(column[:rows].clone() for column in self.drawn))

    def _launch(self) -> None:
        """All stages, in order."""
        setting, view = self.setting, self.view
        origins, directions, starts, entries, ends = self.rays
        width, height = setting.width, setting.height
        count = width * height
        grid = (triton.cdiv(count, PROGRAM_PIXELS),)
        self.queue.state.zero_()
        with on_device(view):
            make_rays[grid](view, origins, directions, entries, ends, width, count, PIXELS=PROGRAM_PIXELS)
            free, larger = entries, 0
            for side in TILES:
                cones = triton.cdiv(width, side) * triton.cdiv(height, side)
                axes, columns = directions.new_empty(cones, 3), directions.new_empty(3, cones)
                make_cones[(triton.cdiv(cones, PROGRAM_PIXELS),)](
                    view, directions, free, axes, *columns, width, height, cones,
                    SIDE=side, LARGER=larger, PIXELS=PROGRAM_PIXELS,
                )  # fmt: skip
                free = march_cones(
                    self.traced.networks[0],
                    (origins[0], axes, *columns),
                    self.margin,
                    setting.lipschitz,
                    setting.cone_steps,
                )
                larger = side
            begin_rays[grid](
                free, entries, ends, starts, *self.queue, self.marched.mask, width, count,
                SIDE=larger, PIXELS=PROGRAM_PIXELS,
            )  # fmt: skip
            numbers, constants = view[16:19], dict(setting.march)
            march_fused(March(self.traced, self.rays, self.queue, self.marched, numbers, setting.max_steps, constants))
            count_hits[grid](self.marched.mask, self.counts, count, PIXELS=PROGRAM_PIXELS)
            place_hits[grid](
                origins, directions, self.marched.mask, self.marched.depth, self.counts, self.hits, *self.drawn[:3],
                count, PROGRAMS=triton.next_power_of_2(grid[0]), PIXELS=PROGRAM_PIXELS,
            )  # fmt: skip
            walk_rows(self.drawn.position, self.shown, self.values, self.gradients, count=self.hits, jet=True)
            see_hits[grid](
                view, directions, self.drawn.pixel, self.hits, self.values, self.gradients, *self.drawn[1:],
                SHALLOW=setting.shallow, NEWTON=setting.newton, PIXELS=PROGRAM_PIXELS,
            )  # fmt: skip


_pictures: WeakKeyDictionary[Field, OrderedDict[tuple[object, ...], Picture]] = WeakKeyDictionary()


def draw(field: Field, traced: Levels, shown: Levels, setting: Setting, view: list[float]) -> Drawn:
    """Draw a picture of a field, by the graph of one like it if there was one.

    ``traced`` are the levels up to the one whose surface is visible, ``shown`` those up to the one whose gradient gives
    the normals. See `Setting` and, for ``view``, `CAMERA`.
    """
    device = traced.deltas.device
    pointers = tuple(
        part.data_ptr() for levels in (traced, shown) for one in levels.networks for part in (one.floats, one.halves)
    )
    own = (levels.deltas.data_ptr() for levels in (traced, shown))
    key = (setting, device, traced.taper, pointers, *own)
    kept = _pictures.setdefault(field, OrderedDict())
    picture = kept.pop(key, None)
    if picture is None:
        picture = Picture(traced, shown, setting, device)
    kept[key] = picture
    while len(kept) > GRAPHS:
        kept.popitem(last=False)
    return picture.draw(view)
