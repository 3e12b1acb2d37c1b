import base64
import json
import math
import struct

import imageio.v3 as iio
import numpy as np
import pytest
from mplicits import datasets
from mplicits.datasets import TexturedMesh, colors_at, linear_to_srgb, read_textured, sample_textured, srgb_to_linear
from mplicits.datasets.textured.mesh import Paint, lookup, pack
from mplicits.neural_fields import InputError
from mplicits.neural_fields.meshing.extract import Mesh
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.surface.surface import read_surface
from refusals import refused

# A unit square in z = 0 of two triangles, corners counter-clockwise from the origin; u = x and v = y.
SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float64)
FACES = np.array([(0, 1, 2), (0, 2, 3)])
UV = SQUARE[FACES][..., :2]
RED, GREEN, BLUE, WHITE = (1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (1.0, 1.0, 1.0)
# 2 × 2 texels as one sees them: red and green above, blue and white below.
QUARTERS = np.array([[RED, GREEN], [BLUE, WHITE]], np.float32)


def write_png(path, image):
    iio.imwrite(path, np.rint(np.asarray(image) * 255).astype(np.uint8))


def at(mesh, x, y):
    x, y = np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float)
    lower = y <= x
    face = np.where(lower, 0, 1)
    weights = np.where(lower[:, None], np.stack((1 - x, x - y, y), 1), np.stack((1 - y, x, y - x), 1))
    return colors_at(mesh, face, weights)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_color_space_has_its_known_values(kind):
    display = [0.0, 0.04045, 0.5, 188 / 255, 1.0]
    linear = [0.0, 0.0031308, 0.21404114, 0.50288646, 1.0]
    x, y = np.array(display, dtype=kind), np.array(linear, dtype=kind)
    np.testing.assert_allclose(srgb_to_linear(x), y, atol=2e-7)
    np.testing.assert_allclose(linear_to_srgb(y), x, atol=1e-6)
    assert srgb_to_linear(x).dtype == linear_to_srgb(x).dtype == kind


def test_color_space_goes_there_and_back():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(x)), x, atol=1e-7)


def test_centres_of_texels_are_half_a_texel_in():
    mesh = TexturedMesh(SQUARE, FACES, UV, QUARTERS)
    found = at(mesh, [0.25, 0.75, 0.25, 0.75], [0.75, 0.75, 0.25, 0.25])
    np.testing.assert_allclose(found, [RED, GREEN, BLUE, WHITE], atol=1e-6)


@pytest.mark.parametrize(
    ("wrap", "us", "colors"),
    [
        ("repeat", (1.25, -0.25, 7.75), (RED, GREEN, GREEN)),
        ("clamp", (1.25, -3.0), (GREEN, RED)),
        ("mirror", (1.25, -0.25, 2.25), (GREEN, RED, RED)),
    ],
)
def test_images_go_on_beyond_their_sides(wrap, us, colors):
    other = Paint(np.full((3, 5, 3), 0.5, np.float32))
    image, parts = pack([other, Paint(QUARTERS, (wrap, "repeat"))], np.array([1]))
    for v in (0.75, -0.25):
        places = np.column_stack((us, np.full(len(us), v)))
        np.testing.assert_allclose(lookup(image, places, parts, np.ones(len(us), int)), colors, atol=1e-6)


def test_lookup_is_bilinear_in_light():
    rng = np.random.default_rng(0)
    image = rng.uniform(size=(7, 5, 3)).astype(np.float32)
    uv = rng.uniform(0.2, 0.8, (100, 2))
    column, row = uv[:, 0] * 5 - 0.5, (1 - uv[:, 1]) * 7 - 0.5
    light = srgb_to_linear(image)
    j, i = np.floor(column).astype(int), np.floor(row).astype(int)
    a, b = (column - j)[:, None], (row - i)[:, None]
    above, below = (light[i + k, j] * (1 - a) + light[i + k, j + 1] * a for k in (0, 1))
    np.testing.assert_allclose(lookup(image, uv), above * (1 - b) + below * b, atol=1e-6)


