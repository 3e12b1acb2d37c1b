"""The mesh between which rays are sought holds all of the band, and is closed."""

import numpy as np
import pytest
import torch
import trimesh
from mplicits.neural_fields import FunctionField, MultiscaleSDF, Siren, Sphere, Torus, Union
from mplicits.neural_fields.tracing.sphere import BOUNDING_RADIUS
from mplicits.pipelines.web.shell import MARGIN, shell_mesh, surface_reach

SHAPES = {
    "torus": Torus(major=0.6, minor=0.15),
    # Thinner than a cell: it must not fall between the lattice points.
    "needle": Union(Sphere(radius=0.01), Sphere(radius=0.2, center=(0.5, 0.0, 0.0))),
    "large": Sphere(radius=1.0),
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_band_is_inside(name):
    delta = 0.03
    field = MultiscaleSDF(SHAPES[name], [Siren(4, 1)], [delta])
    mesh = shell_mesh(field)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert 500 < len(mesh.faces) < 20_000
    corners = mesh.vertices[mesh.faces]
    mids = (corners + np.roll(corners, 1, axis=1)) / 2
    points = np.concatenate((corners.reshape(-1, 3), mids.reshape(-1, 3), corners.mean(axis=1)))
    values = field.value(torch.from_numpy(points.astype(np.float32)), level=0).detach().numpy()
    # Outside the band, or outside the ball that rays are traced in.
    assert ((values > delta) | (np.linalg.norm(points, axis=1) > BOUNDING_RADIUS)).all()


def test_both_parts_have_a_shell():
    mesh = shell_mesh(MultiscaleSDF(SHAPES["needle"], [Siren(4, 1)], [0.03]))
    assert (np.linalg.norm(mesh.vertices, axis=1) < 0.15).any()
    assert (mesh.vertices[:, 0] > 0.5).any()


def test_reach_is_what_the_levels_differ_by():
    """Level 1 is level 0 and a constant, so on its surface level 0 is minus that, and within the band."""
    gain = 0.02
    step = FunctionField(lambda x: torch.full_like(x[..., 0], gain))
    none, (reach,) = surface_reach(MultiscaleSDF(Sphere(radius=0.6), [step], [0.1]))
    assert none == []
    # The corners of the mesh lie on the surface but for linear interpolation in a cell of 1/48, within h²/8R = 1e-4.
    assert abs(reach / MARGIN - gain) < 2e-4
    assert surface_reach(MultiscaleSDF(Sphere(radius=0.6), [step], [gain]))[1] == [pytest.approx(gain)]
