"""``read_cloud``: every format gives back what was written, and bad files give one line."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from mplicits.datasets import PointCloud, read_cloud, write_cloud_ply
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.datasets.clouds.readers.las import coordinate_system
from mplicits.datasets.clouds.readers.reading import open_stream, read_mesh
from mplicits.neural_fields import InputError
from refusals import refused

COUNT = 12
ASCII = b"ply\nformat ascii 1.0\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"
PLY_KINDS = [{"file_type": "ply", "encoding": encoding} for encoding in ("ascii", "binary")]


@pytest.fixture
def cloud():
    random = np.random.default_rng(3)
    normals = unit_rows(random.normal(size=(COUNT, 3)))
    points = random.normal(size=(COUNT, 3)) + np.array((431234.5678, 5412345.6789, 250.0))
    return PointCloud(points, normals, random.integers(0, 256, (COUNT, 3)) / np.float32(255), "made up")


def same(read, expected, *, points=0.0, normals=1e-7, colors=1e-6):
    for name, bound in (("points", points), ("normals", normals), ("colors", colors)):
        found, wanted = getattr(read, name), getattr(expected, name)
        assert (found is None) == (wanted is None)
        assert found is None or np.abs(found - wanted).max() <= bound


def octasphere():
    """A sphere: mesh normals of its vertices are close to the vertices themselves, and outward."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_written_ply_is_read_back_exactly(tmp_path, cloud):
    path = tmp_path / "cloud.ply"
    write_cloud_ply(path, cloud)
    same(read_cloud(path), cloud)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("faces", [False, True])
