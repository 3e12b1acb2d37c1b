"""The traced image of a field, or of the moments of one that moves, in pieces small enough to stop between them."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.cameras import Camera, look_at
from ...neural_fields import Field, TextureField, map_colors
from ...neural_fields.spacetime.dynamic_tracing import moment
from ...neural_fields.spacetime.evolution import VectorField
from ..render.light import load_matcap
from ..render.shade import ShadeOptions, compose, measure, shade
from ..render.trace import Seen, merge_strips, strips, trace_view
from ..texture.transport import Colors, TransportedColors
from .camera import z_buffer
from .frames import Look

__all__ = ["Moments", "Painter"]

WHITE = (1.0, 1.0, 1.0)
# Seconds between two looks at whether anybody still waits, and pixels drawn between them: at first, and at most and
# at least, because rows of empty pixels say nothing about those that follow.
ATTENTION = 0.25
BLOCK, SMALLEST_BLOCK, LARGEST_BLOCK = 1 << 13, 1 << 12, 1 << 15
# Moments are small, but each has the meshes that were made of it.
KEPT = 16
# Shadings that map numbers to colours, whose limits depend on all pixels together.
MEASURED = ("depth", "curvature", "error")


class Painter:
    """Draws a field.

    Args:
        field: what to draw, three- or four-dimensional.
        reference: loads the cloud ``(N, 3)`` that "error" measures from, when it is first needed.
        texture: its colours, if it has some; of a field that moves, those at time 0.
        motion: the velocity along which they ride, where one was learnt.
    """

    def __init__(
        self,
        field: Field,
        reference: Callable[[], NDArray[np.float32]],
        texture: TextureField | None = None,
        motion: VectorField | None = None,
    ) -> None:
        self._moments, self._load_reference, self._texture = Moments(field), reference, texture
        self._motion = motion

    @property
    def colored(self) -> bool:
        """Whether the field has colours."""
        return self._texture is not None

    def warm_up(self) -> None:
        """Draw a few pixels, so that the first image does not wait for what is loaded when it is first needed."""
        camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), width=8, height=8)
        self(camera, Look(level=0, normal_level=0, shading="lambert"), lambda: None)

    def __call__(
        self, camera: Camera, look: Look, check: Callable[[], None]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """An image on white ``(H, W, 3)``, and the distance of what it shows from the plane of the eye ``(H, W)``."""
        seen, rgb = self._paint(camera, look, check)
        return compose(seen, rgb, background=WHITE), z_buffer(seen, camera)

    def picture(self, camera: Camera, look: Look, check: Callable[[], None], *, transparent: bool) -> NDArray[np.uint8]:
        """An image to keep ``(H, W, 3 or 4)``."""
        return compose(*self._paint(camera, look, check), background=None if transparent else WHITE)

    @torch.inference_mode()
    def _paint(self, camera: Camera, look: Look, check: Callable[[], None]) -> tuple[Seen, Tensor]:
        parts, field, colors = [], self._moments.at(look.time), self._colors(look)
        for first, strip in strips(camera, _Pace(check).next_block):
            seen = trace_view(
                field,
                strip,
                level=look.level,
                normal_level=look.normal_level,
                colors=colors,
                device=field.deltas.device,
            )
            parts.append((first, seen))
        seen = merge_strips((camera.width, camera.height), parts)
        if look.shading in MEASURED:
            numbers = [
                measure(part, look.shading, field=field, level=look.normal_level, reference=self._reference(look))
                for part in _pieces(seen, _Pace(check).next_block)
            ]
            return seen, shade(seen, look.shading, camera=camera, values=torch.cat(numbers))
        # Shadows and occlusion look further than a band is wide, and a coarse level answers that as well and sooner.
        options = ShadeOptions(shadows=look.shadows, occlusion=look.occlusion, light_level=0)
        colors = [
            shade(part, look.shading, camera=camera, field=field, options=options, matcap=self._matcap)
            for part in _pieces(seen, _Pace(check).next_block)
        ]
        return seen, torch.cat(colors)

    def _colors(self, look: Look) -> Colors | None:
        texture = self._texture
        if texture is None:
            return None
        if self._moments.moves:
            return self._riding.at(look.time)
        return lambda points: map_colors(texture, points).values

    @cached_property
    def _riding(self) -> TransportedColors:
        assert self._texture is not None
        return TransportedColors(self._moments.field, self._texture, motion=self._motion)

    def _reference(self, look: Look) -> KDTree | None:
        return self._tree if look.shading == "error" else None

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self._load_reference())

    @cached_property
    def _matcap(self) -> Tensor:
        return load_matcap(ShadeOptions().matcap)


class _Pace:
    """How many pixels to draw at once, from how long the last ones took."""

    def __init__(self, check: Callable[[], None]) -> None:
        self._check, self._block, self._begun = check, BLOCK, math.nan

    def next_block(self) -> int:
        """The number of pixels to draw now; looks first whether anybody still waits for them."""
        self._check()
        now = time.perf_counter()
        if now - self._begun < ATTENTION / 2:
            self._block = min(2 * self._block, LARGEST_BLOCK)
        elif now - self._begun > ATTENTION:
            self._block = max(self._block // 2, SMALLEST_BLOCK)
        self._begun = now
        return self._block


def _pieces(seen: Seen, next_block: Callable[[], int]) -> Iterator[Seen]:
    """Rows of what is seen, a block at a time; at least one, which may be empty."""
    first = 0
    while first < max(1, len(seen.pixel)):
        part = slice(first, first + next_block())
        yield seen.part(part)
        first = part.stop


class Moments:
    """Three-dimensional fields by time; of a field that does not move there is one.

    Args:
        field: three- or four-dimensional.
    """

    def __init__(self, field: Field) -> None:
        self.field, self.moves = field, field.in_dim == 4
        self._kept: OrderedDict[float, Field] = OrderedDict()
        self._lock = threading.Lock()

    def at(self, time: float) -> Field:
        """The field at a time."""
        if not self.moves:
            return self.field
        with self._lock:
            if time not in self._kept:
                self._kept[time] = moment(self.field, time)
            self._kept.move_to_end(time)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return self._kept[time]
