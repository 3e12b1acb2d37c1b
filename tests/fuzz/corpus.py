"""Small whole files of every kind that the package reads, and what reads each."""

import json
import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pycolmap
import torch
from mplicits import datasets
from mplicits.neural_fields import MultiscaleSDF, Siren, load_field, save_field
from mplicits.neural_fields.backend.files import write_json
from mplicits.neural_fields.meshing.glb import write_glb
from mplicits.pipelines.training.folder import RECORD_FILE, STATE_FILE, load_state, read_record, save_state
from mplicits.pipelines.training.settings import FitConfig, load_config
from mutate import damaged, damaged_json

Damage = Callable[[bytes, random.Random], bytes]

# And two points more, for there must be ten at least to be a cloud.
CUBE = np.array(
    [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)] + [[0.5, 0.5, 2], [0.5, 2, 0.5]]
)
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = np.concatenate((QUADS[:, :3], QUADS[:, [0, 2, 3]], [[0, 8, 9], [7, 9, 8]]))


@dataclass(frozen=True)
class Specimen:
    """A whole file, and how it is read."""

    name: str  # from the folder that it lies in; the part before a ``/`` tells specimens apart
    data: bytes
    read: Callable[[Path], object]  # of its path
    beside: dict[str, bytes] = field(default_factory=dict)  # other files of the same folder, by name
    damage: Damage = damaged


def specimens() -> list[Specimen]:
    """All of them; the same bytes whenever they are made."""
    with TemporaryDirectory() as folder:
        return [*_clouds(Path(folder)), *_meshes(Path(folder)), *_views(Path(folder)), *_runs(Path(folder))]


def _clouds(folder: Path) -> Iterator[Specimen]:
    random_ = np.random.default_rng(0)
    points = random_.normal(size=(40, 3)).round(4)
    normals = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    colors = random_.uniform(size=(40, 3)).astype(np.float32)
    cloud = datasets.PointCloud(points, normals, colors, "cloud")
    datasets.write_cloud_ply(folder / "cloud.ply", cloud)
    yield Specimen("cloud.ply", (folder / "cloud.ply").read_bytes(), datasets.read_cloud)
    rows = "\n".join(" ".join(f"{value:g}" for value in row) for row in np.hstack((points, normals)))
    yield Specimen("cloud.xyz", rows.encode(), datasets.read_cloud)
    yield Specimen("prepared.xyz", rows.encode(), lambda path: datasets.prepare_cloud(datasets.read_cloud(path)))
    yield Specimen("cloud.csv", ("x,y,z,nx,ny,nz\n" + rows.replace(" ", ",")).encode(), datasets.read_cloud)
    for order, name in (("<", "little"), (">", "big"), ("", "ascii")):
        for polygons, label in ((FACES, "even"), (list(QUADS[:3]) + list(FACES[6:]), "uneven")):
            yield Specimen(f"{label}_{name}.ply", _mesh_ply(order, polygons), datasets.read_cloud)
    np.save(folder / "cloud.npy", np.hstack((points, normals)))
    np.savez_compressed(folder / "cloud.npz", points=points, normals=normals, colors=colors)
    for name in ("cloud.npy", "cloud.npz"):
        yield Specimen(name, (folder / name).read_bytes(), datasets.read_cloud)
    import laspy

    for form, version, names in ((3, "1.2", ("cloud.las", "cloud.laz")), (7, "1.4", ("layered.laz",))):
        las = laspy.create(point_format=form, file_version=version)
        las.x, las.y, las.z = points.T
        las.red, las.green, las.blue = (colors.T * 65535).astype(np.uint16)
        for name in names:
            las.write(folder / name)
            yield Specimen(name, (folder / name).read_bytes(), datasets.read_cloud)
    import pye57

    with patch("uuid.uuid4", return_value="0"):
        scan = pye57.E57(str(folder / "cloud.e57"), mode="w")
        scan.write_scan_raw({f"cartesian{axis}": column for axis, column in zip("XYZ", points.T, strict=True)})
        scan.close()
    yield Specimen("cloud.e57", (folder / "cloud.e57").read_bytes(), datasets.read_cloud)
    for kind in ("ascii", "binary", "binary_compressed"):
        yield Specimen(f"{kind}.pcd", _pcd(kind, np.hstack((points, normals)).astype("<f4")), datasets.read_cloud)


