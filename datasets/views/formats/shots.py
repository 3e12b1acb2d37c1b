"""``Shot``: what a file says of one photograph, and what the readers of all such files share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ....neural_fields import InputError
from ....neural_fields.backend.files import files_in
from ...cameras import Camera

__all__ = ["IMAGE_SUFFIXES", "Shot", "find_file", "find_image", "image_size", "list_images"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic", ".heif")


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph as a file of cameras describes it; the photograph itself is not read.

    Attributes:
        name: of the image, as the file has it.
        camera: with its lens.
        image: where the photograph should be.
        mask: where its mask should be, or None.
        named: file and record, as the beginning of a message.
        depth: where its depth map should be, or None.
        depth_scale: steps per unit of that, if it has integers and the file says so; see `read_depth`.
    """

    name: str
    camera: Camera
    image: Path
    mask: Path | None
    named: str
    depth: Path | None = None
    depth_scale: float | None = None


def find_file(folder: Path, name: str) -> Path:
    """The file of that name, as a file of cameras has it: written on Windows, it may have backslashes."""
    beside = folder / name
    return beside if beside.exists() or "\\" not in name else folder / name.replace("\\", "/")


def find_image(folder: Path, name: str) -> Path:
    """The image of that name; Blender's scenes leave its extension out. Whether there is one is not said."""
    beside = find_file(folder, name)
    files = [beside, *(beside.with_name(beside.name + suffix) for suffix in IMAGE_SUFFIXES)]
    return next((file for file in files if file.is_file()), beside)


def list_images(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, but for hidden files; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return files_in(folder, IMAGE_SUFFIXES)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the header alone.

    Raises:
        InputError: the file is damaged or no image.
    """
    import imageio.v3 as iio  # here, because most files of cameras say it themselves

    try:
        shape = iio.improps(path, plugin="pillow").shape
    except (OSError, ValueError, SyntaxError) as error:  # Pillow's PNG reader raises SyntaxError
        raise InputError(f"{path}: cannot be read as an image; export it again") from error
    return int(shape[1]), int(shape[0])