def test_vertex_colours_are_interpolated_in_light_and_multiply_the_image():
    shades = np.array([RED, RED, WHITE, WHITE], np.float32)
    plain = TexturedMesh(SQUARE, FACES, None, None, shades)
    half = linear_to_srgb(np.array(0.5))
    np.testing.assert_allclose(at(plain, 0.5, 0.5), [(1, half, half)], atol=1e-6)
    both = TexturedMesh(SQUARE, FACES, UV, np.full((1, 1, 3), half, np.float32), shades)
    np.testing.assert_allclose(at(both, 0.5, 0.0), [(half, 0, 0)], atol=1e-6)


def write_obj(folder, *, mtl="newmtl paint\nmap_Kd paint.png\n", faces="f 1/1 2/2 3/3 4/4", head="mtllib square.mtl\n"):
    if mtl is not None:
        (folder / "square.mtl").write_text(mtl)
    vertices = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in SQUARE)
    coordinates = "".join(f"vt {x:g} {y:g}\n" for x, y, _ in SQUARE)
    (folder / "square.obj").write_text(f"{head}{vertices}{coordinates}usemtl paint\n{faces}\n")
    return folder / "square.obj"


@pytest.mark.parametrize("faces", ["f 1/1 2/2 3/3 4/4", "f -4/-4 -3/-3 -2/-2\nf 1/1/ 3/3 4/4", "f 3/3 4/4 1/1 2/2"])
def test_obj_with_an_image(tmp_path, faces):
    write_png(tmp_path / "paint.png", QUARTERS)
    mesh = read_textured(write_obj(tmp_path, faces=faces))
    np.testing.assert_array_equal(mesh.image, QUARTERS)
    # u = x and v = y everywhere on the square, whichever way it is cut.
    np.testing.assert_allclose(mesh.uv, mesh.vertices[mesh.faces][..., :2])
    cloud = sample_textured(mesh, 2000, seed=0)
    expected = linear_to_srgb(lookup(QUARTERS, cloud.points[:, :2]).clip(0, 1))
    np.testing.assert_allclose(cloud.colors, expected, atol=1e-5)


def test_obj_seams_keep_both_sides(tmp_path):
    # The two triangles share an edge, but not its texture coordinates.
    write_png(tmp_path / "paint.png", QUARTERS)
    mesh = read_textured(write_obj(tmp_path, faces="vt 0.25 0.25\nf 1/1 2/2 3/3\nf 1/5 3/5 4/5"))
    assert len(mesh.vertices) == 4
    np.testing.assert_allclose(at(mesh, [0.75, 0.25], [0.25, 0.75]), [WHITE, BLUE], atol=1e-6)


def test_obj_with_several_materials(tmp_path):
    (tmp_path / "maps").mkdir()
    write_png(tmp_path / "maps" / "some paint.png", QUARTERS)
    mtl = (
        "# two\nnewmtl plain\nKd 0.25 0.5 0.75\r\nillum 1\n\nnewmtl paint\nKd 0.1 0.1 0.1\n"
        "map_Kd C:\\old\\maps\\some paint.png\n"
    )
    with refused("square.mtl", r"map_Kd: .*some paint\.png"):
        read_textured(write_obj(tmp_path, mtl=mtl))
    mtl = mtl.replace("C:\\old\\", "")
    faces = "f 1/1 2/2 3/3\nusemtl plain\nf 1 3 4\nusemtl paint"
    mesh = read_textured(write_obj(tmp_path, mtl=mtl, faces=faces))
    np.testing.assert_allclose(at(mesh, 0.1, 0.9), [(0.25, 0.5, 0.75)], atol=1e-6)
    np.testing.assert_allclose(at(mesh, 0.75, 0.25), [WHITE], atol=1e-6)


