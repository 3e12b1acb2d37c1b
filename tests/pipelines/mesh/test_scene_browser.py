"""3D Tiles in a real browser with 3d-tiles-renderer; skipped where there is no Chromium, or no npm to fetch it."""

import functools
import http.server
import io
import json

import imageio.v3 as iio
import numpy as np
import pytest
from browser import served
from mplicits.neural_fields import Similarity, Sphere, save_field
from mplicits.pipelines.mesh.scene import SceneOptions, scene_of_run
from npm import THREE, TILES, fetch
from pages import until

pytest.importorskip("selenium")
pytest.importorskip("pyproj")

SIDE = 400  # pixels
HOME = Similarity((512_345.0, 5_403_210.0, 312.5), 40.0)  # metres of UTM zone 32
# A viewer that stands ``distance`` metres east of the scene's middle, on the globe, and takes a ball of 32 metres.
PAGE = """<!doctype html><html><head><link rel="icon" href="data:,"><style>body { margin: 0 }</style>
<script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/",
  "three/examples/jsm/": "/node_modules/three/examples/jsm/",
  "3d-tiles-renderer": "/node_modules/3d-tiles-renderer/build/index.three.js"
}}</script></head><body><script type="module">
import * as THREE from 'three';
import { TilesRenderer } from '3d-tiles-renderer';
const asked = new URLSearchParams(location.search);
const distance = Number(asked.get('distance'));
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(SIDE, SIDE);
document.body.append(renderer.domElement);
const scene = new THREE.Scene(), home = new THREE.Group(), tiles = new TilesRenderer('/scene/tileset.json');
home.matrixAutoUpdate = false;
home.add(tiles.group);
scene.add(home);
const half = Math.asin(40 / distance);  // the picture spans 40 metres each way around the ball
const camera = new THREE.PerspectiveCamera(2 * half * 180 / Math.PI, 1, distance / 100, distance * 10);
camera.up.set(0, 0, 1);
camera.position.set(distance, 0, 0);
camera.lookAt(0, 0, 0);
camera.updateMatrixWorld();
tiles.setCamera(camera);
tiles.setResolution(camera, SIDE, SIDE);
tiles.errorTarget = Number(asked.get('pixels'));
const errors = [];
tiles.addEventListener('load-error', (event) => errors.push(String(event.error)));
tiles.addEventListener('load-model', ({ scene: model }) => model.traverse((node) => {
  if (node.isMesh) node.material = new THREE.MeshBasicMaterial();
}));
let quiet = 0;
function frame() {
  if (tiles.root) {  // the globe is turned and moved, so that floats suffice
    home.matrix.fromArray(tiles.root.transform).invert();
    home.updateMatrixWorld(true);
  }
  tiles.update();
  renderer.render(scene, camera);
  quiet = tiles.root && tiles.loadProgress === 1 ? quiet + 1 : 0;
  if (quiet < 20 && !errors.length) { requestAnimationFrame(frame); return; }
  const shown = [...tiles.visibleTiles].map((tile) => tile.content.uri.split('/').slice(-2)[0]);
  document.body.dataset.said = JSON.stringify({ errors, shown });
  document.title = 'drawn';
}
frame();
</script></body></html>"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the viewer and a ball in three steps of detail, served at an address of this machine."""
    folder = tmp_path_factory.mktemp("site")
    fetch(folder, THREE, TILES)
    (folder / "index.html").write_text(PAGE.replace("SIDE", str(SIDE)))
    save_field(folder / "field.safetensors", Sphere(radius=0.8), similarity=HOME)
    scene_of_run(
        folder / "field.safetensors", folder / "scene", SceneOptions(resolution=64, cells=16, crs="EPSG:25832")
    )
    with served(functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))) as address:
        yield address


@pytest.mark.parametrize(("distance", "pixels", "step"), [(20_000, 20, "2"), (60, 0.01, "0")])
def test_a_viewer_shows_the_ball_without_gaps(browser, site, distance, pixels, step):
    """The coarsest tile if errors of 20 pixels are allowed, the finest if none are; both cover the disc of the ball."""
    browser.get(f"{site}/index.html?distance={distance}&pixels={pixels}")
    until(lambda: browser.title == "drawn")
    said = json.loads(browser.execute_script("return document.body.dataset.said"))
    assert said["errors"] == []
    assert set(said["shown"]) == {step}
    image = iio.imread(io.BytesIO(browser.get_screenshot_as_png()))[:SIDE, :SIDE, 0]
    x = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    radius = np.hypot(*np.meshgrid(x, x)) * np.tan(np.arcsin(40 / distance))
    edge = np.tan(np.arcsin(32 / distance))  # where lines of sight touch the ball
    assert (image[radius < 0.95 * edge] > 200).all()
    assert (image[radius > 1.05 * edge] < 50).all()
