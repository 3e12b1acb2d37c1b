"""From a run to a mesh file: extract, clean up, write."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets import read_cloud
from ...datasets.clouds.point_cloud import unit_rows
from ...datasets.clouds.readers.meshes import vertex_normals
from ...neural_fields import Field, InputError, Mesh
from ...neural_fields.backend.devices import upload
from ...neural_fields.meshing.extract import extract_mesh, map_normals, surface_needed
from ...neural_fields.tracing.sphere import map_attribute
from ..surface.surface import Support, in_region, keep_largest, read_support, trim_distance, visible_part, without_blobs
from ..texture.transport import Colors, colors_of_run
from ..training.folder import chosen_level, find_field, fitted_cloud, load_still
from .atlas import Decimation, check_tools, decimated
from .bake import check_texture_size, textured_mesh
from .files import check_mesh_path, check_textured_path, placement_of, write_mesh
from .printing import PrintReport, print_report

# Cells per side that are tried, coarse to fine. The work grows with the square: the last is 16 times the first.
RESOLUTIONS = (256, 512, 1024)
# Less of the points than this is an edge or a tip, not a part.
THIN_SHARE = 0.02


class Fineness(NamedTuple):
    """The fewest cells per side, of those tried, that show thin parts; the share of points missed by the first."""

    resolution: int
    missed: float


@torch.no_grad()
def thin_share(field: Field, points: NDArray[np.floating], resolution: int, *, level: int = -1) -> float:
    """The share of points ``(N, 3)`` on parts thinner than √3 cells; the mesher's box has a side of 2.04.

    A plate as thick as one cell has a corner inside on each line along the axis nearest to its normal; the diagonal
    leaves room for bars and errors.

    Each point is moved onto the surface by x = p − f n / |∇f|, n = ∇f / |∇f|. With d of √3 cells, its part is thin if
    x − n d / 4 is inside and x − n d outside; a point whose x − n d / 4 is outside was not on the surface.
    """
    depth = 3**0.5 * 2.04 / resolution
    asked = torch.from_numpy(np.asarray(points[:: 1 + len(points) // 20_000], np.float32))
    places = upload(asked, field.like.device)
    jet = field.jet(places, level=level)
    slope = jet.gradient.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normal = jet.gradient / slope
    x = places - (jet.value[..., None] / slope).clamp(-depth, depth) * normal
    inside, beyond = (field.value(x - s * normal, level=level) for s in (depth / 4, depth))
    return float(((inside < 0) & (beyond >= 0)).float().mean())


def fineness(field: Field, points: NDArray[np.floating], *, level: int = -1) -> Fineness:
    """The resolution at which hardly any points ``(N, 3)`` lie on parts too thin for it; else the last one."""
    first, *finer, last = RESOLUTIONS
    missed = thin_share(field, points, first, level=level)
    if missed <= THIN_SHARE:
        return Fineness(first, missed)
    fit = (each for each in finer if thin_share(field, points, each, level=level) <= THIN_SHARE)
    return Fineness(next(fit, last), missed)


@dataclass(frozen=True)
class SurfaceOptions:
    """What of a run becomes a surface.

    Attributes:
        resolution: cells along each side of the cube around the unit sphere; None is 256, or up to 1024 where a run has
            parts too thin for that (see `fineness`).
        time: the moment, for a surface that moves.
        level: counted from 0, the coarsest; None is the finest.
        colors: whether vertices get the colours of the run's texture, if it has one.
        keep_unsupported: whether to keep components that no input points support.
        up: the axis that points up in the input, "y" or "z"; see `Placement`, as for ``unit`` ("mm").
    """

    resolution: int | None = None
    time: float | None = None
    level: int | None = None
    colors: bool = True
    keep_unsupported: bool = False
    up: str | None = None
    unit: str | None = None


@dataclass(frozen=True)
class MeshOptions(SurfaceOptions):
    """How to mesh a run.

    Attributes:
        normal_level: level of the normals (neural normal mapping); None is ``level``.
        texture: bake colours and the finest normals into images; texels along each side (.glb or .obj).
        texture_faces: triangles to keep of a mesh that is unwrapped.
        faces: triangles to keep of one that is not; None keeps all.
        report: whether to look at the mesh as a printer would; None does so for STL.
        seen: whether to leave out what is visible in fewer than two photographs, for a run of ``reconstruct``.
        keep_largest: whether to keep only the component of largest area.
        trim_distance: drop faces further than this from the points, in input units.
        cloud: the points for that; by default the file that was fitted.
        center: whether the middle of the mesh goes to the origin; see `Placement`.
    """

    normal_level: int | None = None
    texture: int | None = None
    texture_faces: int = 50_000
    faces: int | None = None
    report: bool | None = None
    seen: bool = False
    keep_largest: bool = False
    trim_distance: float | None = None
    cloud: str | Path | None = None
    center: bool = False


class Exported(NamedTuple):
    """A written mesh in unit-sphere coordinates, the cost of its decimation in input units, a printer's report."""

    mesh: Mesh
    decimation: Decimation | None = None
    printing: PrintReport | None = None

    def record(self) -> dict[str, Any]:
        """The figures, for JSON."""
        parts = {"decimation": self.decimation, "printing": self.printing}
        counts = {"vertices": len(self.mesh.vertices), "faces": len(self.mesh.faces)}
        return counts | {name: None if part is None else dataclasses.asdict(part) for name, part in parts.items()}