def test_obj_faces_before_any_material_are_white(tmp_path):
    path = write_obj(tmp_path, mtl="newmtl paint\nKd 1 0 0\n", faces="f 1 2 3")
    np.testing.assert_allclose(at(read_textured(path), 0.5, 0.1), [RED], atol=1e-6)
    path.write_text(path.read_text().replace("usemtl paint\n", "") + "usemtl paint\nf 1 3 4\n")
    np.testing.assert_allclose(at(read_textured(path), [0.5, 0.5], [0.1, 0.9]), [WHITE, RED], atol=1e-6)


def test_obj_with_vertex_colours(tmp_path):
    path = tmp_path / "shades.obj"
    table = np.concatenate((SQUARE, (RED, GREEN, BLUE, WHITE)), axis=1)
    path.write_text("".join("v " + " ".join(map(str, row)) + "\n" for row in table.tolist()) + "f 1 2 3 4\n")
    mesh = read_textured(path)
    assert mesh.image is None
    np.testing.assert_array_equal(mesh.vertex_colors, [RED, GREEN, BLUE, WHITE])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mtl": None}, r"square\.obj: mtllib: .*square\.mtl"),
        ({"mtl": "newmtl paint\nmap_Kd gone.png\n"}, r"square\.mtl: paint: map_Kd: .*gone\.png"),
        ({"mtl": "newmtl paint\nmap_Kd square.obj\n"}, r"square\.obj: not an image"),
        ({"mtl": "newmtl paint\nKd red\n"}, r"square\.mtl: paint: Kd: .*'red'"),
        ({"mtl": "newmtl paint\nKd nan 0 0\n"}, r"square\.mtl: paint: Kd: .*'nan 0 0'"),
        ({"mtl": "newmtl paint\nmap_Kd -s 2 1 paint.png\n"}, r"square\.mtl: paint: map_Kd: the option -s is not read"),
        ({"mtl": "newmtl other\nKd 1 0 0\n"}, r"square\.obj: usemtl: no material 'paint'"),
        ({"faces": "f 1/1 2/2 3"}, r"square\.obj: f: .*no vt index"),
        ({"faces": "f 1/1 2/2 3/9"}, r"square\.obj: f: names a vt beyond the 4"),
        ({"faces": "f 1/1 2/2 9/3"}, r"square\.obj: f: names a v beyond the 4"),
        ({"faces": ""}, r"square\.obj: f: no faces"),
        ({"head": ""}, r"square\.obj: neither a texture nor vertex colours"),
    ],
)
def test_bad_obj_is_one_line(tmp_path, change, message):
    write_png(tmp_path / "paint.png", QUARTERS)
    with refused(tmp_path, message):
        read_textured(write_obj(tmp_path, **change))