def _pcd(kind: str, rows: np.ndarray) -> bytes:
    head = "VERSION .7\nFIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\n"
    head += f"WIDTH {len(rows)}\nHEIGHT 1\nPOINTS {len(rows)}\nDATA {kind}\n"
    if kind == "ascii":
        return (head + "\n".join(" ".join(f"{value:g}" for value in row) for row in rows)).encode()
    if kind == "binary":
        return head.encode() + rows.tobytes()
    fields = rows.T.tobytes()
    parts = [fields[at : at + 32] for at in range(0, len(fields), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)  # literals only
    return head.encode() + struct.pack("<II", len(packed), len(fields)) + packed


def _mesh_ply(order: str, polygons: Any) -> bytes:
    """A cube with colours and faces; ASCII where there is no byte ``order``."""
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = ["ply", f"format {form} 1.0", "comment a cube", f"element vertex {len(CUBE)}"]
    head += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    head += [f"element face {len(polygons)}", "property list int int vertex_indices", "end_header\n"]
    vertices = [(*vertex, 10, 20, 30) for vertex in CUBE]
    if not order:
        lines = [" ".join(f"{value:g}" for value in row) for row in vertices]
        lines += [" ".join(map(str, (len(polygon), *polygon))) for polygon in polygons]
        return ("\n".join(head) + "\n".join(lines) + "\n").encode()
    body = b"".join(struct.pack(f"{order}3f3B", *row) for row in vertices)
    body += b"".join(struct.pack(f"{order}{1 + len(polygon)}i", len(polygon), *polygon) for polygon in polygons)
    return "\n".join(head).encode() + body


def _meshes(folder: Path) -> Iterator[Specimen]:
    obj = "\n".join(
        [
            "mtllib cube.mtl",
            *("v {:g} {:g} {:g}".format(*vertex) for vertex in CUBE),
            "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl red",
            *("f " + " ".join(f"{corner + 1}/{1 + i}" for i, corner in enumerate(quad)) for quad in QUADS),
        ]
    ).encode()
    material = b"newmtl red\nKd 1 0.2 0.1\nmap_Kd cube.png\n"
    picture = _png(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    yield Specimen("cube.obj", obj, datasets.read_textured, {"cube.mtl": material, "cube.png": picture})
    yield Specimen("points.obj", obj, datasets.read_cloud, {"cube.mtl": material, "cube.png": picture})
    read = _beside(datasets.read_textured, "cube.obj")
    yield Specimen("cube.mtl", material, read, {"cube.obj": obj, "cube.png": picture})
    yield Specimen("cube.png", picture, read, {"cube.obj": obj, "cube.mtl": material})
    yield Specimen("cube.ply", _mesh_ply("<", FACES), datasets.read_textured)
    corners = CUBE[FACES].astype("<f4")
    off = [f"OFF\n{len(CUBE)} {len(FACES)} 0", *("{:g} {:g} {:g}".format(*vertex) for vertex in CUBE)]
    off += ["3 {} {} {}".format(*face) for face in FACES]
    yield Specimen("cube.off", "\n".join(off).encode(), datasets.read_cloud)
    facets = b"".join(struct.pack("<12fH", 0, 0, 1, *triangle.reshape(-1), 0) for triangle in corners)
    yield Specimen("cube.stl", b"\0" * 80 + struct.pack("<I", len(corners)) + facets, datasets.read_cloud)
    lines = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join("vertex {:g} {:g} {:g}\n".format(*corner) for corner in triangle)
        + "endloop\nendfacet\n"
        for triangle in corners
    )
    yield Specimen("words.stl", f"solid cube\n{lines}endsolid cube\n".encode(), datasets.read_cloud)
    color = np.full((len(CUBE), 3), 0.5, np.float32)
    glb = folder / "cube.glb"
    write_glb(glb, FACES, {"POSITION": CUBE.astype(np.float32), "COLOR_0": color})
    yield Specimen("cube.glb", glb.read_bytes(), datasets.read_textured)
    yield Specimen("described.glb", glb.read_bytes(), datasets.read_textured, damage=_within_glb)


def _write_colmap_text(folder: Path, images: datasets.PosedImages) -> None:
    datasets.write_colmap(folder, images)
    model = folder / "sparse" / "0"
    pycolmap.Reconstruction(model).write_text(model)
    for file in model.glob("*.bin"):
        file.unlink()


def _views(folder: Path) -> Iterator[Specimen]:
    images = datasets.render_scene(datasets.SCENES["painted-sphere"](), 2, 12, samples=1)
    for name, write, chosen in (
        ("neus", datasets.write_neus, ("cameras_sphere.npz",)),
        ("transforms", datasets.write_transforms, ("transforms.json",)),
        ("binary", datasets.write_colmap, ("cameras.bin", "images.bin", "points3D.bin")),
        ("text", _write_colmap_text, ("cameras.txt", "images.txt", "points3D.txt")),
    ):
        write(folder / name, images)
        files = {p.relative_to(folder / name).as_posix(): p.read_bytes() for p in (folder / name).rglob("*.*")}
        for file, data in files.items():
            if Path(file).name in chosen:
                beside = {other: content for other, content in files.items() if other != file}
                yield Specimen(file, data, _above(datasets.read_posed_images, file), beside)
                if file.endswith(".json"):
                    yield Specimen(file, data, datasets.read_cameras, beside, _as_json)
    depth = np.full((6, 8), 1000, np.uint16)
    yield Specimen("depth.png", _png(depth), lambda path: datasets.read_depth(path, scale=1000.0))
    lens = {"width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 3.5, "cy": 2.5}
    yield Specimen("lens.json", json.dumps(lens).encode(), datasets.read_intrinsics)
    yield Specimen("lens.json", json.dumps(lens).encode(), datasets.read_intrinsics, damage=_as_json)
    log = "".join(f"{i} {i} 0\n" + "\n".join(" ".join(map(str, row)) for row in np.eye(4)) + "\n" for i in range(3))
    yield Specimen("poses.log", log.encode(), datasets.read_poses)
    tum = "".join(f"{i}.5 {i} 0 0 0 0 0 1\n" for i in range(3))
    yield Specimen("tum.txt", tum.encode(), datasets.read_poses)


def _runs(folder: Path) -> Iterator[Specimen]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sdf = MultiscaleSDF(Siren(8, 1), [Siren(8, 2)], deltas=[0.1])
    save_field(folder / "field.safetensors", sdf, metadata={"run": {"cloud": "cloud.ply", "finished": True}})
    data = (folder / "field.safetensors").read_bytes()
    yield Specimen("field.safetensors", data, load_field)
    yield Specimen("described.safetensors", data, load_field, damage=_within_safetensors)
    save_state(folder / STATE_FILE, {"a": torch.arange(5.0)}, {"fingerprint": "x", "step": 3})
    state = (folder / "resume.safetensors").read_bytes()
    yield Specimen("resume.safetensors", state, _above(load_state, "resume.safetensors"))
    record = {"config": {"seed": 0}, "cloud": "cloud.ply", "finished": True, "levels": [{"loss": 0.1}], "time": 1.5}
    write_json(folder / RECORD_FILE, record)
    written = (folder / "run.json").read_bytes()
    yield Specimen("run.json", written, _above(read_record, "run.json"))
    yield Specimen("run.json", written, _above(read_record, "run.json"), damage=_as_json)
    settings = b"seed: 1\nbatch: 500\nsteps: [100, 200, 300]\nlevels: 2\n"
    yield Specimen("fit.yaml", settings, partial(load_config, FitConfig))


def _png(pixels: np.ndarray) -> bytes:
    import cv2

    return cv2.imencode(".png", pixels)[1].tobytes()


def _beside(read: Callable[[Path], object], name: str) -> Callable[[Path], object]:
    return lambda path: read(path.parent / name)


def _above(read: Callable[[Path], object], file: str) -> Callable[[Path], object]:
    """Read the folder that ``file`` lies in, at whatever depth."""
    return lambda path: read(path.parents[len(Path(file).parts) - 1])


def _as_json(data: bytes, chance: random.Random) -> bytes:
    return json.dumps(damaged_json(json.loads(data), chance)).encode()


def _within_glb(data: bytes, chance: random.Random) -> bytes:
    """Damage to the description alone, in a file whose lengths fit."""
    (length,) = struct.unpack_from("<I", data, 12)
    text = _as_json(data[20 : 20 + length].rstrip(b" \0"), chance)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + rest


def _within_safetensors(data: bytes, chance: random.Random) -> bytes:
    """Damage to our own description within the head."""
    return described_anew(data, lambda described: damaged_json(described, chance))


def described_anew(data: bytes, change: Callable[[Any], Any]) -> bytes:
    """A safetensors file with another description within the head, whose lengths fit."""
    (length,) = struct.unpack_from("<Q", data)
    head = json.loads(data[8 : 8 + length])
    (form,) = head["__metadata__"]
    head["__metadata__"][form] = json.dumps(change(json.loads(head["__metadata__"][form])))
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data[8 + length :]
