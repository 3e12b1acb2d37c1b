"""Every kind of GLB that is written, before the Khronos validator; skipped where there is no node, or no npm."""

import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from mplicits.neural_fields import Similarity, Sphere, extract_mesh, save_field
from mplicits.neural_fields.fields.similarity import Placement
from mplicits.pipelines.mesh.bake import textured_mesh
from mplicits.pipelines.mesh.files import write_mesh, write_moving
from mplicits.pipelines.mesh.scene import SceneOptions, scene_of_run
from npm import VALIDATOR, fetch

UTM = Similarity((512_345.678, 5_403_210.987, 312.5), 40.0)
PLACED = Placement("z", "mm", center=True)
PROGRAM = """
const fs = require('fs'), validator = require('gltf-validator');
const file = process.argv[2];
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), { uri: file }).then(
  (report) => console.log(JSON.stringify(report)));
"""


@pytest.fixture(scope="module")
def validate(tmp_path_factory):
    """What the validator says of a file."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node on this machine to run the glTF validator with")
    folder = tmp_path_factory.mktemp("validator")
    fetch(folder, VALIDATOR)
    program = folder / "validate.js"
    program.write_text(PROGRAM)

    def ask(path):
        said = subprocess.run([node, str(program), str(path)], capture_output=True, timeout=60, check=True)
        return json.loads(said.stdout)

    return ask


@pytest.fixture(scope="module")
def mesh():
    plain = extract_mesh(Sphere(radius=0.7, center=(0.1, 0.0, 0.0)), resolution=16)
    return replace(plain, colors=np.linspace(0, 1, 3 * len(plain.vertices), dtype=np.float32).reshape(-1, 3))


def plain(mesh):
    return replace(mesh, normals=None, colors=None)


def write_baked(path, mesh):
    pytest.importorskip("xatlas", reason="the extra mplicits[texture] is not installed")
    pytest.importorskip("fast_simplification")
    paint, bumps = (lambda points: 0.5 + 0.4 * points), (lambda points: points + 0.2 * np.sin(9 * points))
    textured_mesh(path, mesh, UTM, paint, bumps, size=64, placement=PLACED)


def write_motion(path, mesh):
    frames = [mesh.vertices + 0.1 * k for k in range(3)]
    place = {"similarity": UTM, "placement": PLACED}
    write_moving(path, mesh.faces, frames, [mesh.normals] * 3, seconds=np.arange(3.0), colors=mesh.colors, **place)


def write_tile(path, mesh):
    """The coarsest tile of a scene, in place of a mesh."""
    save_field(path.with_name("field.safetensors"), Sphere(radius=0.7), similarity=UTM)
    scene_of_run(path.with_name("field.safetensors"), path.with_name("scene"), SceneOptions(resolution=32, cells=16))
    path.with_name("scene").joinpath("tiles", "1", "0_0_0.glb").replace(path)


WRITERS = {
    "plain": lambda path, mesh: write_mesh(path, plain(mesh)),
    "colored": lambda path, mesh: write_mesh(path, mesh, UTM),
    "placed": lambda path, mesh: write_mesh(path, mesh, UTM, PLACED),
    "turned": lambda path, mesh: write_mesh(path, mesh, UTM, Placement("z", "ft")),
    "baked": write_baked,
    "motion": write_motion,
    "tile": write_tile,
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_the_validator_finds_nothing(validate, mesh, tmp_path, write):
    path = tmp_path / "mesh.glb"
    write(path, mesh)
    report = validate(path)
    assert report["issues"]["messages"] == []
    assert report["info"]["totalVertexCount"] >= len(mesh.vertices)


def test_the_validator_sees_a_damaged_file(validate, mesh, tmp_path):
    """A check of the check: an index beyond the vertices."""
    path = tmp_path / "mesh.glb"
    write_mesh(path, replace(plain(mesh), faces=np.where(mesh.faces == 5, 10_000, mesh.faces)))
    assert validate(path)["issues"]["numErrors"] > 0