def gltf(*, image=None, factor=None, colors=None, node=None, sampler=None, transform=None, indices=range(6), mode=4):
    """The square in glTF, its buffer within; every triangle has vertices of its own, as at seams."""
    uv = UV.reshape(-1, 2) * (1, -1) + (0, 1)  # v runs down
    arrays = [SQUARE[FACES].reshape(-1, 3).astype("<f4"), uv.astype("<f4"), np.asarray(indices, "<u2")]
    arrays += [] if colors is None else [np.asarray(colors)]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1} | ({} if colors is None else {"COLOR_0": 3})
    blobs = [array.tobytes() for array in arrays]
    material = {} if factor is None else {"baseColorFactor": [*factor, 1.0]}
    if image is not None:
        extensions = {"extensions": {"KHR_texture_transform": transform}} if transform else {}
        material["baseColorTexture"] = {"index": 0} | extensions
        blobs.append(iio.imwrite("<bytes>", np.rint(image * 255).astype(np.uint8), extension=".png"))
    starts = np.cumsum([0, *((len(blob) + 3) // 4 * 4 for blob in blobs)]).tolist()
    body = b"".join(blob + bytes(-len(blob) % 4) for blob in blobs)
    views = [{"buffer": 0, "byteOffset": at, "byteLength": len(blob)} for at, blob in zip(starts, blobs, strict=False)]
    kinds = {"<f4": 5126, "<u2": 5123, "|u1": 5121}
    accessors = []
    for k, array in enumerate(arrays):
        form = ("SCALAR", "VEC2", "VEC3", "VEC4")[array[0].size - 1]
        accessor = {"bufferView": k, "componentType": kinds[array.dtype.str], "count": len(array), "type": form}
        accessors.append(accessor | {"normalized": k == 3 and array.dtype != np.float32})
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node or {"mesh": 0}, {"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0, "mode": mode}]}],
        "materials": [{"pbrMetallicRoughness": material}],
        "accessors": accessors,
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "textures": [{"source": 0} | ({"sampler": 0} if sampler else {})],
        "samplers": [sampler] if sampler else [],
        "images": [{"bufferView": len(blobs) - 1}],
    }
    return header, body


def write_gltf(path, header, body):
    if path.suffix == ".gltf":
        header["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
        path.write_text(json.dumps(header))
        return path
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def read_gltf(folder, suffix=".glb", **parts):
    return read_textured(write_gltf(folder / f"square{suffix}", *gltf(**parts)))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf_with_an_image(tmp_path, suffix):
    mesh = read_gltf(tmp_path, suffix, image=QUARTERS)
    assert len(mesh.vertices) == 4  # six in the file
    found = at(mesh, [0.25, 0.75, 0.25, 0.75], [0.75, 0.75, 0.25, 0.25])
    np.testing.assert_allclose(found, [RED, GREEN, BLUE, WHITE], atol=1e-6)


@pytest.mark.parametrize("grey", [None, 188 / 255])
def test_gltf_factor_is_light(tmp_path, grey):
    image = None if grey is None else np.full((2, 2, 3), grey, np.float32)
    mesh = read_gltf(tmp_path, image=image, factor=(1.0, 0.5, 0.25))
    light = np.array([1, 0.5, 0.25]) * srgb_to_linear(np.array(grey or 1.0))
    np.testing.assert_allclose(at(mesh, 0.5, 0.5), [linear_to_srgb(light)], atol=1e-6)


def test_gltf_diffuse_colours_of_older_materials(tmp_path):
    header, body = gltf(image=QUARTERS, factor=(1.0, 0.5, 0.25))
    wanted = read_textured(write_gltf(tmp_path / "new.glb", header, body))
    base = header["materials"][0].pop("pbrMetallicRoughness")
    diffuse = {"diffuseFactor": base["baseColorFactor"], "diffuseTexture": base["baseColorTexture"]}
    header["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": diffuse}
    found = read_textured(write_gltf(tmp_path / "old.glb", header, body))
    np.testing.assert_array_equal(found.image, wanted.image)


@pytest.mark.parametrize("kind", ["<f4", "<u2", "u1"])
def test_gltf_vertex_colours_are_light(tmp_path, kind):
    light = np.array([(1, 0.5, 0.2, 1)] * 6)
    stored = light.astype(kind) if kind == "<f4" else np.rint(light * np.iinfo(kind).max).astype(kind)
    mesh = read_gltf(tmp_path, colors=stored)
    assert mesh.image is None
    np.testing.assert_allclose(mesh.vertex_colors, [linear_to_srgb(light[0, :3])] * 4, atol=1 / 255)
    factor = read_gltf(tmp_path, colors=stored, factor=(0.5, 1.0, 1.0))
    np.testing.assert_allclose(at(factor, 0.5, 0.5), [linear_to_srgb(light[0, :3] * (0.5, 1, 1))], atol=1 / 255)


def test_gltf_hard_edges_of_vertex_colours_stay(tmp_path):
    mesh = read_gltf(tmp_path, colors=np.array([RED] * 3 + [BLUE] * 3, "<f4"))
    cloud = sample_textured(mesh, 1000, seed=0)
    expected = np.where(cloud.points[:, [1]] < cloud.points[:, [0]], RED, BLUE)
    np.testing.assert_allclose(cloud.colors, expected, atol=1e-6)


def test_gltf_nodes_place_and_mirror(tmp_path):
    quarter = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # about z
    turned = {"children": [1], "translation": [1e6, 0, 0], "rotation": quarter, "scale": [2, 2, 2]}
    corners = read_gltf(tmp_path, image=QUARTERS, node=turned).vertices
    np.testing.assert_allclose((corners.min(axis=0), corners.max(axis=0)), ((1e6 - 2, 0, 0), (1e6, 2, 0)), atol=1e-9)
    matrix = {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]}
    cloud = sample_textured(read_gltf(tmp_path, image=QUARTERS, node=matrix), 100, seed=0)
    assert cloud.points[:, 0].min() > 4
    np.testing.assert_allclose(cloud.normals, np.tile((0, 0, 1), (100, 1)), atol=1e-6)  # not turned inside out


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 5, 2]), (6, [0, 1, 2, 5])])
def test_gltf_strips_and_fans(tmp_path, mode, order):
    mesh = read_gltf(tmp_path, factor=RED, mode=mode, indices=order)
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    np.testing.assert_allclose(area, [(0, 0, 0.5)] * 2)


