"""``export_run``: what is checked before a mesh is extracted."""

from pathlib import Path

import pytest
from mplicits.neural_fields import InputError, Similarity, Sphere, save_field
from mplicits.pipelines.mesh import MeshOptions, export_run
from mplicits.pipelines.surface.surface import read_surface


@pytest.mark.parametrize("record", [{"cloud": "{cloud}"}, {"cloud": "/moved/scan.ply", "cloud_from_run": "scan.ply"}])
def test_a_mesh_does_not_replace_the_cloud_of_its_run(record: dict[str, str], tmp_path: Path) -> None:
    cloud, run = tmp_path / "scan.ply", tmp_path / "field.safetensors"
    cloud.write_text("points", encoding="utf-8")
    record = {name: path.format(cloud=cloud) for name, path in record.items()}
    save_field(run, Sphere(radius=0.5), similarity=Similarity.identity(), metadata={"run": record})
    with pytest.raises(InputError, match=r"scan\.ply"):
        export_run(run, cloud)
    assert cloud.read_text(encoding="utf-8") == "points"


def test_the_mesh_of_a_textured_file_is_the_one_in_it(tmp_path: Path) -> None:
    pytest.importorskip("xatlas")
    run, out = tmp_path / "field.safetensors", tmp_path / "ball.glb"
    save_field(run, Sphere(radius=0.5), similarity=Similarity.identity())
    mesh = export_run(run, out, MeshOptions(resolution=32, texture=64, texture_faces=100)).mesh
    assert len(mesh.faces) == len(read_surface(out).faces) <= 100
