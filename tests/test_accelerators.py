"""Everything that evaluates or trains gives on an accelerator what it gives on the CPU.

Equal to the last bit on the fake accelerator; on CUDA, which rounds otherwise, finite results of the same shape.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import fake_accelerator
import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from evolutions import few_points
from fields import small_multiscale, small_spacetime, two_levels
from hosts import Heads, NeuSHost, ray_samples
from mplicits.datasets import sample_torus, write_cloud_ply
from mplicits.datasets.cameras import look_at
from mplicits.datasets.clouds.cleaning.prepare import prepare_cloud
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.writing import write_neus
from mplicits.neural_fields.networks.colors import ColorNetwork
from mplicits.neural_fields.networks.multiscale import fit_sphere
from mplicits.neural_fields.spacetime.dynamic_tracing import DynamicTracer
from mplicits.neural_fields.tracing.cones import cone_starts
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.fit.unoriented import SIGNING, give_signs
from mplicits.pipelines.training.settings import FitConfig, load_config
from reconstructions import small_reconstructions
from test_commands import EVOLVE, FIT, RECONSTRUCT, TEXTURE, a_cloud, a_mesh
from torch import Tensor, nn

from benchmarks.cli import main as benchmarks
from benchmarks.paper.grids import NGP_PRESETS, BanfRecipe, InstantNgpRecipe
from benchmarks.paper.networks import BaconRecipe, IdfRecipe, SirenRecipe

Result = Sequence[Tensor | np.ndarray]
CAMERA = look_at((0.4, 0.5, 2.6), (0.0, 0.0, 0.0), fov=42.0, width=12, height=12)


def same(work: Callable[[torch.device], Result], accelerator: torch.device) -> None:
    """``work`` gives on the accelerator what it gives on the CPU, from the same seed."""
    results = []
    for device in (torch.device("cpu"), accelerator):
        torch.manual_seed(0)
        results.append(work(device))
    here, there = results
    assert len(here) == len(there) > 0
    for a, b in zip(here, there, strict=True):
        a, b = torch.as_tensor(a).detach(), torch.as_tensor(b).detach().cpu()
        assert a.shape == b.shape
        if accelerator.type == fake_accelerator.NAME:
            assert torch.equal(a.nan_to_num(nan=-9.0), b.nan_to_num(nan=-9.0))
        elif a.is_floating_point():
            assert torch.equal(a.isfinite(), b.isfinite())


@pytest.fixture(autouse=True)
def _one_march(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays march on the CPU as on accelerators; test_march_gpu.py compares the two marches."""
    monkeypatch.setattr("mplicits.neural_fields.tracing.sphere.makes_wait", lambda _: True)


def rays(device: torch.device) -> tuple[Tensor, Tensor]:
    origin, directions = CAMERA.rays()
    return origin.to(device), directions.to(device)


def tensors(module: nn.Module) -> list[Tensor]:
    return [*module.state_dict().values()]


def traced(device: torch.device) -> Result:
    field, (origin, directions) = small_multiscale(0.3).to(device), rays(device)
    near = cone_starts(field, origin, directions, tiles=(8, 4))
    hits = nf.sphere_trace(field, origin, directions, near=near, max_steps=64)
    fixed = nf.sphere_trace(field, origin, directions, budget=(20, 5, 5))
    graph = nf.sphere_trace(field, origin, directions, max_steps=64, differentiable=True)
    graph.depth[graph.mask].sum().backward()
    return near, *hits, *fixed, *(parameter.grad for parameter in field.base.parameters())


def traced_in_time(device: torch.device) -> Result:
    origin, directions = rays(device)
    tracer = DynamicTracer(small_spacetime().to(device), origin, directions)
    return [part for time in (0.2, 0.21) for part in tracer.trace(time)]