@pytest.mark.parametrize(("wrap", "color"), [(33071, WHITE), (10497, BLUE)], ids=["clamped", "repeated"])
def test_gltf_textures_wrap_and_move_as_they_say(tmp_path, wrap, color):
    # u = 2 · 0.875 + 0.5 = 2.25 and v (down) = 1.75: clamped, the lower right texel; repeated, the lower left one.
    sampler, move = {"wrapS": wrap, "wrapT": wrap}, {"scale": [2, 2], "offset": [0.5, 0]}
    mesh = read_gltf(tmp_path, image=QUARTERS, sampler=sampler, transform=move)
    np.testing.assert_allclose(at(mesh, 0.875, 0.125), [color], atol=1e-5)


CORNERS = SQUARE[FACES].reshape(-1, 3)


def add(header, parts, array, form, **about):
    """One more accessor; its number."""
    kinds = {"<f4": 5126, "<i2": 5122, "|u1": 5121}
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(parts[0]), "byteLength": array.nbytes})
    parts[0] += array.tobytes() + bytes(-array.nbytes % 4)
    numbers = {"componentType": kinds[array.dtype.str], "count": len(array), "type": form}
    header["accessors"].append({"bufferView": len(header["bufferViews"]) - 1} | numbers | about)
    return len(header["accessors"]) - 1


