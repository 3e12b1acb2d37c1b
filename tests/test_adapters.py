"""Each shell is called exactly as its host calls it, written out here in small stubs."""

import copy
import enum
import gc
import io
import weakref
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from fields import small_multiscale
from mplicits.neural_fields import (
    Field,
    InstantNSRGeometry,
    Jet,
    MultiscaleSDF,
    NerfstudioField,
    NeuSGeometry,
    Siren,
    Sphere,
)
from mplicits.neural_fields.radiance import ViewColor
from mplicits.neural_fields.volume import transmittance_weights
from mplicits.pipelines.counting import Counted, counted
from torch import Tensor, nn
from torch.nn.functional import normalize, relu


def neus(*, scale: float = 1.0, double: bool = False) -> tuple[NeuSGeometry, Counted]:
    """A shell around a tapered field with two features, and the counter inside it."""
    field = Counted(small_multiscale(0.5))
    shell = NeuSGeometry(field.double() if double else field, scale=scale)
    return shell, field


def points(count: int = 50, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(count, 3, dtype=dtype) - 0.5


# NeuS


class NeuSHost:
    """What NeuS's renderer and runner do with their networks in one step: same calls, same order, same shapes."""

    def __init__(self, geometry: "NeuSGeometry | Separate", features: int) -> None:
        self.geometry = geometry
        self.color = nn.Sequential(nn.Linear(9 + features, 16), nn.ReLU(), nn.Linear(16, 3), nn.Sigmoid())
        self.inverse_deviation = nn.Parameter(torch.tensor(0.3))

    def parameters(self) -> list[nn.Parameter]:
        return [*self.geometry.parameters(), *self.color.parameters(), self.inverse_deviation]

    def finer_depths(self, origins: Tensor, directions: Tensor, depths: Tensor) -> Tensor:
        """Up-sampling: the distance alone, without gradients, in rounds."""
        with torch.no_grad():
            for _ in range(2):
                x = origins[:, None, :] + directions[:, None, :] * depths[..., :, None]
                sdf = self.geometry.sdf(x.reshape(-1, 3)).reshape(depths.shape)
                nearest = depths.gather(1, sdf.abs().argmin(dim=1, keepdim=True))
                depths = torch.cat((depths, nearest + 0.01), -1).sort(dim=-1)[0]
        return depths

    def loss(self, origins: Tensor, directions: Tensor, depths: Tensor, wanted: Tensor) -> Tensor:
        rays, samples = depths.shape
        x = (origins[:, None, :] + directions[:, None, :] * depths[..., :, None]).reshape(-1, 3)
        toward = directions[:, None, :].expand(rays, samples, 3).reshape(-1, 3)
        output = self.geometry(x)
        sdf, feature = output[:, :1], output[:, 1:]
        gradients = self.geometry.gradient(x).squeeze()
        color = self.color(torch.cat((x, toward, gradients, feature), -1)).reshape(rays, samples, 3)
        slope = -relu(-(toward * gradients).sum(-1, keepdim=True))
        inverse = (10 * self.inverse_deviation).exp()
        ahead, behind = (torch.sigmoid((sdf + sign * slope * 0.05) * inverse) for sign in (-1, 1))
        alpha = ((ahead - behind + 1e-5) / (ahead + 1e-5)).reshape(rays, samples).clip(0, 1)
        passed = torch.cumprod(torch.cat((torch.ones(rays, 1), 1 - alpha + 1e-7), -1), -1)[:, :-1]
        rendered = (color * (alpha * passed)[..., None]).sum(dim=1)
        eikonal = ((gradients.reshape(rays, samples, 3).norm(dim=-1) - 1) ** 2).mean()
        return (rendered - wanted).abs().mean() + 0.1 * eikonal


class Separate(nn.Module):
    """The same geometry as NeuS itself has it: every question is an evaluation of its own."""

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field = field

    def sdf(self, x: Tensor) -> Tensor:
        return self.field.value(x)[:, None]

    def forward(self, x: Tensor) -> Tensor:
        jet = self.field.jet(x)
        return torch.cat((jet.value[:, None], jet.features), -1)

    def gradient(self, x: Tensor) -> Tensor:
        x.requires_grad_(True)
        return self.field.jet(x).gradient[:, None]


def rays(count: int = 6) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    origins = torch.tensor([0.0, 0.0, -1.0]) + 0.1 * torch.rand(count, 3)
    directions = normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.2 * torch.rand(count, 3), dim=-1)
    return origins, directions, torch.linspace(0.2, 1.8, 8).expand(count, 8), torch.rand(count, 3)


