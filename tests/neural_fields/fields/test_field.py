from pathlib import Path

import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from mplicits.neural_fields.meshing.extract import map_normals
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.tracing.cones import cone_starts
from torch import Tensor, nn


def ball(x: Tensor) -> Tensor:
    return x.norm(dim=-1) - 0.5


ONE = torch.tensor([1.0, 0.0, 0.0])


def test_functions_are_taken_wherever_fields_are() -> None:
    x = torch.rand(20, 3) + 0.1
    origin, ahead = torch.tensor([0.0, 0.0, 2.0]), torch.tensor([0.0, 0.0, -1.0])
    mesh = nf.extract_mesh(ball, resolution=24)
    assert abs((mesh.vertices**2).sum(axis=1) ** 0.5 - 0.5).max() < 1e-3
    turned = map_normals(mesh, ball).normals
    np.testing.assert_allclose(turned, mesh.vertices / 0.5, atol=2e-3)  # within a cell's chord of the sphere
    assert abs(float(nf.sphere_trace(ball, origin, ahead).depth) - 1.5) < 2e-5
    assert abs(float(nf.sphere_trace(ball, origin, ahead, budget=[20]).depth) - 1.5) < 2e-3  # `capture`
    assert bool((cone_starts(ball, origin, ahead.expand(8, 8, 3), tiles=(8,)) <= 1.5).all())
    feet, reached = nf.project_to_surface(ball, x)
    assert reached.all()
    torch.testing.assert_close(feet.norm(dim=1), torch.full((20,), 0.5), rtol=0, atol=1e-5)
    shade = nf.render_volume(ball, lambda p, v, jet: p, origin[None], ahead[None], inv_std=1000.0)
    assert abs(float(shade.depth) - 1.5) < 1e-2
    for field in (
        nf.MultiscaleSDF(ball, [], []),
        nf.Union(ball),
        Keyframes([0.0], [ball]),
        nf.Moving(ball, nf.RigidMotion()),
    ):
        where = torch.cat((x, torch.zeros(20, field.in_dim - 3)), dim=1)
        torch.testing.assert_close(field.value(where), ball(x))
    torch.testing.assert_close(nf.NeuSGeometry(ball)(x)[:, 0], ball(x))
    world = nf.WorldField(ball, nf.Similarity((1.0, 0.0, 0.0), 2.0))
    torch.testing.assert_close(world.distance(x), 2 * ball((x - ONE) / 2))
    with pytest.raises(TypeError, match="field: got a str"):
        nf.extract_mesh("field.safetensors")
    with pytest.raises(TypeError, match="got a float"):
        nf.FunctionField(0.5)


def test_the_jet_of_a_function_against_a_closed_form() -> None:
    exact = nf.Torus(major=0.5, minor=0.2)
    field = nf.FunctionField(exact.value)
    x = torch.rand(30, 3, dtype=torch.float64, requires_grad=True)
    mine, theirs = field.jet(x), exact.jet(x)
    torch.testing.assert_close(mine.gradient, theirs.gradient)
    weights = torch.rand_like(x)
    (one,) = torch.autograd.grad((mine.gradient * weights).sum(), x)
    (other,) = torch.autograd.grad((theirs.gradient * weights).sum(), x)
    torch.testing.assert_close(one, other)
    with torch.inference_mode():
        torch.testing.assert_close(field.jet(x.detach()).gradient, theirs.gradient.detach())
        assert not field.jet(torch.rand(2, 3)).value.requires_grad
    constant = nf.FunctionField(lambda x: torch.ones(x.shape[:-1]))
    assert not constant.jet(torch.rand(4, 3)).gradient.any()


def test_parameters_of_a_module_are_those_of_the_field() -> None:
    network = nn.Sequential(nn.Linear(3, 4), nn.Softplus(), nn.Linear(4, 1), nn.Flatten(-2))
    field = nf.FunctionField(network)
    assert list(field.parameters()) == list(network.parameters())
    field.jet(torch.rand(1, 5, 3)).gradient.square().sum().backward()
    assert network[0].weight.grad.any()


def moving(speed: float) -> nf.Moving:
    return nf.Moving(nf.Siren(8, 1), nf.RigidMotion(velocity=(speed, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("here", "there", "message"),
    [
        (nf.Siren(8, 1, omega=30), nf.Siren(8, 1, omega=31), r"omega is 31\.0 where.* 30\.0 here"),
        (
            nf.MultiscaleSDF(nf.Siren(8, 1), [nf.Siren(8, 1)], [0.1], taper=0.3),
            nf.MultiscaleSDF(nf.Siren(8, 1), [nf.Siren(8, 1, omega=9)], [0.1]),
            r"(?s)taper is 0\.0.*residuals\.0\.omega is 9\.0",
        ),
        (nf.Sphere(radius=0.5), nf.Sphere(radius=np.float64(0.6)), r"radius is 0\.6"),
        (moving(0.0), moving(0.3), r"motion is .RigidMotion\(.*0\.3"),
    ],
)
def test_tensors_of_another_function_are_refused(here: nf.Field, there: nf.Field, message: str, tmp_path: Path) -> None:
    torch.save(there.state_dict(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    there.load_state_dict(state)
    with pytest.raises(RuntimeError, match=message):
        here.load_state_dict(state)
    here.load_state_dict(dict(here.state_dict()))  # without metadata there is nothing to compare


def test_a_repr_tells_the_function() -> None:
    text = repr(nf.MultiscaleSDF(nf.FunctionField(ball), [nf.Siren(16, 2, omega=5)], [0.25], taper=0.3))
    for part in ("taper=0.3, deltas=[0.25]", "width=16, depth=2, omega=5.0", "FunctionField(function=ball, in_dim=3)"):
        assert part in text