def quantised(stored, scale, normalized):
    def change(header, parts):
        header["extensionsRequired"] = ["KHR_mesh_quantization"]
        header["nodes"][0]["scale"] = [scale] * 3
        position = add(header, parts, stored, "VEC3", normalized=normalized)
        header["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position

    return change


def morphed(header, parts, *weights):
    shifted = add(header, parts, np.ones((6, 3), "<f4"), "VEC3")
    header["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": shifted}]
    header["meshes"][0]["weights"] = list(weights)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (quantised((CORNERS * 200).astype("u1"), 0.005, normalized=False), CORNERS),
        (quantised((CORNERS * 32767).astype("<i2"), 2.0, normalized=True), 2 * CORNERS),
        (lambda header, parts: morphed(header, parts, 0.0), CORNERS),
        (lambda h, _: h.update(animations=[{"channels": [], "samplers": []}]), CORNERS),
    ],
    ids=["bytes", "normalised", "morph at rest", "animation"],
)
def test_gltf_positions_at_rest(tmp_path, change, expected):
    header, body = gltf(image=QUARTERS)
    change(header, parts := [body])
    mesh = read_textured(write_gltf(tmp_path / "square.glb", header, parts[0]))
    np.testing.assert_allclose(mesh.vertices[mesh.faces].reshape(-1, 3), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda h: h.update(extensionsRequired=["KHR_draco_mesh_compression"]), "compression is not read"),
        (lambda h: h.update(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression is not read"),
        (lambda h: h.update(extensionsUsed=["EXT_mesh_gpu_instancing"]), "EXT_mesh_gpu_instancing is not read"),
        (lambda h: h["accessors"][0].pop("bufferView"), r"accessors\[0\] has no numbers"),
        (lambda h: h["accessors"][0].update(sparse={}), r"accessors\[0\]: sparse accessors are not read"),
        (lambda h: h["nodes"][0].update(skin=0), r"nodes\[0\]: skins and morph targets are not read"),
        (lambda h: h["nodes"][0].update(weights=[0.0, 2.0]), r"nodes\[0\]: skins and morph targets are not read"),
        (lambda h: h["meshes"][0].update(weights=[0.5]), r"nodes\[0\]: skins and morph targets are not read"),
        (lambda h: h["images"].__setitem__(0, {"uri": "gone.png"}), r"images\[0\]: .*gone\.png is not there"),
        (lambda h: h["images"].__setitem__(0, {"bufferView": 0}), r"images\[0\]: not an image that can be read"),
        (lambda h: h["nodes"][0].update(children=[0]), "its own ancestor"),
        (lambda h: h["accessors"][0].update(count=99), "cannot be read as a GLB mesh"),
        (lambda h: h["accessors"][0].update(byteOffset=True), "byteOffset: True is no whole number"),
        (lambda h: h["bufferViews"][0].update(byteOffset=True), "byteOffset: True is no whole number"),
        (lambda h: h["bufferViews"][3].update(byteLength=10**6), "goes beyond the"),
        (lambda h: h["nodes"][0].update(matrix=[math.nan] * 16), "matrix has a number that is not finite"),
        (lambda h: h["nodes"][0].update(scale=[math.inf, 1, 1]), "scale has a number that is not finite"),
        (lambda h: h["materials"][0]["pbrMetallicRoughness"].update(baseColorFactor=[math.nan] * 4), "baseColorFactor"),
        (lambda h: h["accessors"][0].update(count=2), "a face names vertex 5, but there are only 2"),
        (lambda h: h["meshes"][0]["primitives"][0].update(mode=1), "no triangles in it"),
        (lambda h: h["materials"][0].clear(), "neither a texture nor vertex colours"),
    ],
)
def test_bad_gltf_is_one_line(tmp_path, break_it, message):
    header, body = gltf(image=QUARTERS)
    break_it(header)
    path = write_gltf(tmp_path / "square.glb", header, body)
    with refused(path, message):
        read_textured(path)


@pytest.mark.parametrize("read", [read_textured, read_surface])
@pytest.mark.parametrize(("damaged", "message"), [("end", "is cut off"), (0, "not finite"), (3, "not finite")])
def test_cut_glb_files_and_positions_and_colours_that_are_no_numbers(tmp_path, read, damaged, message):
    header, body = gltf(image=QUARTERS, colors=np.ones((6, 3), "<f4"))
    start = 0 if damaged == "end" else header["bufferViews"][damaged]["byteOffset"]
    path = write_gltf(tmp_path / "square.glb", header, body[:start] + struct.pack("<f", math.nan) + body[start + 4 :])
    if damaged == "end":
        path.write_bytes(path.read_bytes()[:-200])
    with refused(path, message):
        read(path)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_vertex_colours_survive_two_round_trips(tmp_path, suffix):
    shades = np.linspace(0, 1, 256)
    vertices = np.random.default_rng(0).normal(size=(256, 3))
    faces = np.arange(255, dtype=np.int32)[:, None] % 254 + np.arange(3, dtype=np.int32)
    colors = np.stack((shades, shades[::-1], shades**2), axis=1).astype(np.float32)
    write_mesh(tmp_path / f"a{suffix}", Mesh(vertices, faces, None, colors))
    once = read_surface(tmp_path / f"a{suffix}")
    write_mesh(tmp_path / f"b{suffix}", Mesh(once.vertices, faces, None, once.colors.astype(np.float32)))
    twice = read_surface(tmp_path / f"b{suffix}")
    assert np.abs(twice.colors - colors).max() < 0.51 / 255
    mesh = read_textured(tmp_path / f"b{suffix}")
    found = colors_at(mesh, np.arange(len(mesh.faces)), np.tile((1.0, 0, 0), (len(mesh.faces), 1)))
    np.testing.assert_allclose(found, colors[faces[:, 0]], atol=0.51 / 255)


