"""What ``mplicits bench reconstruct`` trains on: exact scenes drawn on the spot, and data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..datasets.synthetic.scenes import SCENES, Scene, render_scene
from ..datasets.views.images import PosedImages, read_posed_images
from ..neural_fields import InputError
from .run.config import closest

__all__ = ["BenchScene", "read_scene"]


@dataclass(frozen=True)
class BenchScene:
    """Posed images, and what is known of them.

    Attributes:
        name: for tables and files.
        images: what is trained on and measured.
        exact: the scene that they show, if it is known in closed form; its similarity is the identity.
    """

    name: str
    images: PosedImages
    exact: Scene | None


def read_scene(
    name: str,
    *,
    views: int = 24,
    size: int = 64,
    width: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BenchScene:
    """A scene of `SCENES`, drawn on the spot, or a data set.

    Args:
        name: of a scene, or the path of a data set (./statue for a folder that is called like a scene).
        views: of a scene.
        size: of a scene's images.
        width: to which the pictures of a data set are shrunk.
        progress: called with ``(done, total)`` while a scene is drawn.

    Raises:
        InputError: no such scene or data set, or it cannot be read.
    """
    if name in SCENES:
        scene = SCENES[name]()
        return BenchScene(name, render_scene(scene, views, size, progress=progress), scene)
    path = Path(name)
    if not path.exists():
        raise InputError(f"{name}: no such data set, and no scene of that name{closest(name, SCENES)}")
    images = read_posed_images(path, width=width)
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    return BenchScene(folder.name, images, None)
