from pathlib import Path

import pytest
from benches import PLACE, RADIUS
from mplicits.neural_fields import Sphere, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mesh of a sphere of radius 14 around (5, 0, −1), which tests only read."""
    path = tmp_path_factory.mktemp("shapes") / "ball.ply"
    write_mesh(path, extract_mesh(Sphere(radius=RADIUS), resolution=40), PLACE)
    return path