def test_ply_with_lists_and_elements_around_the_vertices(tmp_path, cloud, encoding, kind, faces):
    """Ragged list elements before, mixed polygons after, a list inside the vertex, shuffled properties."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    points = cloud.points - cloud.points.mean(axis=0)
    colors = np.rint(cloud.colors * 255).astype(int)
    header = ["ply", f"format {encoding} 1.0", "comment x y z", "element strip 2", "property list uchar int ids"]
    header += [f"element vertex {COUNT}", f"property {kind} z", "property uchar red", "property uchar green"]
    header += ["property uchar blue", f"property {kind} x", f"property {kind} y", "property list uchar short tags"]
    header += ["property float nx", "property float ny", "property float nz"]
    rows = [("BII", 2, 7, 8), ("BI", 1, 9)]
    letter = kind[0]
    for p, c, n in zip(points, colors, cloud.normals, strict=True):
        rows.append((f"{letter}BBB{letter}{letter}Bhh3f", p[2], *c, p[0], p[1], 2, -5, 6, *n))
    if faces:
        header += ["element face 2", "property list uchar int vertex_indices"]
        rows += [("B3i", 3, 0, 1, 2), ("B4i", 4, 0, 1, 2, 3)]
    head = "\n".join([*header, "end_header\n"]).encode()
    if encoding == "ascii":
        body = "\n".join(" ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in r[1:]) for r in rows)
        body = body.encode()
    else:
        body = b"".join(struct.pack(order + row[0], *row[1:]) for row in rows)
    path = tmp_path / "cloud.ply"
    path.write_bytes(head + body)
    expected = PointCloud(points, cloud.normals, cloud.colors)
    same(read_cloud(path), expected, points=0 if kind == "double" else 1e-6)


def test_polygons_are_fans_of_triangles(tmp_path):
    """A unit square and a triangle above it: the quad counts with its whole area."""
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), *((i, 5, 0) for i in range(8))]
    head = ASCII + b"element vertex 12\n" + XYZ + b"element face 2\nproperty list uchar int vertex_index\nend_header\n"
    rows = "\n".join(" ".join(map(str, c)) for c in corners) + "\n4 0 1 2 3\n3 4 5 0\n"
    (tmp_path / "quad.ply").write_bytes(head + rows.encode())
    normals = read_cloud(tmp_path / "quad.ply").normals
    assert np.allclose(normals[1:4], (0, 0, 1))
    assert np.allclose(normals[6:], 0)


def ball(path):
    """The cloud of a file of the ball, whose normals point outward."""
    read = read_cloud(path)
    assert len(np.unique(read.points.round(5), axis=0)) == len(read) == len(octasphere()[0])
    assert (read.normals * read.points).sum(axis=1).min() > 0.98
    return read


def solid(name, vertices, faces):
    corners = ("".join("vertex {} {} {}\n".format(*vertices[k]) for k in face) for face in faces)
    facets = "".join(f"facet normal 0 0 0\n outer loop\n{corner}endloop\nendfacet\n" for corner in corners)
    return f"solid {name}\n{facets}endsolid {name}\n"


@pytest.mark.parametrize("cuts", [[], [50, 100, 200]])
def test_stl_text_of_one_or_more_solids(tmp_path, cuts):
    vertices, faces = octasphere()
    text = "".join(solid("same", vertices, part) for part in np.split(faces, cuts))
    (tmp_path / "a.stl").write_text(text)
    assert ball(tmp_path / "a.stl").normals_source == "mesh"


@pytest.mark.parametrize("kind", [{"file_type": "stl"}, *PLY_KINDS], ids=["stl", "ply, ascii", "ply, binary"])
def test_meshes_without_normals_become_oriented_clouds(tmp_path, kind):
    path = tmp_path / f"a.{kind['file_type']}"
    path.write_bytes(trimesh.Trimesh(*octasphere(), process=False).export(**kind))
    assert ball(path).normals_source == "mesh"


def off(head, rows, faces=()):
    text = "".join(" ".join(f"{x:.17g}" for x in row) + "\n" for row in rows)
    return f"{head}\n# note\n{len(rows)} {len(faces)} 0\n{text}" + "".join("3 {} {} {}\n".format(*f) for f in faces)


def test_off_with_normals_colors_and_faces(tmp_path):
    vertices, faces = octasphere()
    colors = np.random.default_rng(0).integers(0, 256, vertices.shape)
    path = tmp_path / "a.off"
    path.write_text(off("OFF", vertices, faces))
    assert ball(path).colors is None
    path.write_text(off("COFF", np.hstack((vertices, colors, np.full((len(vertices), 1), 255))), faces))
    assert np.allclose(ball(path).colors, colors / 255)
    path.write_text(off("NOFF", np.hstack((vertices, -vertices))))
    assert np.allclose(read_cloud(path).normals, -vertices)
    path.write_text(off("OFF", vertices))
    assert read_cloud(path).normals is None


def test_stl_of_other_programs(tmp_path):
    """Facets on one line, names of solids that look like vertices, and bytes after the last facet."""
    vertices, faces = octasphere()
    facets = solid("", vertices, faces).splitlines()[1:-1]
    (tmp_path / "a.stl").write_text(f"solid vertex 1 2 3 of me\n{' '.join(facets)}\nendsolid\n")
    ball(tmp_path / "a.stl")
    data = trimesh.Trimesh(vertices, faces, process=False).export(file_type="stl")
    for extra in (b"\0\0", b"made by"):
        (tmp_path / "a.stl").write_bytes(data + extra)
        ball(tmp_path / "a.stl")
    (tmp_path / "a.stl").write_bytes(data + data[84:])  # twice the facets of its head
    with refused(tmp_path / "a.stl", "STL"):
        read_cloud(tmp_path / "a.stl")


def test_faces_under_other_names(tmp_path):
    vertices, faces = octasphere()
    rows = "".join("{} {} {}\n".format(*vertex) for vertex in vertices)
    corners = "".join("3 {} {} {}\n".format(*face) for face in faces)
    head = ASCII + f"element vertex {len(vertices)}\n".encode() + XYZ + f"element faces {len(faces)}\n".encode()
    head += b"property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head + (rows + corners).encode())
    ball(tmp_path / "a.ply")
    lines = [f"v {row}" for row in rows.splitlines()] + ["fo {} {} {}".format(*(face + 1)) for face in faces]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    ball(tmp_path / "a.obj")


def test_ply_triangle_strips(tmp_path):
    theta, phi = np.meshgrid(np.linspace(0.1, 3.04, 13), 2 * np.pi * np.arange(24) / 24, indexing="ij")
    vertices = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1).reshape(-1, 3)
    rings = [24 * ring + np.arange(25) % 24 for ring in range(12)]
    items = [item for around in rings for item in (*np.stack((around, around + 24), axis=1).ravel(), -1)]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n".encode() + XYZ
    head += b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    body = vertices.astype("<f4").tobytes() + np.array([len(items), *items], "<i4").tobytes()
    (tmp_path / "a.ply").write_bytes(head + body)
    assert (read_cloud(tmp_path / "a.ply").normals * vertices).sum(axis=1).min() > 0.9


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("kind", ["off", "stl", "obj"])
def test_meshes_in_text_of_any_encoding(tmp_path, kind, end, encoding):
    """A mark before the first word must not hide it: without its first vertex, an OBJ would be another shape."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    text = mesh.export(file_type="stl_ascii" if kind == "stl" else kind)
    if kind == "obj":
        text = text[text.index("v ") :]
    path = tmp_path / f"ball.{kind}"
    path.write_bytes(end.join(text.splitlines()).encode(encoding))
    found, faces = read_mesh(path)
    assert len(found) == len(mesh.vertices)
    corners = found.points[faces] - mesh.vertices[mesh.faces]
    assert np.abs(corners).max() < 1e-6


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_obj_of_mixed_vertices_and_continued_lines(tmp_path, end):
    vertices, faces = octasphere()
    colors = np.random.default_rng(0).random(vertices.shape)
    rows = [" ".join(f"{x:.9g}" for x in ("v", *row)[1:]) for row in np.hstack((vertices, colors))]
    lines = [f"v {row} 1" for row in rows]
    lines[3] = "v {:.9g} {:.9g} {:.9g}".format(*vertices[3])
    lines += ["f \\" + end + "{} {} {}".format(*(face + 1)) for face in faces]
    (tmp_path / "a.obj").write_bytes(end.join([*lines, ""]).encode())
    read = ball(tmp_path / "a.obj")
    assert read.colors[3].tolist() == [1, 1, 1]
    assert np.allclose(np.delete(read.colors, 3, axis=0), np.delete(colors, 3, axis=0), atol=1e-6)