def meshed(device: torch.device) -> Result:
    mesh = nf.extract_mesh(nf.Sphere(radius=0.6).to(device), resolution=24)
    fine = nf.extract_mesh(two_levels().to(device), resolution=24)
    return mesh.vertices, mesh.faces, mesh.normals, fine.vertices, fine.normals


def volume_rendered(device: torch.device) -> Result:
    field = small_multiscale(0.3)
    color = ColorNetwork(field.base.num_features, width=16, depth=1)
    with torch.no_grad():
        field.deltas.mul_(0.1)
    field, color = field.to(device), color.to(device)
    origins, directions = (part.reshape(-1, 3) for part in torch.broadcast_tensors(*rays(device)))
    options = {
        "inv_std": 20.0,
        "sampling": Sampling(uniform=8, importance=8),
        "background": torch.ones(3, device=device),
    }
    found = []
    for generator in (None, torch.Generator().manual_seed(0)):
        seen = nf.render_volume(field, color, origins, directions, generator=generator, **options)
        found += [seen.color, seen.opacity, seen.depth, seen.normal]
    (found[4].square().mean() + seen.jet.gradient.norm(dim=-1).mean()).backward()
    return *found, *(parameter.grad for parameter in field.parameters())


def in_neus(device: torch.device) -> Result:
    host = NeuSHost(nf.NeuSGeometry(small_multiscale(0.5)), 2)
    host.geometry.to(device)
    host.color.to(device)
    host.inverse_deviation = nn.Parameter(host.inverse_deviation.detach().to(device))
    optimiser = torch.optim.Adam(host.parameters(), lr=1e-3)
    origins, directions = (part.reshape(-1, 3)[::16] for part in torch.broadcast_tensors(*rays(device)))
    depths = torch.linspace(1.8, 3.2, 8, device=device).expand(len(directions), 8)
    for _ in range(2):
        finer = host.finer_depths(origins, directions, depths)
        optimiser.zero_grad()
        host.loss(origins, directions, finer, torch.zeros_like(directions)).backward()
        optimiser.step()
    return *tensors(host.geometry), *tensors(host.color)


def in_instant_nsr(device: torch.device) -> Result:
    geometry = nf.InstantNSRGeometry(small_multiscale(0.5), radius=1.5).to(device)
    x = (torch.rand(20, 3) - 0.5).to(device)
    found = geometry(x, with_grad=True, with_feature=True)
    sum(part.square().mean() for part in found).backward()
    return *found, *(parameter.grad for parameter in geometry.parameters())


def in_nerfstudio(device: torch.device) -> Result:
    host = nf.NerfstudioField(small_multiscale(0.5), ColorNetwork(2, width=16, depth=1), heads=Heads).to(device)
    samples = ray_samples(torch.linspace(0.2, 1.8, 8).expand(6, 8))
    for name in ("origins", "directions", "starts"):
        setattr(samples.frustums, name, getattr(samples.frustums, name).to(device))
    samples.deltas, samples.camera_indices = samples.deltas.to(device), samples.camera_indices.to(device)
    outputs = host(samples, return_alphas=True)
    outputs[Heads.ALPHA].mean().backward()
    return [outputs[head] for head in (Heads.SDF, Heads.NORMALS, Heads.ALPHA)]


def in_input_units(device: torch.device) -> Result:
    """Arrays in, arrays out, wherever the field is."""
    world = nf.WorldField(small_multiscale(0.3).to(device), nf.Similarity((5.0, 0.0, -1.0), 20.0))
    points = np.random.default_rng(0).uniform(-20, 20, (40, 3))
    hits = world.trace(points, -points)
    closest = world.closest(points)
    return world.distance(points), world.normals(points), *hits, *closest, world.mesh(resolution=16).vertices


def begun_as_spheres(device: torch.device) -> Result:
    trained = nf.Siren(32, 2, omega=10.0).to(device)
    fit_sphere(trained, steps=3, batch=64)
    return tensors(trained)


