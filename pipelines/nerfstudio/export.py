"""``ns-mplicits-export``: the surface of a nerfstudio training as a mesh with colours, where its data are."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ...datasets.cameras import Camera, intrinsics
from ...neural_fields import InputError, Mesh, NerfstudioField, NoSurfaceError, Similarity
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.meshing.mesh import check_mesh_path
from ..mesh.bake import check_texture_size, textured_mesh
from ..mesh.extract import normals_near
from ..mesh.files import check_textured_path
from ..reconstruct.views import visible_points
from ..surface.surface import Support, visible_part

Move = tuple[Float64, float]  # (3, 4) and a scale: see `in_data_coordinates`


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; 0 when the file is written, 2 with one line for what was wrong."""
    parser = argparse.ArgumentParser("ns-mplicits-export", description=__doc__)
    parser.add_argument("--load-config", type=Path, required=True, help="config.yml of the training")
    parser.add_argument("--output-path", type=Path, required=True, help="PLY, OBJ, STL or GLB")
    parser.add_argument("--resolution", type=int, default=512, help="cells along the longest side of the scene box")
    parser.add_argument("--seen", action="store_true", help="leave out what is visible in fewer than two photographs")
    parser.add_argument("--texture", type=int, metavar="N", help="colours and normals as images of N × N (GLB, OBJ)")
    parser.add_argument("--texture-faces", type=int, default=50_000, help="triangles below the texture")
    parser.add_argument("--level", type=int, default=-1, help="of detail, 0 the coarsest, -1 the finest")
    options = parser.parse_args(arguments)
    try:
        mesh = export_mesh(
            *(options.load_config, options.output_path, options.resolution),
            level=options.level,
            seen=options.seen,
            texture=options.texture,
            faces=options.texture_faces,
        )
    except (InputError, NoSurfaceError, ValueError) as error:
        print(f"ns-mplicits-export: error: {error}", file=sys.stderr)
        return 2
    print(f"{options.output_path}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles")
    return 0


def export_mesh(
    config: Path,
    path: Path,
    resolution: int = 512,
    *,
    level: int = -1,
    seen: bool = False,
    texture: int | None = None,
    faces: int = 50_000,
) -> Mesh:
    """Mesh the last checkpoint of a training, colour it and write it, in the coordinates of the data set.

    Arguments are those of the command, see `main`; ``seen`` ignores masks.

    Returns:
        The mesh as written: with vertex colours, or with ``texture`` the decimated one below its images.

    Raises:
        InputError: there is no such training, it is not one of ours, or the file cannot be written, which is found
            before the training is read.
        NoSurfaceError: there is no surface in the scene box.
        ValueError: there is no such level.
    """
    if not config.is_file():
        raise InputError(f"{config}: no such file; expected the config.yml that ns-train wrote")
    if texture is None:
        check_mesh_path(path)
    else:
        check_textured_path(path)
        check_texture_size(texture)
    from nerfstudio.utils.eval_utils import eval_setup  # pyright: ignore[reportMissingImports]

    _, pipeline, _, _ = eval_setup(config, test_mode="inference")
    field = pipeline.model.field
    if not isinstance(field, NerfstudioField):
        raise InputError(f"{config}: trained by another method; expected mplicits or mplicits-facto")
    outputs = pipeline.datamanager.train_dataparser_outputs
    move = np.asarray(outputs.dataparser_transform, np.float64), float(outputs.dataparser_scale)
    mesh = field.mesh(resolution, level=level, normals=texture is None)
    if seen:
        mesh = visible_mesh(mesh, field, host_cameras(outputs.cameras))
    if texture is not None:
        mesh = in_data_coordinates(mesh, *move)
        return _textured(path, mesh, field.cpu(), move, texture, faces, level % field.field.num_levels)
    mesh = in_data_coordinates(colored(mesh, field), *move)
    mesh.export(path)
    return mesh