def test_obj_normals_seams_and_colors(tmp_path, cloud):
    """A vertex used with two normals gets their sum; indices may count back; polygons may mix."""
    lines = [f"v {' '.join(map(repr, map(float, [*p, *c])))}" for p, c in zip(cloud.points, cloud.colors, strict=True)]
    lines += ["vt 0 0", "vn 0 0 1", "vn 1 0 0", "f 1/1/1 2/1/1 3/1/1 4/1/1", "f -12/1/2 5/1/2 6/1/2 # last"]
    path = tmp_path / "mesh.obj"
    path.write_text("mtllib none.mtl\n" + "\n".join(lines) + "\n")
    read = read_cloud(path)
    assert np.array_equal(read.points, cloud.points)
    assert np.abs(read.colors - cloud.colors).max() < 1e-6
    assert read.normals[[0, 1, 4, 7]].tolist() == [[1, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 0]]


def write_las(path, points, *, form=0, version="1.2", scale=0.01, **fields):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales, header.offsets = [scale] * 3, points.min(axis=0)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    for name, values in fields.items():
        setattr(las, name, values)
    las.write(path)
    return path


def diagonal(count):
    return np.repeat(np.arange(float(count))[:, None], 3, axis=1)


@pytest.mark.parametrize("extension", ["las", "laz"])
def test_las(tmp_path, cloud, extension):
    red, green, blue = np.rint(cloud.colors.T * 65535).astype(np.uint16)
    path = tmp_path / f"cloud.{extension}"
    write_las(path, cloud.points, form=3, scale=1e-4, red=red, green=green, blue=blue)
    same(read_cloud(path), PointCloud(cloud.points, None, cloud.colors), points=1e-4, colors=1e-4)


