"""Each shell is called exactly as its host calls it; the hosts are written out in hosts.py."""

import enum
from collections.abc import Callable, Iterable

import mplicits.neural_fields as nf
import pytest
import torch
from bounds import assert_within, rounding
from fields import small_multiscale
from hosts import Heads, NeuSHost, OldHeads, Separate, points, ray_samples, rays
from mplicits.neural_fields.networks.colors import ColorNetwork
from mplicits.neural_fields.volume.weights import transmittance_weights
from torch import Tensor, nn
from torch.nn.functional import normalize, relu

from benchmarks.costs.speed import Counted


def assert_three_steps_lower(loss: Callable[[], Tensor], parameters: Iterable[nn.Parameter]) -> None:
    """Adam lowers the loss, and every parameter has a gradient."""
    parameters, losses = list(parameters), []
    optimizer = torch.optim.Adam(parameters, lr=1e-3)
    for _ in range(3):
        optimizer.zero_grad()
        losses.append(loss())
        losses[-1].backward()
        assert all(parameter.grad is not None for parameter in parameters)
        optimizer.step()
    assert losses[2] < losses[0]


def neus(*, scale: float = 1.0, double: bool = False) -> tuple[nf.NeuSGeometry, Counted]:
    """A shell around a tapered field with two features, and the counter inside it."""
    field = Counted(small_multiscale(0.5))
    shell = nf.NeuSGeometry(field.double() if double else field, scale=scale)
    return shell, field


def test_neus_step_costs_one_jet_per_sample_and_values_elsewhere() -> None:
    shell, field = neus()
    host = NeuSHost(shell, 2)
    origins, directions, depths, wanted = rays()

    def loss() -> Tensor:
        field.values = field.jets = 0
        finer = host.finer_depths(origins, directions, depths)
        assert (field.values, field.jets) == (6 * (8 + 9), 0)
        found = host.loss(origins, directions, finer, wanted)
        assert field.jets == 60
        return found

    assert_three_steps_lower(loss, host.parameters())