def test_samples_are_uniform_by_area_and_repeat():
    vertices = np.concatenate((SQUARE, SQUARE * 3 + (0, 0, 1)))
    faces = np.concatenate((FACES, FACES + 4, [[0, 0, 1]]))  # areas 1, 9 and 0
    colors = np.repeat(np.array([RED, BLUE], np.float32), 4, axis=0)
    mesh = TexturedMesh(vertices, faces, None, None, colors)
    cloud = sample_textured(mesh, 20_000, seed=3)
    assert (cloud.colors[:, 0] > 0.5).mean() == pytest.approx(0.1, abs=0.01)
    np.testing.assert_allclose(cloud.points[cloud.points[:, 2] == 1].mean(axis=0), (1.5, 1.5, 1), atol=0.03)
    np.testing.assert_allclose(cloud.normals, np.tile((0, 0, 1), (20_000, 1)))
    again, other = sample_textured(mesh, 20_000, seed=3), sample_textured(mesh, 20_000, seed=4)
    np.testing.assert_array_equal(again.points, cloud.points)
    assert not np.array_equal(other.points, cloud.points)
    assert len(sample_textured(mesh, 0, seed=0)) == 0


def test_bad_files_are_one_line(tmp_path):
    datasets.write_cloud_ply(tmp_path / "cloud.ply", datasets.PointCloud(SQUARE, None, np.zeros((4, 3), np.float32)))
    write_mesh(tmp_path / "bare.ply", Mesh(SQUARE, FACES.astype(np.int32)))
    (tmp_path / "shape.stl").write_text("solid")
    (tmp_path / "nan.obj").write_text("v 0 0 0 1 0 0\nv 1 0 nan 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n")
    (tmp_path / "old.gltf").write_text('{"asset": {"version": "1.0"}, "meshes": {"cube": {"primitives": []}}}')
    for name, message in (
        ("gone.obj", "no such file"),
        ("shape.stl", r"\.obj, \.glb, \.gltf, \.ply"),
        ("cloud.ply", "face: there are none"),
        ("bare.ply", "neither a texture nor vertex colours"),
        ("nan.obj", "nan|not a finite number"),
        ("old.gltf", "glTF 1 is not read"),
    ):
        with refused(tmp_path / name, message):
            read_textured(tmp_path / name)


def test_meshes_without_area_or_colours_have_no_samples():
    flat = TexturedMesh(SQUARE * 0, FACES, None, None, np.zeros((4, 3), np.float32))
    with pytest.raises(InputError, match="zero area"):
        sample_textured(flat, 5, seed=0)
    with pytest.raises(ValueError, match="neither an image"):
        sample_textured(TexturedMesh(SQUARE, FACES), 5, seed=0)
    with pytest.raises(ValueError, match="neither an image"):
        colors_at(TexturedMesh(SQUARE, FACES), np.zeros(1, np.int64), np.ones((1, 3)) / 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": FACES[:, :2]}, r"faces has shape \(2, 2\)"),
        ({"uv": UV}, "uv, image: expected both"),
        ({"uv": UV[:1], "image": QUARTERS}, r"uv has shape \(1, 3, 2\)"),
        ({"uv": UV, "image": QUARTERS[..., 0]}, r"image has shape \(2, 2\)"),
        ({"vertex_colors": np.zeros((3, 3), np.float32)}, r"vertex_colors has shape \(3, 3\)"),
    ],
)
def test_wrong_shapes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        TexturedMesh(**({"vertices": SQUARE, "faces": FACES} | change))
