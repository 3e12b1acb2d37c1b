"""Which shapes a bench is about: files, and folders full of them, checked before any work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...neural_fields import InputError
from ...neural_fields.files import files_in
from ..bench.run import Shape
from ..surface.surface import MESH_SUFFIXES, read_reference, read_surface

__all__ = ["find_shapes"]


def find_shapes(paths: Sequence[str | Path], *, reference: Path | None = None) -> list[Shape]:
    """The shapes that files and folders name.

    Args:
        paths: mesh files, folders (of which every mesh counts), or clouds if there is a reference.
        reference: the mesh that those without faces are measured against.

    Raises:
        InputError: there is no such file, a folder holds no mesh, a file holds no faces and there is no reference,
            or two files have the same name but for their folders and extensions.
    """
    files = [file for path in map(Path, paths) for file in _files(path)]
    stems: dict[str, Path] = {}
    for file in files:
        other = stems.setdefault(file.stem, file)
        if other is not file:
            raise InputError(f"{file}: {other} has the same name, which is how tables tell shapes apart; rename one")
    if reference is not None:
        read_reference(reference, fix="give another --reference")
    shapes = [_shape(file, reference) for file in files]
    if reference is not None and all(shape.reference is None for shape in shapes):
        raise InputError(f"--reference {reference}: every shape is a mesh, its own reference; leave it out")
    return shapes


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = [file for file in files_in(path, MESH_SUFFIXES) if file.is_file()]
    if not found:
        raise InputError(f"{path}: holds no mesh ({', '.join(MESH_SUFFIXES)}); name files, or another folder")
    return found


def _shape(file: Path, reference: Path | None) -> Shape:
    if len(read_surface(file).faces):
        return Shape(file)
    if reference is None:
        raise InputError(f"{file}: has no faces, so there is no surface to compare with; give --reference MESH")
    return Shape(file, reference)