def _textured(path: Path, mesh: Mesh, field: NerfstudioField, move: Move, size: int, faces: int, level: int) -> Mesh:
    """Write a mesh in the data's coordinates with images of the field's colours and normals."""
    rotation = move[0][:, :3]

    def colors_at(points: Float64) -> NDArray[np.float32]:
        return _colors(field, _moved(points, *move))

    def normals_at(points: Float64) -> NDArray[np.float64]:
        return normals_near(field.field, _moved(points, *move) * field.scale, level=level) @ rotation

    return textured_mesh(path, mesh, Similarity.identity(), colors_at, normals_at, size=size, faces=faces)


@torch.no_grad()
def _colors(field: NerfstudioField, points: Float64) -> NDArray[np.float32]:
    """Colours ``(N, 3)`` that surface points ``(N, 3)`` have when they are seen from the front."""
    x = torch.from_numpy(points).to(field.field.like)
    return torch.cat([field.frontal_colors(part) for part in x.split(1 << 14)]).float().cpu().numpy()


def colored(mesh: Mesh, field: NerfstudioField) -> Mesh:
    """A mesh in nerfstudio's coordinates with the colours that the surface has when it is seen from the front."""
    return dataclasses.replace(mesh, colors=_colors(field, mesh.vertices))


def host_cameras(cameras: Any) -> list[Camera]:
    """Those of nerfstudio's ``Cameras``, in its coordinates, as pinholes: a lens moves what is seen by little.

    Its cameras look along −z with y up, and count pixels from the corner of the first one.
    """
    lens = [getattr(cameras, name).flatten().tolist() for name in ("fx", "fy", "cx", "cy", "width", "height")]
    found = []
    for pose, fx, fy, cx, cy, width, height in zip(cameras.camera_to_worlds.double().cpu(), *lens, strict=True):
        world_from_camera = torch.eye(4, dtype=torch.float64)
        world_from_camera[:3] = pose * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
        left, _, right = torch.linalg.svd(world_from_camera[:3, :3])  # its float32 axes are at right angles to 1e-6
        world_from_camera[:3, :3] = left @ right
        found.append(Camera(intrinsics(fx, fy, cx - 0.5, cy - 0.5), world_from_camera, int(width), int(height)))
    return found


def visible_mesh(mesh: Mesh, field: NerfstudioField, cameras: Sequence[Camera]) -> Mesh:
    """The part of a mesh that is visible in at least two cameras; all in nerfstudio's coordinates.

    Raises:
        NoSurfaceError: nothing of it.
    """
    unit = Similarity((0.0, 0.0, 0.0), 1 / field.scale)
    points, within = visible_points(field.field, [(camera.moved(unit), None) for camera in cameras])
    part = None
    if len(points):
        moved = dataclasses.replace(mesh, vertices=mesh.vertices * field.scale)
        part, _ = visible_part(moved, Support(points.numpy(), within, visible=True))
    if part is None:
        raise NoSurfaceError("no two photographs see any of it; leave out --seen")
    return dataclasses.replace(part, vertices=part.vertices / field.scale)


def in_data_coordinates(mesh: Mesh, transform: ArrayLike, scale: float) -> Mesh:
    """Undo x ↦ scale · (R x + t), by which nerfstudio has moved the data's cameras.

    Args:
        mesh: in nerfstudio's coordinates.
        transform: ``(3, 4)``, R a rotation and t beside it.
        scale: a number above 0.
    """
    matrix = np.asarray(transform, np.float64)
    rotation, shift = matrix[:, :3], matrix[:, 3]
    # Rows: R⁻¹ (x − t) is (x − t) R for a rotation.
    vertices = (mesh.vertices / float(scale) - shift) @ rotation
    normals = None if mesh.normals is None else (mesh.normals @ rotation).astype(np.float32)
    return dataclasses.replace(mesh, vertices=vertices, normals=normals)


def _moved(points: Float64, transform: Float64, scale: float) -> Float64:
    """Nerfstudio's scale · (R x + t)."""
    return scale * (points @ transform[:, :3].T + transform[:, 3])


if __name__ == "__main__":
    sys.exit(main())
