"""Solids from fields: fits and closed meshes joined, offset and hollowed, as watertight meshes."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import (
    Difference,
    Field,
    InputError,
    Intersection,
    Mesh,
    Offset,
    Shell,
    Similarity,
    Union,
    WorldField,
    save_field,
)
from ...neural_fields.fields.csg import Bounded
from ...neural_fields.fields.similarity import METRES
from ...neural_fields.meshing.extract import extract_mesh, surface_needed
from ...neural_fields.shape import in_one_frame
from ..surface.distance import MeshField
from ..surface.surface import Support, is_closed, read_support, read_surface, volume, without_blobs
from ..training.folder import chosen_level, find_field, is_field, load_still
from .files import check_mesh_path, placement_of, write_mesh

FIELD_SUFFIX = ".safetensors"
OPERATIONS: dict[str, type[Union | Intersection | Difference]] = {
    "union": Union,
    "intersection": Intersection,
    "difference": Difference,
}
# Half a side of the box around all: what was learned ends, closed, on the sphere of `Bounded`, 1.05 scales in radius.
HALF_BOX = 1.07
# Fewest cells across a wall: with less than a cell's diagonal, holes open where no corner lies in it.
CELLS_IN_WALL = 2
LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z]*)")


@dataclass(frozen=True)
class SolidOptions:
    """How to make a solid.

    Attributes:
        resolution: cells along each side of the cube around all operands.
        time: the moment, for operands that move.
        level: from 0, the coarsest; None is the finest. Operands with fewer levels stay at their finest.
        keep_unsupported: whether to keep components that no input points of the runs support.
        up: see `Placement`, as for ``center``.
        unit: the length of one input unit, by which lengths with a unit are measured.
    """

    resolution: int = 256
    time: float | None = None
    level: int | None = None
    keep_unsupported: bool = False
    up: str | None = None
    unit: str | None = None
    center: bool = False


@dataclass(frozen=True)
class Made:
    """A mesh in input coordinates, whether it is watertight, and its volume in cubic input units."""

    mesh: Mesh
    closed: bool
    volume: float


@dataclass(frozen=True)
class Operand:
    """A fit or a mesh: name, field and frame, and the points that a run rests on (None: all of it is trusted)."""

    name: str
    shape: WorldField
    support: Support | None


def length_in(text: str, unit: str | None, flag: str) -> float:
    """A length in input units, from a number of them, or a number and a unit: "2mm"; ``flag`` is for messages.

    ``unit`` is the length of one input unit, a key of `METRES`, if it is known. Raises InputError.

    Example:
        >>> length_in("2mm", "cm", "--by"), length_in("-0.5", None, "--by")
        (0.2, -0.5)
    """
    found = LENGTH.fullmatch(text.strip())
    if not found or (found[2] and found[2] not in METRES) or not math.isfinite(float(found[1])):
        raise InputError(f"{flag} {text}: expected a number of input units, or one with a unit ({', '.join(METRES)})")
    if not found[2]:
        return float(found[1])
    if unit is None:
        raise InputError(f"{flag} {text}: how long is a unit of the input? say so with --unit ({', '.join(METRES)})")
    if unit not in METRES:
        raise InputError(f"--unit {unit}: expected one of {', '.join(METRES)}")
    return float(found[1]) * METRES[found[2]] / METRES[unit]


def boolean(
    parts: Sequence[str | Path],
    operation: str,
    out: str | Path,
    options: SolidOptions | None = None,
    *,
    smooth: str = "0",
    say: Callable[[str], None] | None = None,
) -> Made:
    """Join two or more runs, checkpoints and closed meshes that lie in the same input coordinates.

    ``operation`` is a key of `OPERATIONS`; a difference takes the others from the first. ``out`` is a mesh, or a
    .safetensors file for the field itself, where no part is a mesh. ``smooth`` is the width of the blend (`length_in`,
    `Union`). ``say`` is called with a line about what was removed. Raises an InputError if a part cannot be read or is
    not closed, nothing is left, or the file cannot be written.
    """
    options = options or SolidOptions()
    width = length_in(smooth, options.unit, "--smooth")
    if width < 0:
        raise InputError(f"--smooth {smooth}: expected a length ≥ 0")
    if len(parts) < 2:
        raise InputError(f"{parts[0] if parts else 'boolean'}: expected two runs or meshes at least")
    out = Path(out)
    as_field = out.suffix.lower() == FIELD_SUFFIX
    check_mesh_path(out.with_suffix(".ply") if as_field else out)
    operands = [_read(part, options) for part in parts]
    meshes = [operand.name for operand in operands if isinstance(operand.shape.field, MeshField)]
    if as_field and meshes:
        raise InputError(f"{out}: {meshes[0]} is a mesh, which a {FIELD_SUFFIX} file cannot hold; write a mesh instead")
    fields, frame = in_one_frame([operand.shape for operand in operands])
    field = OPERATIONS[operation](*fields, smooth=width / frame.scale)
    if not as_field:
        check_mesh_path(out, frame, centered=options.center)
    mesh = _extracted(field, options, f"{operation} of {' and '.join(operand.name for operand in operands)}")
    if not options.keep_unsupported:
        mesh = _supported(mesh, operands, fields, frame, say)
    if as_field:
        save_field(out, field, similarity=frame)
        return _made(mesh, frame)
    return _written(out, mesh, frame, options, say)


def offset(
    part: str | Path,
    by: str,
    out: str | Path,
    options: SolidOptions | None = None,
    *,
    shell: bool = False,
    say: Callable[[str], None] | None = None,
) -> Made:
    """Grow or shrink a run or a closed mesh by a length (`length_in`), or keep the wall in between, if ``shell``.

    The distance is that to the mesh of the finest level: away from its surface, a `MultiscaleSDF` is its coarsest
    level. ``say`` is called with a line about what was removed. Raises an InputError if the part cannot be read or is
    not closed, nothing is left, a wall is thinner than two cells, or the file cannot be written.
    """
    options = options or SolidOptions()
    length = length_in(by, options.unit, "--by")
    if length == 0:
        raise InputError(f"--by {by}: expected a length other than 0")
    check_mesh_path(out)
    operand = _read(part, options)
    size = operand.shape.similarity.scale + max(length, 0.0)
    cells = abs(length) * options.resolution / (2 * HALF_BOX * size)
    if shell and cells < CELLS_IN_WALL:
        enough = math.ceil(CELLS_IN_WALL * 2 * HALF_BOX * size / abs(length))
        raise InputError(
            f"--by {by}: a wall of {cells:.2f} cells, too few to close; take a thicker one, or --resolution {enough}"
        )
    fields, frame = in_one_frame([_measured(operand, options, say)], margin=max(length, 0.0))
    check_mesh_path(out, frame, centered=options.center)
    reach = length / frame.scale
    field = Shell(*fields, inside=max(-reach, 0.0), outside=max(reach, 0.0)) if shell else Offset(*fields, by=reach)
    return _written(out, _extracted(field, options, f"{operand.name} by {by}", level=0), frame, options, say)


def _read(part: str | Path, options: SolidOptions) -> Operand:
    """A run, a checkpoint or a closed mesh."""
    name = str(part)
    if is_field(part):
        file = find_field(part)
        field, similarity, metadata = load_still(file, options.time)
        level = chosen_level(field, file, options.level)
        support = None
        if not options.keep_unsupported and options.time is None:
            support = read_support(file, metadata.get("run", {}), level)
        learned = next(field.parameters(), None) is not None
        return Operand(name, WorldField(Bounded(field) if learned else field, similarity), support)
    surface = read_surface(part)
    if not len(surface.faces):
        raise InputError(f"{part}: a cloud has no inside; fit it first (mplicits fit {part} -o RUN)")
    if not is_closed(surface):
        raise InputError(f"{part}: is not closed, so that it has no inside; fit it first (mplicits fit {part} -o RUN)")
    return Operand(name, _as_solid(surface, Similarity.to_unit_sphere(surface.used_vertices()), name), None)


def _as_solid(surface: Mesh, similarity: Similarity, name: str) -> WorldField:
    try:
        return WorldField(MeshField(surface.moved(similarity)), similarity)
    except ValueError as error:
        raise InputError(f"{name}: {str(error).removeprefix('surface: ')}") from error


def _measured(operand: Operand, options: SolidOptions, say: Callable[[str], None] | None) -> WorldField:
    """The exact distance to the surface of an operand, in its own frame."""
    if isinstance(operand.shape.field, MeshField):
        return operand.shape
    mesh = _extracted(operand.shape.field, options, operand.name)
    mesh = _supported(mesh, [operand], [operand.shape.field], operand.shape.similarity, say)
    similarity = operand.shape.similarity
    return _as_solid(dataclasses.replace(mesh, vertices=similarity.to_input(mesh.vertices)), similarity, operand.name)


def _extracted(field: Field, options: SolidOptions, what: str, level: int | None = None) -> Mesh:
    """The mesh of a level, in the coordinates of the field."""
    level = options.level if level is None else level
    level = field.num_levels - 1 if level is None else min(level, field.num_levels - 1)
    box = ((-HALF_BOX, -HALF_BOX, -HALF_BOX), (HALF_BOX, HALF_BOX, HALF_BOX))
    with surface_needed(f"{what}: nothing is left"):
        return extract_mesh(field, resolution=options.resolution, level=level, bounds=box)


def _supported(
    mesh: Mesh,
    operands: Sequence[Operand],
    fields: Sequence[Field],
    frame: Similarity,
    say: Callable[[str], None] | None,
) -> Mesh:
    """The mesh without the blobs of runs; what is on the surface of an operand without support rests on that."""
    points: list[NDArray[np.float64]] = []
    radius = 0.0
    for operand in operands:
        if operand.support is not None:
            unit = operand.shape.similarity
            points.append(frame.to_unit(unit.to_input(operand.support.points)))
            radius = max(radius, operand.support.radius * unit.scale / frame.scale)
    if not points:
        return mesh
    away = np.stack([_distances(field, mesh.vertices) for field in fields])
    trusted = np.array([operand.support is None for operand in operands])
    points.append(mesh.vertices[trusted[away.argmin(axis=0)]])
    return without_blobs(mesh, np.concatenate(points), radius, say)


@torch.no_grad()
def _distances(field: Field, points: NDArray[np.float64]) -> NDArray[np.float64]:
    rows = torch.from_numpy(points).to(field.like)
    return torch.cat([field.value(part).abs().double() for part in rows.split(1 << 18)]).numpy()


def _made(mesh: Mesh, frame: Similarity) -> Made:
    """The mesh in input coordinates, and its report."""
    placed = dataclasses.replace(mesh, vertices=frame.to_input(mesh.vertices))
    return Made(placed, is_closed(mesh), volume(mesh) * frame.scale**3)


def _written(
    out: str | Path, mesh: Mesh, frame: Similarity, options: SolidOptions, say: Callable[[str], None] | None
) -> Made:
    placement = placement_of(options.up, options.unit, options.center)
    if (line := placement.describe(Path(out).suffix)) is not None and say is not None:
        say(f"coordinates: {line}")
    write_mesh(out, mesh, frame, placement)
    return _made(mesh, frame)
