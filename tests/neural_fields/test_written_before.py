"""Files that earlier versions wrote load, with the same values: types in them are named, and modules move."""

from pathlib import Path

import pytest
import torch
import trimesh
from mplicits.neural_fields import load_field, save_field
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run

WRITTEN = Path(__file__).parent / "written"


def test_a_field_of_the_network_of_neus(tmp_path: Path) -> None:
    """Written by `save_field` at commit 9deaa32, when its module was `neural_fields.baselines.neus`."""
    field = load_field(WRITTEN / "neus.safetensors").field
    x = torch.linspace(-0.8, 0.8, 12).reshape(4, 3)
    expected = [0.23960894, -0.30286300, 0.34135771, 1.64951944]
    assert field.value(x).tolist() == pytest.approx(expected, abs=1e-6)
    save_field(tmp_path / "again.safetensors", field)
    assert load_field(tmp_path / "again.safetensors").field.state_dict().keys() == field.state_dict().keys()


def test_a_run_meshes_to_the_same_vertices(tmp_path: Path) -> None:
    """A run of ``fit`` with a texture, and its mesh, written by the command line of commit 9deaa32."""
    mesh_run(WRITTEN / "run-9deaa32", tmp_path / "mesh.ply", MeshOptions(resolution=12))
    made, expected = (
        trimesh.load_mesh(path, process=False) for path in (tmp_path / "mesh.ply", WRITTEN / "run-9deaa32-mesh.ply")
    )
    assert (made.faces == expected.faces).all()
    # Values of the field differ by the rounding of its sums, and vertices by as much over the slope along an edge.
    assert abs(made.vertices - expected.vertices).max() < 1e-5
    assert abs(made.visual.vertex_colors.astype(int) - expected.visual.vertex_colors).max() <= 1
