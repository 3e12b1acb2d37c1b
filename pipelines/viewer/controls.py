"""The viewer's panel: which controls there are, and what they say now."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from ...neural_fields import Similarity
from ..render.slice import round_step
from .frames import Look

__all__ = ["LARGEST_PICTURE_SIDE", "SURFACES", "Controls", "slice_range"]

TRACED, MESH, BOTH, NOTHING = SURFACES = ("traced", "mesh", "traced and wires", "hidden")
NO_BAND = "none"
SAME = "same level"
AXES = ("x", "y", "z")
# From the start to the end of a motion while it plays; images come as fast as they are drawn.
TIME_STEP = 1 / 48
# Of the slider that moves the slice plane, about, from one side of the unit sphere to the other.
SLICE_STEPS = 200
LARGEST_PICTURE_SIDE = 8192  # pixels
NOTHING_READ = "Click on the surface, or on the slice plane."


def slice_range(similarity: Similarity, axis: int) -> tuple[float, float, float]:
    """Where a plane across an axis can stand, in input coordinates: lowest, highest, and the step between.

    The step is 1, 2 or 5 times a power of ten, and both ends are multiples of it, the last ones in the unit sphere.

    Args:
        similarity: from input to unit-sphere coordinates.
        axis: 0, 1 or 2.
    """
    center, scale = similarity.center[axis], similarity.scale
    step = round_step(2 * scale / SLICE_STEPS)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))  # a power of ten is its own
    low, high = math.ceil((center - scale) / step), math.floor((center + scale) / step)
    return round(low * step, digits), round(high * step, digits), step


def _one_of(allowed: Sequence[str], value: Any) -> str:
    """The value, or the first that is allowed if it is none of them."""
    return value if value in allowed else allowed[0]


class Controls:
    """The controls of one browser; every property says what its control shows now.

    What a browser says of a control may be anything. Properties are within its bounds all the same.

    Args:
        gui: viser's interface to the panel of that browser.
        levels: number of levels of the field.
        shadings: the names to choose from, the first one first shown.
        has_cloud: whether there is a cloud to be shown.
        moves: whether the field moves.
        similarity: from input to unit-sphere coordinates: what the panel says is in input units.
        deltas: half-widths of the bands, in units of the field.
        picks: whether landmarks are picked.
    """

    def __init__(
        self,
        gui: Any,
        *,
        levels: int,
        shadings: Sequence[str],
        has_cloud: bool,
        moves: bool = False,
        similarity: Similarity | None = None,
        deltas: Sequence[float] = (),
        picks: bool = False,
    ) -> None:
        self._similarity = similarity or Similarity.identity()
        self._names = names = [str(level) for level in range(levels)]
        self._shadings = tuple(shadings)
        self._moves = moves
        with gui.add_folder("Landmarks", visible=picks):
            self._picks = gui.add_markdown("")
            self._undo = gui.add_button("Undo", hint="take back the last click, or the last pair")
        with gui.add_folder("Time", visible=moves):
            self._time = gui.add_slider("Time", min=0.0, max=1.0, step=0.001, initial_value=0.0)
            self._play = gui.add_checkbox("Play", False, hint="while the traced surface is shown")
        with gui.add_folder("Surface"):
            self._surface = gui.add_dropdown("Show", SURFACES, hint="wires and meshes are extracted once per level")
            self._shading = gui.add_dropdown("Shading", tuple(shadings))
            self._shadows = gui.add_checkbox("Shadows", False, hint="for lambert; traced in the coarsest level")
            self._occlusion = gui.add_checkbox("Occlusion", False, hint="for lambert; darker hollows")
            self._level = gui.add_dropdown(
                "Level", names, initial_value=names[-1], hint="0 is the coarsest", visible=levels > 1
            )
            self._normals = gui.add_dropdown(
                "Normals of",
                (SAME, *names[1:]),
                hint="neural normal mapping: normals of a finer level on a coarser surface",
                visible=levels > 1,
            )
        with gui.add_folder("Beside it"):
            self._cloud = gui.add_checkbox("Input cloud", False, visible=has_cloud)
            widths = ", ".join(f"{delta * self._similarity.scale:.3g}" for delta in deltas)
            hint = f"shells |f| = δ of a level; δ = {widths} in input units"
            self._band = gui.add_dropdown("Band", (NO_BAND, *names[:-1]), hint=hint, visible=levels > 1)
            self._slice = gui.add_checkbox("Slice plane", False, hint="choose Show: hidden to see all of it")
            self._axis = gui.add_dropdown("Slice across", AXES)
            low, high, step = slice_range(self._similarity, 0)
            hint = "coordinate along that axis, in input units"
            self._position = gui.add_slider(
                "Slice at", min=low, max=high, step=step, initial_value=self._beside(0, 0.0), hint=hint
            )
            self._axis.on_update(lambda _event: self._turn_slice())
        with gui.add_folder("Under the pointer"):
            self._reading = gui.add_markdown(NOTHING_READ)
        with gui.add_folder("Picture"):
            self._width = gui.add_number(
                "Width", 1600, min=16, max=LARGEST_PICTURE_SIDE, step=1, hint="pixels; the view's shape is kept"
            )
            self._transparent = gui.add_checkbox("Transparent", False)
            self._save = gui.add_button("Save picture", hint="the traced surface as a PNG, at this width")
            self._screenshot = gui.add_button(
                "Save screenshot", hint="all that is in the scene, as it is on the screen"
            )
        self._status = gui.add_markdown("")

    def _beside(self, axis: int, position: float) -> float:
        """The input coordinate that the slider can show nearest to a position in the unit sphere."""
        low, high, step = slice_range(self._similarity, axis)
        wanted = self._similarity.center[axis] + position * self._similarity.scale
        return min(max(low, round(low + round((wanted - low) / step) * step, 12)), high)

    def _in_sphere(self, axis: int, coordinate: float) -> float:
        position = (coordinate - self._similarity.center[axis]) / self._similarity.scale
        return min(max(-1.0, position), 1.0)

    def _turn_slice(self) -> None:
        """Another axis is chosen: the slider counts along that one, and the plane stands in the middle of it."""
        axis = self._across
        self._position.min, self._position.max, _ = slice_range(self._similarity, axis)
        self._position.value = self._beside(axis, 0.0)

    def on_change(self, look: Callable[[], None], scene: Callable[[], None]) -> None:
        """Call ``look`` when the traced image has to be drawn anew, ``scene`` when what stands beside it changes."""
        looks = (self._surface, self._shading, self._shadows, self._occlusion, self._level, self._normals)
        for control in (*looks, self._time):
            control.on_update(lambda _event: look())
        self._play.on_update(lambda _event: look() if self._play.value else None)
        scenes = (self._surface, self._level, self._cloud, self._band, self._slice, self._axis, self._position)
        for control in (*scenes, self._time):
            control.on_update(lambda _event: scene())

    def on_save(self, picture: Callable[[], None], screenshot: Callable[[], None]) -> None:
        """Call these when their buttons are pressed."""
        self._save.on_click(lambda _event: picture())
        self._screenshot.on_click(lambda _event: screenshot())

    @property
    def look(self) -> Look:
        """How the field is drawn; normals come from no coarser level than the surface."""
        finer = str(self._normals.value)
        normals = max(self.level, int(finer)) if finer in self._names else self.level
        shading = _one_of(self._shadings, self._shading.value)
        return Look(self.level, normals, shading, bool(self._shadows.value), bool(self._occlusion.value), self.time)

    @property
    def time(self) -> float:
        """When; 0 for a field that does not move."""
        return min(max(0.0, float(self._time.value)), 1.0)

    def play_on(self) -> None:
        """An image is shown: on to the next time if the motion is played, and from the end to the start."""
        if self._moves and self._play.value:
            later = self.time + TIME_STEP
            self._time.value = 0.0 if self.time >= 1 else min(round(later, 3), 1.0)

    @property
    def level(self) -> int:
        """The level shown."""
        return int(_one_of(self._names[::-1], self._level.value))

    @property
    def is_traced(self) -> bool:
        """Whether the traced image is shown."""
        return self._surface.value in (TRACED, BOTH)

    @property
    def mesh(self) -> tuple[int, bool] | None:
        """The level whose mesh is shown and whether as wires; None where none is."""
        return (self.level, self._surface.value == BOTH) if self._surface.value in (MESH, BOTH) else None

    @property
    def cloud(self) -> bool:
        """Whether the input is shown."""
        return bool(self._cloud.value)

    @property
    def band(self) -> int | None:
        """The level whose band is shown, if one is."""
        return int(self._band.value) if self._band.value in self._names[:-1] else None

    @property
    def slice(self) -> tuple[int, float] | None:
        """Axis (0, 1, 2) and position of the slice plane in the unit sphere, if it is shown."""
        if not self._slice.value:
            return None
        return self._across, self._in_sphere(self._across, float(self._position.value))

    @property
    def _across(self) -> int:
        """The axis that the slice plane stands across: 0, 1 or 2."""
        return AXES.index(_one_of(AXES, self._axis.value))

    @property
    def picture(self) -> tuple[int, bool]:
        """Width of the picture to be saved, and whether without a background."""
        width = min(max(16, int(self._width.value)), LARGEST_PICTURE_SIDE)
        return width, bool(self._transparent.value)

    def on_undo(self, undo: Callable[[], None]) -> None:
        """Call this when a landmark is taken back."""
        self._undo.on_click(lambda _event: undo())

    def tell_picks(self, text: str) -> None:
        """Show which landmark is picked next, in Markdown."""
        self._picks.content = text

    def read(self, text: str) -> None:
        """Show what is under the pointer, in Markdown."""
        self._reading.content = text

    def say(self, text: str) -> None:
        """Show a line at the end of the panel."""
        if self._status.content != text:
            self._status.content = text
