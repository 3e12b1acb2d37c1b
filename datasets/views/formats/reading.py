"""Cameras of posed images: transforms.json in its dialects, NeuS's cameras_sphere.npz, and COLMAP's models.

Lens distortion (k1, k2, p1, p2 and their like) is left aside: the cameras are the pinholes that undistorted images
have, which is right for drawing, but not for reading colours out of distorted photographs. `read_posed_images` removes
the distortion and changes the cameras with it.
"""

from __future__ import annotations

from pathlib import Path

from ....neural_fields import InputError
from ...cameras import Camera
from ...files import readable
from .colmap import find_model, read_colmap
from .neus import read_neus
from .shots import Shot
from .transforms import read_transforms

__all__ = ["find_source", "read_cameras", "read_shots"]

FILES = ("cameras_sphere.npz", "transforms.json", "transforms_train.json")  # looked for in a folder, in this order


def read_cameras(path: str | Path) -> list[tuple[str, Camera]]:
    """Read the cameras of posed images, with the images' names, in the file's own world coordinates.

    - ``*.json``: transforms.json of nerfstudio, instant-ngp and the Blender scenes of NeRF. ``transform_matrix`` is
      the pose in OpenGL's convention (x right, y up, z backward) and becomes OpenCV's. The focal length is ``fl_x``,
      ``fl_y`` or ``camera_angle_x``; ``cx`` and ``cy`` count from the image's corner, so half a pixel is taken off; all
      may stand at the top or in a frame. Without ``w`` and ``h`` the image itself is asked.
    - ``*.npz``: NeuS and IDR; ``world_mat_i`` projects onto pixels and is taken apart. The i-th image in name order of
      the folder ``image`` beside the file gives name and size.
    - a folder: one of these in it (cameras_sphere.npz, transforms.json, transforms_train.json), or a COLMAP model,
      text or binary: the largest in ``sparse/*``, or that in ``sparse`` or the folder itself.

    Raises:
        InputError: the file is missing, damaged or of another kind, or a camera in it cannot be one.

    Example:
        >>> read_cameras("cameras.txt")
        Traceback (most recent call last):
        ...
        mplicits.neural_fields.backend.errors.InputError: cameras.txt: no such file; check the path
    """
    return [(shot.name, shot.camera.pinhole()) for shot in read_shots(find_source(path))]


def find_source(path: str | Path) -> Path:
    """The file of cameras that a path means: itself, or what is found in the folder; for COLMAP the model's folder.

    Raises:
        InputError: there is no such file, or nothing that we know in the folder.
    """
    path = Path(path)
    if path.is_dir():
        found = next((path / name for name in FILES if (path / name).is_file()), None) or find_model(path)
        if found is None:
            raise InputError(f"{path}: none of {', '.join(FILES)} or a COLMAP model (sparse/*) in it; name the file")
        return found
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    if path.suffix.lower() not in (".json", ".npz"):
        known = "cameras are read from .json, .npz and the folders of COLMAP models"
        raise InputError(f"{path}: unknown extension {path.suffix!r}; {known}")
    return path


def read_shots(source: Path) -> list[Shot]:
    """Read what `find_source` found.

    Raises:
        InputError: the file is damaged, or a camera in it cannot be one.
    """
    with readable(source):
        if source.is_dir():
            return read_colmap(source)
        return read_neus(source) if source.suffix.lower() == ".npz" else read_transforms(source)