def test_neus_step_has_the_gradients_of_separate_evaluations() -> None:
    field = small_multiscale(0.5).double()
    hosts = [NeuSHost(geometry, 2) for geometry in (nf.NeuSGeometry(field), Separate(field))]
    hosts[1].color = hosts[0].color.double()
    origins, directions, depths, wanted = (part.double() for part in rays())
    found = []
    for host in hosts:
        loss = host.loss(origins, directions, host.finer_depths(origins, directions, depths), wanted)
        found.append(torch.autograd.grad(loss, host.parameters()))
    torch.testing.assert_close(*found, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_neus_agrees_with_autograd(scale: float) -> None:
    shell, _ = neus(scale=scale, double=True)
    x = points(200, torch.float64)
    output, gradient = shell(x), shell.gradient(x)
    torch.testing.assert_close(output[:, :1], shell.sdf(x))
    torch.testing.assert_close(output[:, 0], shell.field.value(scale * x) / scale)
    torch.testing.assert_close(output[:, 1:], shell.field.jet(scale * x).features)
    (expected,) = torch.autograd.grad(shell.sdf(x).sum(), x, create_graph=True)
    torch.testing.assert_close(gradient[:, 0], expected)
    one, other = (
        torch.autograd.grad(slope.square().sum(), shell.parameters(), allow_unused=True, materialize_grads=True)
        for slope in (gradient, expected)
    )
    torch.testing.assert_close(one, other)


def test_curvature_is_known_at_points_that_were_marked_late() -> None:
    """Some hosts differentiate the gradient by the points, which ``gradient`` itself has marked."""
    shell, field = neus(double=True)
    x = points(20, torch.float64)
    output = shell(x)
    assert not x.requires_grad
    gradient = shell.gradient(x)
    assert field.jets == 20
    (row,) = torch.autograd.grad(gradient[..., 0].sum(), x, retain_graph=True)
    expected = torch.autograd.functional.jacobian(lambda p: field.jet(p).gradient[:, 0].sum(), x.detach())
    torch.testing.assert_close(row, expected)
    output.sum().backward()
    assert x.grad is not None


def nsr(**options: float) -> tuple[nf.InstantNSRGeometry, Counted]:
    field = Counted(small_multiscale(0.5))
    return nf.InstantNSRGeometry(field, **options), field


def test_instant_nsr_returns_what_the_flags_ask_for() -> None:
    geometry, field = nsr(radius=1.5)
    x = points() * 3
    sdf = geometry(x, with_grad=False, with_feature=False)
    assert (field.values, field.jets) == (50, 0)
    for slope, feature in ((True, False), (False, True), (True, True)):
        found = geometry(x, with_grad=slope, with_feature=feature)
        assert [tuple(tensor.shape) for tensor in found] == [(50,), *[(50, 3)] * (slope + feature)]
        torch.testing.assert_close(found[0], sdf)
    assert (field.values, field.jets) == (100, 100)  # features alone cost a value
    value, gradient, feature, laplace = geometry(x, with_grad=True, with_feature=True, with_laplace=True)
    assert torch.equal(feature[:, 0], value)
    assert laplace.shape == (50,)
    off, slope_off, _ = rounding(field, x / 1.5, lambda field, x: field.jet(x))
    assert_within(gradient, field.jet(x / 1.5).gradient, 2 * slope_off)
    assert_within(geometry.forward_level(x), value, 3 * off)
    assert_within(value, 1.5 * field.value(x / 1.5), 3 * off)


def test_laplacian_of_a_sphere() -> None:
    x = normalize(points(40, torch.float64), dim=-1) * torch.linspace(0.6, 1.4, 40, dtype=torch.float64)[:, None]
    geometry = nf.InstantNSRGeometry(nf.Sphere(radius=0.5), radius=1.5)
    sdf, laplace = geometry(x, with_grad=False, with_feature=False, with_laplace=True)
    torch.testing.assert_close(laplace, 2 / x.norm(dim=-1), rtol=0, atol=1e-10)
    torch.testing.assert_close(sdf, x.norm(dim=-1) - 0.75)


def test_instant_nsr_training_and_validation() -> None:
    """The host's step: occupancy without gradients, one call for all samples, in half precision; then validation."""
    geometry, field = nsr(radius=1.5)
    color = nn.Linear(3 + 3 + 3, 3)

    def loss() -> Tensor:
        field.values = field.jets = 0
        with torch.autocast("cpu", dtype=torch.bfloat16):
            with torch.no_grad():
                occupancy = geometry(points(64) * 3, with_grad=False, with_feature=False)
                assert not occupancy.requires_grad
            torch.manual_seed(1)
            positions = points() * 3
            sdf, sdf_grad, feature = geometry(positions, with_grad=True, with_feature=True)
            assert (field.values, field.jets) == (64, 50)
            assert {sdf.dtype, sdf_grad.dtype, feature.dtype} == {torch.float32}
            normal = normalize(sdf_grad, dim=-1)
            rgb = color(torch.cat((feature, positions, normal), -1)).float().sigmoid()
        eikonal = ((sdf_grad.norm(dim=-1) - 1) ** 2).mean()
        return (rgb - 0.7).square().mean() + 0.1 * eikonal + 0.01 * (-sdf.abs()).exp().mean()

    assert_three_steps_lower(loss, [*geometry.parameters(), *color.parameters()])
    geometry.eval()
    with torch.inference_mode():
        found = geometry(points(), with_grad=True, with_feature=True)
    found += geometry(points(), with_grad=True, with_feature=True)
    assert not any(tensor.requires_grad for tensor in found)


def test_instant_nsr_mesh_is_in_the_hosts_units() -> None:
    geometry = nf.InstantNSRGeometry(nf.Sphere(radius=0.3), radius=1.5, scale=0.4, resolution=32)
    mesh = geometry.isosurface()
    assert geometry.forward_level(torch.tensor([[1.5, 0.0, 0.0]])).tolist() == [0.75]
    assert (mesh["t_pos_idx"].dtype, mesh["v_pos"].dtype) == (torch.int64, torch.float32)
    assert bool(((mesh["v_pos"].norm(dim=-1) - 0.75).abs() < 5e-3).all())


def studio(heads: type[enum.Enum] = Heads) -> tuple[nf.NerfstudioField, Counted]:
    field = Counted(small_multiscale(0.5))
    return nf.NerfstudioField(field, ColorNetwork(2, width=16, depth=1), heads=heads, deviation=0.3), field


def test_nerfstudio_step_costs_one_jet_per_sample() -> None:
    shell, field = studio()

    def loss() -> Tensor:
        torch.manual_seed(1)  # the same rays again
        field.values = field.jets = 0
        shell.set_cos_anneal_ratio(0.5)
        depths = torch.linspace(0.2, 1.8, 8).expand(6, 8)
        samples = ray_samples(depths)
        with torch.no_grad():
            sdf = shell.get_sdf(samples)
        assert sdf.shape == (6, 8, 1)
        outputs = shell(samples, return_alphas=True)
        assert (field.values, field.jets) == (48, 48)
        torch.testing.assert_close(outputs[Heads.SDF], sdf)
        sizes = {"RGB": 3, "SDF": 1, "NORMALS": 3, "GRADIENT": 3, "ALPHA": 1}
        assert {head.name: tensor.shape for head, tensor in outputs.items()} == {n: (6, 8, k) for n, k in sizes.items()}
        alpha = outputs[Heads.ALPHA]
        weights, _ = transmittance_weights(-torch.log1p(-alpha[..., 0]))
        eikonal = ((outputs[Heads.GRADIENT].norm(dim=-1) - 1) ** 2).mean()
        assert shell.deviation_network.get_variance().item() > 0
        return ((weights[..., None] * outputs[Heads.RGB]).sum(dim=1) - 0.5).abs().mean() + 0.1 * eikonal

    assert_three_steps_lower(loss, shell.parameters())


def test_nerfstudio_opacity_is_that_of_neus() -> None:
    shell, field = studio()
    samples = ray_samples(torch.linspace(0.2, 1.8, 8).expand(6, 8))
    x = samples.frustums.get_start_positions()
    jet = field.inner.jet(x)
    for anneal in (0.0, 0.4, 1.0):
        shell.set_cos_anneal_ratio(anneal)
        field.jets = 0
        alpha = shell.get_alpha(samples)
        assert field.jets == 48
        cosine = (samples.frustums.directions * jet.gradient).sum(-1)
        falling = -(relu(0.5 - 0.5 * cosine) * (1 - anneal) + relu(-cosine) * anneal)
        ahead, behind = (torch.sigmoid(20.0855 * (jet.value + sign * falling * 0.1)) for sign in (-1, 1))
        torch.testing.assert_close(alpha[..., 0], (ahead - behind) / ahead, rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(shell.get_alpha(samples, jet.value[..., None], jet.gradient), alpha)
    with torch.no_grad():
        assert not shell(samples, return_alphas=True)[Heads.ALPHA].requires_grad


def test_nerfstudio_names_of_either_host() -> None:
    shell, _ = studio(OldHeads)
    outputs = shell(ray_samples(torch.ones(2, 3)))
    assert set(outputs) == set(OldHeads) - {OldHeads.ALPHA}
    lengths = outputs[OldHeads.NORMAL].norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    assert shell.deviation_network(torch.zeros(4, 3)).shape == (4, 1)


def shells(field: nf.Field, **options: float) -> list:
    return [
        nf.NeuSGeometry(field, **options),
        nf.InstantNSRGeometry(field, **options),
        nf.NerfstudioField(field, ColorNetwork(0, width=8, depth=1), heads=Heads, **options),
    ]


def test_without_a_graph_features_cost_a_value() -> None:
    x = points()
    for (shell, field), method in ((neus(), "forward"), (studio(), "forward_geonetwork")):
        expected = getattr(shell, method)(x).detach()
        field.values = field.jets = 0
        with torch.no_grad():
            found = getattr(shell, method)(x)
        assert (field.values, field.jets) == (50, 0)
        off, feature_off = rounding(field, x, lambda field, x: field.value_features(x))
        assert_within(found, expected, 2 * torch.cat((off[:, None], feature_off), dim=1))


def test_scale_comes_from_the_box() -> None:
    box = torch.tensor([[-1.0, -2.0, -2.0], [0.5, 1.0, 2.0]])
    for shell in (
        nf.NeuSGeometry(nf.Sphere(), bounds=box),
        nf.NerfstudioField(nf.Sphere(), ColorNetwork(0, width=8, depth=1), heads=Heads, bounds=box),
    ):
        assert shell.scale == pytest.approx(1 / 3, rel=1e-15)  # its farthest corner is (-1, -2, ±2)
        assert shell.bounds == ((-1.0, -2.0, -2.0), (0.5, 1.0, 2.0))
        with pytest.raises(ValueError, match=r"\(2, 3\)"):
            shell.mesh(8, bounds=box.flip(0))


def test_meshes_are_in_the_hosts_units_within_its_box() -> None:
    """Marching cubes with a Newton step on a sphere: no vertex is farther off than the sagitta of a cell."""
    resolution, radius = 32, 0.5 / 0.7
    for shell in shells(nf.Sphere(radius=0.5), scale=0.7):
        cell = (shell.bounds[1][0] - shell.bounds[0][0]) / resolution
        off = (shell.mesh(resolution).vertices ** 2).sum(axis=1) ** 0.5 - radius
        assert abs(off).max() < cell**2 / radius
        assert shell.mesh(resolution, bounds=[(-1, -1, 0), (1, 1, 1)]).vertices[:, 2].min() >= 0
        assert abs(shell.world.distance([[0.0, 0.0, 1.0]]) - (1 - radius)) < 1e-6


def test_bands_follow_the_uncertainty_of_the_surface() -> None:
    for shell in shells(nf.MultiscaleSDF(nf.Sphere(), [nf.Siren(8, 1), nf.Siren(8, 1)], [0.3, 0.3]), scale=0.5):
        for inv_s, delta in ((2.0, 0.3), (torch.full((3, 1), 40.0), 0.05), (1e4, 0.02)):
            shell.follow(inv_s)
            assert shell.field.deltas.tolist() == pytest.approx([delta, delta])
        shell.follow(1e4, least=0.001, band=8.0)
        assert shell.field.deltas.tolist() == pytest.approx([0.001, 0.001])
    shell, _ = studio()
    shell.follow()
    assert shell.field.deltas.tolist() == pytest.approx([4 / 20.0855] * 2, rel=1e-4)
    for plain in shells(nf.Sphere()):
        plain.follow(10.0)  # nothing to narrow


def test_parameter_groups_hold_the_field_and_the_colours() -> None:
    shell, _ = studio()
    found = {id(parameter) for group in shell.parameter_groups(1e-3) for parameter in group["params"]}
    assert found == set(map(id, shell.parameters()))