CONSUMERS = (
    *(traced, traced_in_time, meshed, volume_rendered, begun_as_spheres),
    *(in_neus, in_instant_nsr, in_nerfstudio, in_input_units),
)


@pytest.mark.parametrize("work", CONSUMERS, ids=lambda work: work.__name__)
def test_what_uses_a_field(work: Callable[[torch.device], Result], accelerator: torch.device) -> None:
    same(work, accelerator)


@pytest.mark.parametrize("recipe", [SirenRecipe(), BaconRecipe(), IdfRecipe(), InstantNgpRecipe("fine"), BanfRecipe()])
def test_methods_of_the_peers(recipe: object, accelerator: torch.device) -> None:
    cloud = prepare_cloud(sample_torus(300))
    settings = NGP_PRESETS["fine", "smoke"] if isinstance(recipe, InstantNgpRecipe) else recipe.presets["smoke"]
    steps = (4,) * len(settings.steps) if isinstance(settings.steps, tuple) else 4
    settings = replace(settings, steps=steps)

    def work(device: torch.device) -> Result:
        outputs, _ = recipe.learn(cloud, settings, seed=0, device=str(device), progress=None)
        return [tensor for output in outputs for tensor in tensors(output.field)]

    same(work, accelerator)


def test_signs_of_normals(accelerator: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(vars(SIGNING), "steps", 3)
    monkeypatch.setitem(vars(SIGNING), "samples", 500)
    config = replace(load_config(FitConfig, "fast"), batch=64, widths=(16,) * 3, depths=(1,) * 3)
    cloud = prepare_cloud(sample_torus(300))
    points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)

    def work(device: torch.device) -> Result:
        signs = give_signs(points, normals, config, device=device)
        return signs.turned, np.array(signs.slope)

    same(work, accelerator)


# --- commands -----------------------------------------------------------------------------------------

SMALL = "--size 12 --samples 1"
COMMANDS = (
    f"fit scan.ply -o run {FIT} --quiet",
    f"texture run coloured.ply {TEXTURE} --quiet",
    f"render run -o lambert.png {SMALL}",
    f"render run -o color.png {SMALL} --shading color",
    f"render run -o error.png {SMALL} --shading error",
    f"reconstruct photos -o photographed {RECONSTRUCT} --quiet",
    f"evolve sphere:0.4 torus:0.4,0.15 -o moving {EVOLVE} --quiet",
    "animate moving -o moving.png --frames 2 --size 16 --samples 1",
    "normal-map run mesh.ply -o compared --size 16 --views 1 --repeats 1 --resolution 16",
)
FIELDS = ("run", "photographed", "moving")
PICTURES = ("lambert.png", "color.png", "error.png", "photographed/held_out.png", "moving.png", "compared/images.png")


def test_commands(accelerator: torch.device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few_points(monkeypatch)
    small_reconstructions(monkeypatch)
    cloud = sample_torus(400)
    scene = render_scene(SCENES["painted-sphere"](), views=6, size=12, samples=2)

    def work(device: torch.device) -> Result:
        folder = tmp_path / device.type
        folder.mkdir()
        monkeypatch.chdir(folder)
        write_cloud_ply(Path("scan.ply"), cloud)
        a_cloud(Path("coloured.ply"))
        a_mesh(Path("mesh.ply"))
        write_neus(Path("photos"), scene)
        for command in COMMANDS:
            run = benchmarks if command.startswith("normal-map") else main
            assert run([*command.split(), "--device", str(device)]) == 0, command
        found = [tensor for name in FIELDS for tensor in tensors(nf.load_field(f"{name}/field.safetensors").field)]
        return [*found, *(cv2.imread(name, cv2.IMREAD_UNCHANGED) for name in PICTURES)]

    same(work, accelerator)


def test_a_device_that_is_not_there_is_refused_before_any_work(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmarks(["normals", "--device", "warp"]) == 2
    assert "--device warp" in capsys.readouterr().err