def mesh_run(
    run: str | Path, out: str | Path, options: MeshOptions | None = None, *, say: Callable[[str], None] | None = None
) -> Mesh:
    """The mesh that `export_run` writes, in unit-sphere coordinates; arguments and errors are the same."""
    return export_run(run, out, options, say=say).mesh


def export_run(
    run: str | Path, out: str | Path, options: MeshOptions | None = None, *, say: Callable[[str], None] | None = None
) -> Exported:
    """Extract the surface of a run and write it in the coordinates of its input, or as `Placement` says.

    ``say`` is called with a line about removed parts, about changed coordinates and about a decimation.

    Raises:
        InputError: there is no such run or level, it has no surface, the file cannot be written or is the run's cloud,
            or an option does not go with another.
    """
    options, say = options or MeshOptions(), say or (lambda _: None)
    check = check_mesh_path if options.texture is None else check_textured_path
    check(out)
    placement = placement_of(options.up, options.unit, options.center)
    if options.texture is not None:
        check_texture_size(options.texture)
        if options.faces is not None or options.report:
            given = "--faces" if options.faces is not None else "--report"
            raise InputError(f"{given}: goes with a mesh without --texture; --texture-faces says how many it keeps")
    if options.faces is not None:
        check_tools("--faces", "fast_simplification")
    file = find_field(run)
    field, similarity, metadata = load_still(file, options.time)
    clouds = [metadata.get("run", {}).get(name) for name in ("cloud", "cloud_from_run")]
    if any(cloud and (file.parent / cloud).resolve() == Path(out).resolve() for cloud in clouds):
        raise InputError(f"{out}: is the cloud that the run was fitted to; name another file")
    check(out, similarity, centered=placement.center)  # again: not every format can hold every place
    level = chosen_level(field, file, options.level)
    normal_level = chosen_level(field, file, options.normal_level, otherwise=level, flag="--normal-level")
    support = None if options.time is not None else read_support(file, metadata.get("run", {}), level)
    if options.seen and (support is None or not support.visible):
        raise InputError(f"--seen: {file} keeps no place that two photographs see; runs of `mplicits reconstruct` do")
    points = None
    if options.trim_distance is not None:
        columns = metadata.get("run", {}).get("config", {}).get("columns") if options.cloud is None else None
        source = options.cloud or fitted_cloud(file, metadata, remedy="name it with --cloud FILE")
        cloud = read_cloud(source, columns=columns)
        points = similarity.to_unit(cloud.points[np.isfinite(cloud.points).all(axis=1)])
    resolution = chosen_resolution(field, options.resolution, support, level, say)
    with surface_needed(f"{file}: no surface to mesh"):
        mesh = extract_mesh(field, resolution=resolution, level=level)
    if "region" in metadata.get("run", {}) and (mesh := in_region(mesh)) is None:
        raise InputError(f"{file}: no surface in the region of interest; train it longer (--steps)")
    if support is not None and not options.keep_unsupported:
        mesh = without_blobs(mesh, support.points, support.radius, say)
    if support is not None and support.visible:
        mesh = _visible(mesh, support, say, cut=options.seen)
    if normal_level != level:
        mesh = map_normals(mesh, field, level=normal_level)
    if points is not None and options.trim_distance is not None:
        mesh = trim_distance(mesh, points, options.trim_distance / similarity.scale)
    if options.keep_largest:
        mesh = keep_largest(mesh)
    decimation = None
    if options.faces is not None:
        mesh, decimation = decimated(mesh, options.faces, unit=similarity.scale)
        mesh = dataclasses.replace(mesh, normals=_unit_normals(field, mesh, level=normal_level))
        say(decimation.describe(options.unit or "input units"))
    colors = colors_of_run(file, field, options.time) if options.colors else None
    if (line := placement.describe(Path(out).suffix)) is not None:
        say(f"coordinates: {line}")
    if options.texture is not None:
        mapped = field.num_levels - 1 if options.normal_level is None else normal_level
        colors_at = None if colors is None else functools.partial(evaluated, colors)
        normals_at = functools.partial(normals_near, field, level=mapped)
        size, faces = options.texture, options.texture_faces
        baked = (mesh, similarity, colors_at, normals_at)
        return Exported(textured_mesh(out, *baked, size=size, faces=faces, placement=placement))
    if colors is not None:
        mesh = dataclasses.replace(mesh, colors=evaluated(colors, mesh.vertices))
    write_mesh(out, mesh, similarity, placement)
    suffix, printing = Path(out).suffix.lower(), None
    if options.report or (options.report is None and suffix == ".stl"):
        printing = print_report(mesh, field, similarity, placement, suffix, level=level)
    return Exported(mesh, decimation, printing)


