"""Textured meshes in a real browser with three.js; skipped where there is no Chromium, or no npm to fetch three.js.

An orthographic camera looks down −z at a sphere, so that every pixel of the picture has its point on the sphere.
"""

import functools
import http.server
import io
import json

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from browser import served
from mplicits.neural_fields import Capsule, Similarity, Sphere, Union, extract_mesh
from mplicits.neural_fields.fields.similarity import Placement
from mplicits.neural_fields.meshing.extract import Mesh
from mplicits.pipelines.mesh.bake import textured_mesh
from mplicits.pipelines.mesh.files import write_mesh
from npm import THREE, fetch
from pages import until

pytest.importorskip("xatlas", reason="the extra mplicits[texture] is not installed")
pytest.importorskip("selenium")

SIDE = 400  # pixels
RADIUS = 0.8  # of the sphere, in units of its similarity
UTM = Similarity((512_345.678, 5_403_210.987, 312.5), 40.0)
NEAR = Similarity((10.0, -20.0, 30.0), 2.0)  # OBJ has no node to be placed by, and three.js reads it into float32

# A figure as scanners have it: z-up, in millimetres, a metre and a half from the origin.
MILLIMETRES = Similarity((-1100.0, 1250.0, 400.0), 1000.0)

PAGE = """<!doctype html><html><head><link rel="icon" href="data:,">
<style>body { margin: 0 } canvas { display: block }</style>
<script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/"
}}</script></head><body><script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { MTLLoader } from 'three/addons/loaders/MTLLoader.js';
import { OBJLoader } from 'three/addons/loaders/OBJLoader.js';

const wanted = new URLSearchParams(location.search);
const [file, mode] = ['file', 'mode'].map((name) => wanted.get(name));
const [x, y, z, half] = ['x', 'y', 'z', 'half'].map((name) => Number(wanted.get(name)));
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(SIDE, SIDE);
renderer.setClearColor(0x000000);
document.body.append(renderer.domElement);

async function load() {
  if (!file.endsWith('.obj')) return (await new GLTFLoader().loadAsync(file)).scene;
  const materials = await new MTLLoader().loadAsync(file.replace('.obj', '.mtl'));
  return new OBJLoader().setMaterials(materials).loadAsync(file);
}

const scene = new THREE.Scene();
const loaded = await load();
const maps = [];
loaded.traverse((node) => { if (node.isMesh && node.material.map) maps.push(node.material.map); });
while (maps.some((map) => !map.image?.width)) await new Promise((resolve) => setTimeout(resolve, 20));  // of the OBJ
loaded.traverse((node) => {
  if (!node.isMesh) return;
  const { map, normalMap, normalScale } = node.material;
  if (mode === 'color') node.material = new THREE.MeshBasicMaterial({ map });
  if (mode === 'vertices') node.material = new THREE.MeshBasicMaterial({ vertexColors: true });
  if (mode === 'normal') node.material = new THREE.MeshNormalMaterial({ normalMap, normalScale });
  if (mode === 'derived') {  // what GLTFLoader does with a file without tangents
    node.geometry.deleteAttribute('tangent');
    node.material = new THREE.MeshNormalMaterial({ normalMap, normalScale: new THREE.Vector2(1, -1) });
  }
});
scene.add(loaded);
const camera = new THREE.OrthographicCamera(-half, half, half, -half, 0.01 * half, 4 * half);
camera.position.set(x, y, z + 2 * half);
if (mode === 'upright') {  // from four metres away, three.js' up being up: where the file stands is what is asked
  const person = new THREE.PerspectiveCamera(40, 1, 0.01, 100);
  person.position.set(0, 0, 4);
  scene.add(new THREE.HemisphereLight(0xffffff, 0x444444, 2));
  renderer.render(scene, person);
} else {
  renderer.render(scene, camera);
}
const box = new THREE.Box3().setFromObject(loaded, true);
document.body.dataset.box = JSON.stringify([box.min.toArray(), box.max.toArray()]);
document.title = 'drawn';
</script></body></html>"""


def figure():
    """A rod of 1.8 field units along z, with a ball of radius 0.25 at its upper end, and a small one at its right."""
    rod = Capsule(start=(0.0, 0.0, -0.85), end=(0.0, 0.0, 0.85), radius=0.05)
    head, hand = Sphere(radius=0.25, center=(0.0, 0.0, 0.65)), Sphere(radius=0.12, center=(0.3, 0.0, 0.0))
    return extract_mesh(Union(rod, head, hand), resolution=64)