@pytest.mark.parametrize("version", ["1.2", "1.4"])
@pytest.mark.parametrize("extension", ["las", "laz"])
def test_las_points_that_are_withheld_or_noise(tmp_path, version, extension):
    marks = {"withheld": np.arange(60) < 10, "classification": np.where(np.arange(60) < 15, 7, 2)}
    path = tmp_path / f"cloud.{extension}"
    write_las(path, diagonal(60), form=1 if version == "1.2" else 6, version=version, **marks)
    for drop, count, said in ((False, 50, "kept (--drop-noise)"), (True, 45, "left out")):
        read, stream = read_cloud(path, drop_noise=drop), open_stream(path, drop_noise=drop)
        pieces = np.concatenate([piece.points for piece in stream.pieces(7)])
        assert len(read) == len(pieces) == count
        assert np.array_equal(pieces, read.points)
        assert read.reading == stream.reading
        assert "10 withheld points left out" in read.reading
        assert f"5 of noise classes {said}" in read.reading


def test_laz_that_the_decompressor_cannot_take(tmp_path):
    """An old stream without chunks, and chunk tables that claim too much or lie elsewhere; see `_check_laz`."""
    path = write_las(tmp_path / "cloud.laz", diagonal(400))
    good = path.read_bytes()
    record, (start,) = good.find(b"laszip encoded") + 52, struct.unpack_from("<I", good, 96)
    (table,) = struct.unpack_from("<q", good, start)
    changes = [(record, "<H", 1), (record + 12, "<I", 0), (table + 4, "<I", 2**32 - 1), (table + 4, "<I", 50)]
    changes += [(start, "<q", place) for place in (2**62, -5, 3, len(good) - 2)]
    changes += [(table + 8 + k, "<B", 255) for k in range(len(good) - table - 8)]
    for at, form, value in changes:
        damaged = bytearray(good)
        struct.pack_into(form, damaged, at, value)
        path.write_bytes(damaged)
        try:
            assert len(read_cloud(path)) == 400
        except InputError as error:
            assert str(error).startswith(f"{path}: not a readable LAS file")  # noqa: PT017


@pytest.mark.parametrize("streamed", [False, True])
def test_laz_that_claims_more_memory_than_it_has_points(tmp_path, streamed):
    """Sizes that the decompressor allocates: of a chunk in points and bytes, of a point's items, of a layer."""
    path = write_las(tmp_path / "cloud.laz", diagonal(400), form=7, version="1.4")
    good = bytearray(path.read_bytes())
    record, (start,) = good.find(b"laszip encoded") + 52, struct.unpack_from("<I", good, 96)
    if streamed:  # the place of the chunk table is at the end
        good += good[start : start + 8]
        good[start : start + 8] = b"\xff" * 8
    path.write_bytes(good)
    assert len(read_cloud(path)) == 400
    claims = [(record + 12, "<I", 2**31), (record + 32, "<H", 1), (record + 32, "<H", 9000), (record + 36, "<H", 9999)]
    claims += [(start + 8 + 36 + 4 + 4 * layer, "<I", 2**32 - 1) for layer in range(10)]
    for at, form, value in claims:
        damaged = bytearray(good)
        struct.pack_into(form, damaged, at, value)
        path.write_bytes(damaged)
        for read in (read_cloud, open_stream):
            with refused(path, "not a readable LAS file"):
                read(path)


