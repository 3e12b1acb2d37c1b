"""``export_run``: what is checked before a mesh is extracted."""

from pathlib import Path

import pytest
from mplicits.neural_fields import InputError, Similarity, Sphere, save_field
from mplicits.pipelines.mesh import export_run


def test_a_mesh_does_not_replace_the_cloud_of_its_run(tmp_path: Path) -> None:
    cloud, run = tmp_path / "scan.ply", tmp_path / "field.safetensors"
    cloud.write_text("points", encoding="utf-8")
    save_field(run, Sphere(radius=0.5), similarity=Similarity.identity(), metadata={"run": {"cloud": str(cloud)}})
    with pytest.raises(InputError, match=r"scan\.ply"):
        export_run(run, cloud)
    assert cloud.read_text(encoding="utf-8") == "points"