@pytest.fixture(scope="module")
def site(tmp_path_factory, painting, bumpy):
    """A folder with three.js and baked spheres, served at an address of this machine."""
    folder = tmp_path_factory.mktemp("site")
    fetch(folder, THREE)
    (folder / "index.html").write_text(PAGE.replace("SIDE", str(SIDE)))
    ball = trimesh.creation.icosphere(3, radius=RADIUS)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    for name, similarity in (("baked.glb", UTM), ("baked.obj", NEAR)):
        textured_mesh(folder / name, mesh, similarity, painting, bumpy, size=512)
    fine = trimesh.creation.icosphere(5, radius=RADIUS)
    vertices = np.asarray(fine.vertices)
    colored = Mesh(vertices, np.asarray(fine.faces, np.int32), None, painting(vertices).astype(np.float32))
    write_mesh(folder / "colored.glb", colored, UTM)
    write_mesh(folder / "figure.glb", figure(), MILLIMETRES, Placement("z", "mm", center=True))
    with served(functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))) as address:
        yield address


def drawn(browser, site, file, mode, similarity=UTM):
    """The picture ``(SIDE, SIDE, 3)`` uint8 that three.js draws of ``file``."""
    x, y, z = similarity.center
    browser.get(f"{site}/index.html?file={file}&mode={mode}&x={x}&y={y}&z={z}&half={similarity.scale}")

    def is_drawn():
        assert not [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
        return browser.title == "drawn"

    until(is_drawn)
    return iio.imread(io.BytesIO(browser.get_screenshot_as_png()))[:SIDE, :SIDE, :3]


def sphere_points():
    """Pixels well inside the disc of the sphere, and their points on it."""
    x = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(x, -x)
    inside = x**2 + y**2 < (0.9 * RADIUS) ** 2
    x, y = x[inside], y[inside]
    return inside, np.stack((x, y, np.sqrt(RADIUS**2 - x**2 - y**2)), axis=1)


@pytest.mark.parametrize(
    ("file", "mode", "similarity"),
    [("baked.glb", "color", UTM), ("baked.obj", "color", NEAR), ("colored.glb", "vertices", UTM)],
)
def test_colours_on_the_screen_are_those_baked(browser, site, painting, file, mode, similarity):
    image = drawn(browser, site, file, mode, similarity)
    inside, points = sphere_points()
    expected = painting(points)
    assert np.abs(image[inside] / 255 - expected).mean() < 0.01
    assert (image[:10] == 0).all()  # nothing beside the sphere


@pytest.mark.parametrize("mode", ["normal", "derived"])
def test_normals_on_the_screen_are_those_baked(browser, site, bumpy, mode):
    """With the tangents of the file, and with those that three.js derives on the screen."""
    image = drawn(browser, site, "baked.glb", mode)
    inside, points = sphere_points()
    found = image[inside] / 127.5 - 1
    cosine = (found * bumpy(points)).sum(axis=1) / np.linalg.norm(found, axis=1)
    angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
    assert np.median(angle) < 1.5
    assert np.percentile(angle, 95) < 4
    bare = points / RADIUS
    assert np.degrees(np.arccos((bumpy(points) * bare).sum(axis=1).clip(-1, 1))).mean() > 10


def test_a_scan_stands_upright_to_scale_at_the_origin(browser, site):
    """What three.js makes of a z-up scan in millimetres, far from the origin: the box in metres, and a look at it."""
    image = drawn(browser, site, "figure.glb", "upright")
    low, high = json.loads(browser.find_element("css selector", "body").get_attribute("data-box"))
    # From the head at the left, −0.25, to the hand at the right, 0.42; 1.8 m tall. A cell is 0.032 m.
    np.testing.assert_allclose(np.subtract(high, low), [0.67, 1.8, 0.5], atol=0.032)
    np.testing.assert_allclose(np.add(high, low), 0, atol=1e-5)
    seen = image.max(axis=2) > 30
    metre = SIDE / 2 / (4 * np.tan(np.radians(20)))  # pixels; what is nearer by 0.25 m is larger by a fifteenth
    middle = -(0.42 - 0.25) / 2  # where the rod is, now that the box is centred
    head, hand, foot = (int(SIDE / 2 - height * metre) for height in (0.65, 0.0, -0.6))
    np.testing.assert_allclose(seen.sum(axis=1)[[head, foot]] / metre, [0.5, 0.1], rtol=0.15)
    columns = (np.flatnonzero(seen[hand])[[0, -1]] - SIDE / 2) / metre
    np.testing.assert_allclose(columns, [middle - 0.05, middle + 0.42], atol=0.05)  # to the right, not mirrored