def test_neus_step_costs_one_jet_per_sample_and_values_elsewhere() -> None:
    shell, field = neus()
    host = NeuSHost(shell, 2)
    optimizer = torch.optim.Adam(host.parameters(), lr=1e-3)
    origins, directions, depths, wanted = rays()
    losses = []
    for step in range(1, 4):
        finer = host.finer_depths(origins, directions, depths)
        assert (field.values, field.jets) == (step * 6 * (8 + 9), (step - 1) * 60)
        loss = host.loss(origins, directions, finer, wanted)
        assert field.jets == step * 60
        optimizer.zero_grad()
        loss.backward()
        assert all(parameter.grad is not None for parameter in host.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[2] < losses[0]


def test_neus_step_has_the_gradients_of_separate_evaluations() -> None:
    """The eikonal term reaches the parameters through the gradient of the gradient."""
    torch.set_default_dtype(torch.float64)
    try:
        field = small_multiscale(0.5)
        hosts = [NeuSHost(NeuSGeometry(field), 2), NeuSHost(Separate(field), 2)]
        hosts[1].color = hosts[0].color
        origins, directions, depths, wanted = rays()
        found = []
        for host in hosts:
            loss = host.loss(origins, directions, host.finer_depths(origins, directions, depths), wanted)
            found.append(torch.autograd.grad(loss, host.parameters()))
    finally:
        torch.set_default_dtype(torch.float32)
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("features", [0, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_neus_shapes(features: int, count: int, dtype: torch.dtype) -> None:
    shell = NeuSGeometry(Siren(16, 2, num_features=features)).to(dtype)
    x = points(count, dtype)
    assert shell(x).shape == shell.sdf_hidden_appearance(x).shape == (count, 1 + features)
    assert shell.sdf(x).shape == (count, 1)
    assert shell.gradient(x).shape == (count, 1, 3)
    assert x.requires_grad
    assert {shell(x).dtype, shell.sdf(x).dtype, shell.gradient(x).dtype} == {dtype}


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
    for one, other in zip(
        torch.autograd.grad(gradient.square().sum(), list(shell.parameters()), allow_unused=True),
        torch.autograd.grad(expected.square().sum(), list(shell.parameters()), allow_unused=True),
        strict=True,
    ):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other)


def test_scaled_sphere_is_exact() -> None:
    shell = NeuSGeometry(Sphere(radius=0.5), scale=0.25)
    assert shell(torch.tensor([[3.0, 0.0, 0.0]])).tolist() == [[1.0]]  # a sphere of radius 2
    with pytest.raises(ValueError, match="scale=0"):
        NeuSGeometry(Sphere(), scale=0)


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


def test_forward_alone_leaves_the_points_as_they_were() -> None:
    shell, _ = neus()
    x = points()
    shell(x).sum().backward()
    assert not x.requires_grad
    assert x.grad is None


# The memo: when it serves, and when it must not


def test_either_order_is_one_jet_and_each_half_is_served_once() -> None:
    shell, field = neus()
    x = points()
    gradient = shell.gradient(x)
    output = shell(x)
    assert field.jets == 50
    again = shell(x)
    assert field.jets == 100
    assert torch.equal(output, again)
    assert torch.equal(gradient, shell.gradient(x))
    assert field.jets == 100


def halved(parameter: Tensor) -> None:
    with torch.no_grad():
        parameter.mul_(0.5)


def replaced(shell: NeuSGeometry) -> None:
    parameter = next(shell.parameters())
    parameter.data = 0.5 * parameter.data


def reloaded(shell: NeuSGeometry) -> None:
    shell.load_state_dict({name: 0.5 * tensor for name, tensor in shell.state_dict().items()})


def stepped(shell: NeuSGeometry) -> None:
    for parameter in shell.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.SGD(shell.parameters(), lr=0.1).step()


CHANGES: dict[str, Callable[[NeuSGeometry, Tensor], object]] = {
    "points in place": lambda shell, x: x.mul_(0.5),
    "a view of the points": lambda shell, x: x[:25].zero_(),
    "optimizer step": lambda shell, x: stepped(shell),
    "one parameter": lambda shell, x: halved(next(shell.parameters())),
    "memory of a parameter": lambda shell, x: replaced(shell),
    "checkpoint": lambda shell, x: reloaded(shell),
    "band": lambda shell, x: halved(shell.get_buffer("field.inner.deltas")),
    "another field": lambda shell, x: setattr(shell, "field", small_multiscale(0.5)),
    "double precision": lambda shell, x: (shell.double(), setattr(x, "data", x.data.double())),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_between_the_calls_is_seen(change: str) -> None:
    shell, _ = neus()
    x = points()
    output = shell(x)
    before = shell.field.jet(x).gradient.detach()
    CHANGES[change](shell, x)
    gradient = shell.gradient(x)[:, 0]
    assert torch.equal(gradient, shell.field.jet(x).gradient)
    assert not torch.equal(gradient.to(before), before)
    assert len(output) == 50


def test_other_points_of_the_same_values_are_evaluated() -> None:
    shell, field = neus()
    x = points()
    output = shell(x)
    other = x.clone()
    gradient = shell.gradient(other)
    assert field.jets == 100
    shell.gradient(x)
    assert field.jets == 150
    assert len(output) == len(gradient)


def test_marking_the_points_in_between_is_no_change() -> None:
    shell, field = neus()
    x = points()
    output = shell(x)
    x.requires_grad_(True)
    shell.gradient(x).square().sum().backward()
    assert field.jets == 50
    assert x.grad is not None
    assert output.requires_grad


def test_an_evaluation_without_graph_does_not_serve_a_training_step() -> None:
    shell, field = neus()
    x = points()
    with torch.no_grad():
        output = shell(x)
        assert not output.requires_grad
    gradient = shell.gradient(x)
    assert field.jets == 100
    assert gradient.requires_grad
    graph = shell(x)
    with torch.no_grad():
        assert not shell.gradient(x).requires_grad
    assert graph.requires_grad
    with torch.inference_mode():
        output = shell(x)
    with torch.no_grad():
        gradient = shell.gradient(x)
    assert output.is_inference()
    assert not gradient.is_inference()


def test_freezing_a_parameter_in_between_is_seen() -> None:
    shell, _ = neus()
    x = points()
    output = shell(x)
    shell.requires_grad_(False)
    with torch.no_grad():
        expected = shell.field.jet(x).gradient
    gradient = shell.gradient(x)
    x.grad = None
    gradient.sum().backward()
    assert all(parameter.grad is None for parameter in shell.parameters())
    assert torch.equal(gradient[:, 0], expected)
    assert len(output) == 50


def test_a_backward_pass_between_the_calls_leaves_a_whole_graph_for_the_second() -> None:
    """Autograd frees the graph of both halves at the first backward pass."""
    shell, field = neus()
    x = points()
    output = shell(x)
    output.square().sum().backward()
    shell.gradient(x).square().sum().backward()
    assert field.jets == 100
    gradient = shell.gradient(x)
    gradient.square().sum().backward()
    shell(x).sum().backward()
    assert field.jets == 200


class Watched(Field):
    """Keeps weak references to what its jets return."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = Siren(16, 2, num_features=2)
        self.in_dim, self.num_levels, self.deltas = 3, 1, self.inner.deltas
        self.seen: list[weakref.ref[Tensor]] = []

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        value, gradient, features = self.inner.jet(x, level=level)
        gradient = gradient.clone()  # a tensor of its own, which lives as long as any view of it
        self.seen.append(weakref.ref(gradient))
        return Jet(value, gradient, features)

    def alive(self) -> int:
        return sum(reference() is not None for reference in self.seen)


@pytest.mark.parametrize("marked", [False, True])
@pytest.mark.parametrize("dead", ["output", "both"])
def test_nothing_outlives_what_the_caller_has(marked: bool, dead: str) -> None:
    field = Watched()
    shell = NeuSGeometry(field)
    gc.disable()  # what dies here must die by itself, not be found later as a cycle
    try:
        x = points().requires_grad_(marked)
        output = shell(x)
        assert field.alive() == 1
        del output
        if dead == "both":
            del x
        assert field.alive() == 0
        x = points().requires_grad_(marked)
        output = shell(x)
        gradient = shell.gradient(x)
        assert field.alive() == 1
        del gradient
        assert field.alive() == 0
        assert len(output) == 50
    finally:
        gc.enable()


def test_nothing_waits_for_points_that_died() -> None:
    field = Watched()
    shell = NeuSGeometry(field)
    with torch.no_grad():
        x = points()
        output = shell(x)
        del x
    assert field.alive() == 0
    assert len(output) == 50


def test_slices_of_the_output_keep_the_gradient_waiting() -> None:
    shell, field = neus()
    x = points()
    sdf = shell(x)[:, :1]
    shell.gradient(x)
    assert field.jets == 50
    assert sdf.shape == (50, 1)


def test_a_shell_with_something_waiting_can_be_copied_and_saved() -> None:
    shell, _ = neus()
    x = points()
    output = shell(x)
    copied = copy.deepcopy(shell)
    file = io.BytesIO()
    torch.save(shell, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=False)
    for other in (copied, loaded):
        halved(next(other.parameters()))
        assert not torch.equal(other.gradient(x), shell.field.jet(x).gradient[:, None])
    assert set(shell.state_dict()) == set(copied.state_dict())
    assert len(output) == 50


def test_inference_tensors_have_no_version_and_are_evaluated_each_time() -> None:
    shell, field = neus()
    with torch.inference_mode():
        x = points()
        shell(x)
        shell.gradient(x)
    assert field.jets == 100
    shell(x).sum().backward()
    assert not x.requires_grad
    shell.gradient(x).sum().backward()


# instant-nsr-pl


def nsr(**options: float) -> tuple[InstantNSRGeometry, Counted]:
    field = Counted(small_multiscale(0.5))
    return InstantNSRGeometry(field, **options), field  # pyright: ignore[reportArgumentType]


def test_instant_nsr_returns_what_the_flags_ask_for() -> None:
    geometry, field = nsr(radius=1.5)
    x = points() * 3
    sdf = geometry(x, with_grad=False, with_feature=False)
    assert isinstance(sdf, Tensor)
    assert (field.values, field.jets) == (50, 0)
    for flags, shapes in {
        (True, False): [(50,), (50, 3)],
        (False, True): [(50,), (50, 3)],
        (True, True): [(50,), (50, 3), (50, 3)],
    }.items():
        found = geometry(x, with_grad=flags[0], with_feature=flags[1])
        assert [tuple(tensor.shape) for tensor in found] == shapes
        torch.testing.assert_close(found[0], sdf)
    assert field.jets == 150
    value, gradient, feature, laplace = geometry(x, with_grad=True, with_feature=True, with_laplace=True)
    assert torch.equal(feature[:, 0], value)
    assert laplace.shape == (50,)
    torch.testing.assert_close(gradient, field.jet(x / 1.5).gradient)
    torch.testing.assert_close(geometry.forward_level(x), value)
    torch.testing.assert_close(value, 1.5 * field.value(x / 1.5))


def test_instant_nsr_defaults_are_the_hosts() -> None:
    geometry, _ = nsr()
    assert len(geometry(points())) == 3  # sdf, grad, feature
    assert geometry.update_step(0, 1) is None
    assert geometry.regularizations({}) == {}
    with pytest.raises(ValueError, match="radius=-1"):
        nsr(radius=-1)


def test_laplacian_of_a_sphere() -> None:
    x = normalize(points(40, torch.float64), dim=-1) * torch.linspace(0.6, 1.4, 40, dtype=torch.float64)[:, None]
    geometry = InstantNSRGeometry(Sphere(radius=0.5), radius=1.5)
    sdf, laplace = geometry(x, with_grad=False, with_feature=False, with_laplace=True)
    torch.testing.assert_close(laplace, 2 / x.norm(dim=-1), rtol=0, atol=1e-10)
    torch.testing.assert_close(sdf, x.norm(dim=-1) - 0.75)


def test_instant_nsr_training_and_validation() -> None:
    """The host's step: occupancy without gradients, one call for all samples, in half precision; then validation."""
    geometry, field = nsr(radius=1.5)
    color = nn.Linear(3 + 3 + 3, 3)
    optimizer = torch.optim.Adam([*geometry.parameters(), *color.parameters()], lr=1e-3)
    losses = []
    for _ in range(3):
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
        loss = (rgb - 0.7).square().mean() + 0.1 * eikonal + 0.01 * (-sdf.abs()).exp().mean()
        optimizer.zero_grad()
        loss.backward()
        assert all(parameter.grad is not None for parameter in geometry.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[2] < losses[0]
    geometry.eval()
    with torch.inference_mode():
        found = geometry(points(), with_grad=True, with_feature=True)
    found += geometry(points(), with_grad=True, with_feature=True)
    assert not any(tensor.requires_grad for tensor in found)


def test_instant_nsr_mesh_is_in_the_hosts_units() -> None:
    geometry = InstantNSRGeometry(Sphere(radius=0.3), radius=1.5, scale=0.4, resolution=32)
    mesh = geometry.isosurface()
    assert geometry.forward_level(torch.tensor([[1.5, 0.0, 0.0]])).tolist() == [0.75]
    assert mesh["t_pos_idx"].dtype == torch.int64
    assert mesh["v_pos"].dtype == torch.float32
    torch.testing.assert_close(mesh["v_pos"].norm(dim=-1), torch.full((len(mesh["v_pos"]),), 0.75), rtol=0, atol=5e-3)


# nerfstudio and sdfstudio


class Heads(enum.Enum):
    RGB = "rgb"
    SDF = "sdf"
    NORMALS = "normals"
    GRADIENT = "gradient"
    ALPHA = "alpha"


class OldHeads(enum.Enum):
    RGB = "rgb"
    SDF = "sdf"
    NORMAL = "normal"
    GRADIENT = "gradient"
    ALPHA = "alpha"


@dataclass
class Frustums:
    """The part of nerfstudio's class that fields use."""

    origins: Tensor
    directions: Tensor
    starts: Tensor

    @property
    def shape(self) -> torch.Size:
        return self.origins.shape[:-1]

    def get_start_positions(self) -> Tensor:
        return self.origins + self.directions * self.starts


@dataclass
class RaySamples:
    frustums: Frustums
    deltas: Tensor
    camera_indices: Tensor


def ray_samples(depths: Tensor) -> RaySamples:
    origins, directions, _, _ = rays(len(depths))
    shape = (*depths.shape, 3)
    frustums = Frustums(origins[:, None].expand(shape), directions[:, None].expand(shape), depths[..., None])
    return RaySamples(frustums, torch.full((*depths.shape, 1), 0.2), torch.zeros(*depths.shape, 1, dtype=torch.long))


def studio(heads: type[enum.Enum] = Heads) -> tuple[NerfstudioField, Counted]:
    field = Counted(small_multiscale(0.5))
    return NerfstudioField(field, ViewColor(2, width=16, depth=1), heads=heads, deviation=0.3), field


def test_nerfstudio_step_costs_one_jet_per_sample() -> None:
    """The model's calls: annealing, sampler, field with opacities, weights, eikonal loss, logged deviation."""
    shell, field = studio()
    optimizer = torch.optim.Adam(shell.parameters(), lr=1e-3)
    losses = []
    for _ in range(3):
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
        assert {head.name: tuple(tensor.shape) for head, tensor in outputs.items()} == {
            "RGB": (6, 8, 3),
            "SDF": (6, 8, 1),
            "NORMALS": (6, 8, 3),
            "GRADIENT": (6, 8, 3),
            "ALPHA": (6, 8, 1),
        }
        alpha = outputs[Heads.ALPHA]
        weights = transmittance_weights(-torch.log1p(-alpha[..., 0])).weights
        eikonal = ((outputs[Heads.GRADIENT].norm(dim=-1) - 1) ** 2).mean()
        loss = ((weights[..., None] * outputs[Heads.RGB]).sum(dim=1) - 0.5).abs().mean() + 0.1 * eikonal
        optimizer.zero_grad()
        loss.backward()
        assert all(parameter.grad is not None for parameter in shell.parameters())
        optimizer.step()
        assert shell.deviation_network.get_variance().item() > 0
        losses.append(loss.item())
    assert losses[2] < losses[0]


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


def test_nerfstudio_geometry_then_gradient_is_one_jet() -> None:
    shell, field = studio()
    x = points()
    output = shell.forward_geonetwork(x)
    gradient = shell.gradient(x)
    assert field.jets == 50
    assert output.shape == (50, 3)
    assert gradient.shape == (50, 3)
    ((gradient.norm(dim=-1) - 1) ** 2).mean().backward()
    assert next(shell.field.parameters()).grad is not None


def test_nerfstudio_names_of_either_host() -> None:
    shell, _ = studio(OldHeads)
    outputs = shell(ray_samples(torch.ones(2, 3)))
    assert set(outputs) == set(OldHeads) - {OldHeads.ALPHA}
    lengths = outputs[OldHeads.NORMAL].norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    assert shell.deviation_network(torch.zeros(4, 3)).shape == (4, 1)


def test_band_is_respected_inside_a_shell() -> None:
    """Samples outside the band of the coarse level cost the coarse level alone."""
    field, levels = counted(MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2)], [0.1]))
    shell = NeuSGeometry(field)
    x = points(500)
    output, gradient = shell(x), shell.gradient(x)
    assert len(output) == len(gradient) == levels[0].jets == 500
    assert 0 < levels[1].jets == int(((x.norm(dim=-1) - 0.5).abs() < 0.1).sum()) < 300