@pytest.mark.parametrize(
    ("at", "form", "value", "said"),
    [
        (94, "<H", 60_000, "byte 94: .*60000"),
        (96, "<I", 2**31, "byte 94: .*2147483648"),
        (100, "<I", 2**30, "byte 100: 1073741824 records"),
        (105, "<H", 3, "byte 105: points of 3 bytes"),
        (139, "<d", 0.0, "byte 131: scales"),
        (131, "<d", float("nan"), "byte 131: scales"),
        (235, "<Q", 2**60, "byte 243: .*1152921504606846976"),
        (247, "<Q", 2**40, "1099511627776 points"),
    ],
)
def test_las_headers_that_claim_more_than_the_file_holds(tmp_path, at, form, value, said):
    path = write_las(tmp_path / "cloud.las", diagonal(40), form=6, version="1.4")
    data = bytearray(path.read_bytes())
    assert struct.unpack_from("<HI", data, 94) == (375, 375)
    struct.pack_into("<I", data, 243, 1 if at == 235 else 0)
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)
    for read in (read_cloud, open_stream):
        with refused(path, said):
            read(path)


def test_laz_with_chunks_of_any_length(tmp_path, monkeypatch):
    """As in COPC files, where a chunk holds a node of their octree."""
    laspy, lazrs = pytest.importorskip("laspy"), pytest.importorskip("lazrs")
    layout = SimpleNamespace(new_for_compression=lambda *form: lazrs.LazVlr.new_for_compression(*form, True))
    path, points = tmp_path / "cloud.copc.laz", diagonal(4000)
    header = laspy.LasHeader(point_format=7, version="1.4")
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    with monkeypatch.context() as patch:
        patch.setattr("laspy._compression.lazrsbackend.lazrs", SimpleNamespace(**vars(lazrs) | {"LazVlr": layout}))
        with laspy.open(path, "w", header=header, laz_backend=laspy.LazBackend.Lazrs) as writer:
            for part in np.split(np.arange(4000), (1, 700, 3000)):
                writer.write_points(las.points[part])
                writer.point_writer.compressor.finish_current_chunk()
    with laspy.open(path) as reader:
        assert lazrs.LazVlr(reader.header.vlrs.get("LasZipVlr")[0].record_data).uses_variable_size_chunks()
    pieces = np.concatenate([piece.points for piece in open_stream(path).pieces(333)])
    assert np.array_equal(pieces, points)
    assert np.array_equal(read_cloud(path).points, points)


def test_a_dense_laz_is_no_wrong_claim(tmp_path):
    x, y = (axis.ravel() for axis in np.mgrid[:300, :300])
    path = write_las(tmp_path / "plane.laz", np.stack((x, y, np.zeros(len(x))), axis=1), form=3)
    assert len(read_cloud(path)) == 90_000


def test_missing_laspy_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    with pytest.raises(InputError, match=r"mplicits\[las\]"):
        read_cloud(tmp_path / "cloud.las")


HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 20\n"
GRID = "\n".join(f"{i} {i * i} 1" for i in range(20))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.plx", b"x", r"unknown extension '\.plx'; did you mean \.ply\?"),
        ("a.ply", b"", "the file is empty"),
        ("a.ply", b"solid thing", "not a PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "end_header is missing"),
        ("a.ply", HEADER + XYZ + b"end_header\n" + bytes(100), "vertex: the file ends before its 20 rows"),
        ("a.ply", HEADER + XYZ.replace(b"x", b"u") + b"end_header\n" + bytes(240), "no columns x, y and z among u"),
        ("a.ply", ASCII + b"element vertex many\nend_header\n", "header line 3: 'element vertex many'"),
        ("a.ply", b"ply\nelement vertex 1\n" + XYZ + b"end_header\n", "format: missing"),
        ("a.ply", ASCII + b"element face 0\nend_header\n", "vertex: the header declares no such element"),
        ("a.ply", ASCII + b"element vertex 1\n" + XYZ + b"end_header\n1 2 oops", "'oops' is not a number"),
        ("a.ply", ASCII + b"element vertex 0\n" + XYZ + b"end_header\n", "points: none"),
        ("a.obj", b"hello", "no vertex lines"),
        ("a.obj", b"v 1 2 3\nv 1 2\n", "vertex 2: 2 columns"),
        ("a.obj", b"v 1 2 3\nf 1 2 3\n", "names a v beyond the 1"),
        ("a.off", b"garbage", "not a readable OFF"),
        ("a.stl", b"garbage", "no vertices|not a readable"),
        ("a.xyz", b"1 2 3\n4 5 6\n7 8\n", "line 3: 2 columns where there were 3"),
        ("a.xyz", GRID.replace("25 1", "25 one").encode(), "line 6: 'one' is not a number"),
        ("a.xyz", b"1 2 3 4 5\n5 6 7 8 9\n", "line 1: 5 columns; without names.*--columns x,y,z,nx,ny"),
        ("a.xyz", b"\x00\x01\x02", "binary data"),
        ("a.xyz", b"# only\n\n# comments\n", "no numbers"),
        ("a.xyz", b"x y z\n", "no numbers"),
        ("a.xyz", b"nan nan nan\n" * 20, "none with finite coordinates among 20"),
        ("a.xyz", b"1 2 3\n" * 20, "all 20 coincide"),
        ("a.xyz", b"1 2 3\n4 5 6\n", "points: 2 with finite coordinates; at least 10"),
        ("a.npy", b"not numpy at all", "damaged or not a NumPy file"),
        ("a.npz", b"PK\x03\x04 broken", "damaged or not a NumPy file"),
        ("a.npy", np.full((20, 3), None), "Python objects"),
        ("a.npy", np.zeros((20, 5)), r"shape \(20, 5\): 5 columns"),
        ("a.npz", {"thing": np.zeros((20, 3))}, "points: no such array"),
        ("a.npz", {"points": np.zeros((20, 2))}, r"points: shape \(20, 2\)"),
        ("a.npz", {"points": np.zeros((20, 3)), "normals": np.zeros((19, 3))}, r"normals: shape \(19, 3\)"),
        ("a.npz", {"points": np.full((20, 3), None)}, "points: holds Python objects"),
        ("a.npz", {"points": np.full((20, 3), "a")}, "points: type <U1"),
        ("a.las", b"garbage", "not a readable LAS|pip install"),
        ("a.ply", None, "no such file"),
    ],
)
def test_bad_files_give_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, dict):
        np.savez(path, **content)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    elif content is not None:
        path.write_bytes(content)
    with refused(path, message):
        read_cloud(path)


def test_failed_write_leaves_nothing(tmp_path, cloud):
    (tmp_path / "file").touch()
    (tmp_path / "taken").mkdir()
    for path in (tmp_path / "file" / "cloud.ply", tmp_path / "taken"):
        with refused(path, "cannot be written"):
            write_cloud_ply(path, cloud)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "taken"]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ((np.zeros(3),), r"points has shape \(3,\)"),
        ((np.zeros((4, 3)), np.zeros((3, 3))), "normals has shape"),
        ((np.zeros((4, 3)), None, np.full((4, 3), 2.0)), "colors: expected"),
    ],
)
def test_point_cloud_checks_its_shapes(arrays, message):
    with pytest.raises(ValueError, match=message):
        PointCloud(*arrays)


@pytest.mark.parametrize(("version", "form"), [("1.2", 3), ("1.4", 7)])
def test_las_files_name_their_coordinate_system(tmp_path, version, form):
    """In keys of GeoTIFF, or as WKT; and files that name none."""
    laspy, pyproj = pytest.importorskip("laspy"), pytest.importorskip("pyproj")
    for name, system in (("named.las", pyproj.CRS("EPSG:25832")), ("bare.las", None)):
        header = laspy.LasHeader(point_format=form, version=version)
        if system is not None:
            header.add_crs(system)
        cloud = laspy.LasData(header)
        cloud.x = cloud.y = cloud.z = np.arange(5.0)
        cloud.write(tmp_path / name)
        found = coordinate_system(tmp_path / name)
        assert found is None if system is None else pyproj.CRS(found) == system
    assert coordinate_system(tmp_path / "cloud.ply") is None