def chosen_resolution(
    field: Field, asked: int | None, support: Support | None, level: int, say: Callable[[str], None]
) -> int:
    """Cells per side; ``say`` is called with a warning if parts are too thin for them."""
    if support is None or support.visible:
        return asked or RESOLUTIONS[0]
    if asked is None:
        chosen = fineness(field, support.points, level=level)
        if chosen.resolution != RESOLUTIONS[0]:
            say(
                f"{chosen.missed:.0%} of the points lie on parts thinner than the cells of {RESOLUTIONS[0]} per side: "
                f"taken are {chosen.resolution} (--resolution takes another number)"
            )
        return chosen.resolution
    missed = thin_share(field, support.points, asked, level=level)
    if missed > THIN_SHARE and asked < RESOLUTIONS[-1]:
        say(
            f"{missed:.0%} of the points lie on parts thinner than the cells of --resolution {asked}, and may come out "
            f"torn; leave it out, or take {RESOLUTIONS[-1]}"
        )
    return asked


def _visible(mesh: Mesh, support: Support, say: Callable[[str], None], *, cut: bool) -> Mesh:
    """The part of a mesh that is visible in the photographs, with ``cut``; ``say`` is called if much is not."""
    part, missed = visible_part(mesh, support)
    if not cut or part is None:
        if missed > 0.05:
            say(f"{missed:.0%} of the surface is visible in fewer than two photographs; --seen leaves it out")
        return mesh
    if missed > 0:
        say(f"left out {missed:.2g} of the area, which is visible in fewer than two photographs")
    return part


def evaluated(colors: Colors, points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours ``(N, 3)`` at points ``(N, 3)``."""
    return colors(torch.from_numpy(points).float()).numpy()


@torch.no_grad()
def normals_near(field: Field, points: NDArray[np.float64], *, level: int) -> NDArray[np.float32]:
    """Neural normal mapping: the gradients ``(N, 3)`` of a level at points of a mesh nearby; zero far from any surface.

    Finer levels differ from coarser ones only in their bands, which a coarse or decimated mesh may leave. Its points
    there take the gradient at the nearest point of the surface.
    """
    # Outside the band of a level i all finer ones are f_i, and |f_i| ≥ δ_i: so |f| below every δ is inside all bands.
    delta = float(field.deltas[:level].min()) if level else math.inf
    rows = torch.from_numpy(points).float()
    mapped = map_attribute(field, lambda x: field.jet(x, level=level).gradient, rows, delta=delta, level=level)
    return mapped.values.numpy()


def _unit_normals(field: Field, mesh: Mesh, *, level: int) -> NDArray[np.float32]:
    """The field's normals at the vertices of a mesh near its surface; those of the faces where it has none."""
    normals = normals_near(field, mesh.vertices, level=level)
    lost = ~normals.any(axis=1)
    normals[lost] = vertex_normals(mesh.vertices, mesh.faces.astype(np.int64))[lost]
    return unit_rows(normals).astype(np.float32)
