"""nerfstudio's methods on its stand-in; test_installed.py runs them in nerfstudio itself."""

import importlib
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from mplicits.neural_fields import InputError, Mesh, NerfstudioField, NoSurfaceError, Sphere, ViewColor
from mplicits.pipelines.nerfstudio.export import export_mesh, host_cameras, in_data_coordinates, main, visible_mesh
from mplicits.pipelines.surface.surface import read_surface
from nerfstudio_stand_in import PLUGIN, Heads, stand_in
from torch import Tensor, nn

ROOT = Path(__file__).parents[3]
BOX = torch.tensor([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]])


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Any:
    stand_in(monkeypatch)
    return importlib.import_module(f"{PLUGIN}model")


def small(plugin: Any, **options: Any) -> Any:
    return plugin.MultiscaleFieldConfig(widths=(16, 24), depths=(2, 2), features=4, color_width=8, **options)


@pytest.mark.parametrize("name", ["MultiscaleModelConfig", "MultiscaleFactoModelConfig"])
def test_a_model_trains_and_its_bands_follow(plugin: Any, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    config = getattr(plugin, name)(sdf_field=small(plugin), anneal_end=10)
    model = config.setup(scene_box=SimpleNamespace(aabb=BOX), num_train_data=3)
    field = model.field
    assert isinstance(field, NerfstudioField)
    assert field.scale == pytest.approx(12**-0.5)  # a corner lies 2 √3 away
    groups = model.get_param_groups()
    grouped = [id(parameter) for group in groups.values() for parameter in group]
    assert sorted(grouped) == sorted(map(id, field.parameters()))
    optimizer = torch.optim.Adam([{"params": groups[name], "lr": plugin.RATES[name]} for name in groups])
    schedule = importlib.import_module(f"{PLUGIN}schedule").WarmCosineConfig().setup()
    schedulers = {"fields": schedule.get_scheduler(optimizer, 1.0)}
    trainer = SimpleNamespace(_start_step=40, config=SimpleNamespace(max_num_iterations=10))
    optimizers = SimpleNamespace(schedulers=schedulers)
    callbacks = model.get_training_callbacks(SimpleNamespace(trainer=trainer, optimizers=optimizers))
    assert schedule.steps == 50
    assert schedule.factor(50) == pytest.approx(0.05)
    losses = []
    for step in range(4):
        for callback in callbacks:
            callback.func(step=step)
        torch.manual_seed(1)
        loss = model.step(torch.linspace(0.2, 1.8, 8).expand(6, 8))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert field.cos_anneal_ratio == 0.3
    with torch.no_grad():
        field.deviation_network.variance.fill_(0.35)
    callbacks[-1].func(step=4)
    assert field.field.deltas.tolist() == pytest.approx([4 * field.scale / np.exp(3.5)], rel=1e-5)
    assert all(model.lpips(torch.zeros(1)).isnan() for _ in range(2))
    assert capsys.readouterr().out.count("LPIPS") == 1


def test_the_start_is_a_sphere_in_the_scene_box(plugin: Any) -> None:
    torch.manual_seed(0)
    field = plugin.MultiscaleFieldConfig(radius=0.6).setup(aabb=BOX)
    x = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    with torch.no_grad():
        off = field.field.base.value(1.2 * x * field.scale) / field.scale
    # `fit_sphere` comes nearer than 0.01 of the field's unit, which is 2 √3 here.
    assert float(off.square().mean().sqrt()) < 2 * 0.01 / field.scale


def test_schedules_are_plain_numbers(plugin: Any) -> None:
    """NumPy's would be in the checkpoints, which PyTorch then refuses to read."""
    schedules = importlib.import_module(f"{PLUGIN}schedule")
    schedule = schedules.WarmCosineConfig(schedules.WarmCosine, warm_up_end=9, max_steps=109, least=0.1).setup()
    found = [schedule.factor(step) for step in (0, 9, 59, 109, 500)]
    assert found == pytest.approx([0.1, 1.0, 0.55, 0.1, 0.1])
    assert {type(factor) for factor in found} == {float}
    parameter = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([parameter], lr=2.0)
    schedule.get_scheduler(optimizer, 2.0)
    assert type(optimizer.param_groups[0]["lr"]) is float


def test_the_entry_points_lead_to_the_methods(plugin: Any) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = project["entry-points"]["nerfstudio.method_configs"]
    assert set(found) == {"mplicits", "mplicits-facto"}
    for name, place in found.items():
        module, attribute = place.split(":")
        method = getattr(importlib.import_module(module), attribute)
        assert method.config.method_name == name
        groups = set(plugin.RATES) | ({"proposal_networks"} if "facto" in name else set())
        assert set(method.config.optimizers) == groups
        config = method.config
        assert config.pipeline.model.sdf_field.learning_rate == config.optimizers["fields"]["optimizer"].lr


class Red(nn.Module):
    """Red where it is seen from the front, else blue."""

    def forward(self, x: Tensor, direction: Tensor, jet: Any) -> Tensor:
        front = ((direction * jet.gradient).sum(dim=-1, keepdim=True) < -0.99).float()
        return torch.cat((front, torch.zeros_like(front), 1 - front), dim=-1)


RED_BALL = NerfstudioField(Sphere(radius=0.25), Red(), heads=Heads, scale=0.5)


def cameras(places: list[float]) -> SimpleNamespace:
    """As nerfstudio keeps them: they stand at z = 4 and so many along x, and look down."""
    poses = torch.tensor([[[1.0, 3e-6, 0, place], [0, 1, 0, 0], [0, 0, 1, 4]] for place in places])  # of float32
    numbers = {"fx": 60.0, "fy": 60.0, "cx": 40.0, "cy": 30.0, "width": 80, "height": 60}
    lens = {name: torch.full((len(places), 1), number) for name, number in numbers.items()}
    return SimpleNamespace(camera_to_worlds=poses, **lens)


def exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, field: nn.Module) -> tuple[Path, np.ndarray]:
    stand_in(monkeypatch)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    transform = np.concatenate([turn, [[1.0], [2.0], [3.0]]], axis=1)
    moved = {"dataparser_transform": torch.from_numpy(transform).float(), "dataparser_scale": 0.5}
    outputs = SimpleNamespace(**moved, cameras=cameras([-0.05, 0.05]))
    data = SimpleNamespace(train_dataparser_outputs=outputs)
    pipeline = SimpleNamespace(model=SimpleNamespace(field=field), datamanager=data)
    evaluation = sys.modules["nerfstudio.utils.eval_utils"]
    evaluation.eval_setup = lambda config, test_mode: (None, pipeline, config, 0)  # pyright: ignore[reportAttributeAccessIssue]
    config = tmp_path / "config.yml"
    config.write_text("")
    return config, -turn.T @ transform[:, 3]


def test_the_mesh_is_where_the_data_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A sphere of radius 0.5 around nerfstudio's origin is one of radius 1 around what was moved there."""
    config, middle = exported(monkeypatch, tmp_path, RED_BALL)
    mesh = export_mesh(config, tmp_path / "ball.ply", 32)
    away = mesh.vertices - middle
    assert abs(np.linalg.norm(away, axis=1) - 1).max() < 0.01
    assert (np.einsum("ij,ij->i", mesh.normals, away) > 0.99).all()
    assert (mesh.colors == [1, 0, 0]).all()
    assert (tmp_path / "ball.ply").stat().st_size > 0


def test_only_what_cameras_see_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two stand above the sphere, in nerfstudio's z: below where the rays graze it, at r² / d, nothing is left."""
    config, middle = exported(monkeypatch, tmp_path, RED_BALL)
    out = tmp_path / "ball.ply"
    words = ["--load-config", str(config), "--output-path", str(out), "--resolution", "64", "--seen"]
    assert main(words) == 0
    height = (read_surface(out).vertices - middle)[:, 2]  # the move turns about z, and makes it half as large
    pixel = 2 * 2 * (4 / 60)  # of two, twice the width in the data's units, in which the place of a point may be
    assert height.max() == pytest.approx(1, abs=0.01)
    assert height.min() == pytest.approx(1 / 8, abs=2 * pixel)
    with pytest.raises(NoSurfaceError, match="no two photographs see any of it"):
        visible_mesh(RED_BALL.mesh(16), RED_BALL, host_cameras(cameras([50.0, 51.0])))


def test_a_texture_has_the_colours_and_normals_of_the_field(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A sphere's normals are those of its mesh: the normal map is upright all over, to what a facet turns."""
    for module in ("xatlas", "fast_simplification"):
        pytest.importorskip(module, reason="the extra mplicits[texture] is not installed")
    config, middle = exported(monkeypatch, tmp_path, RED_BALL)
    mesh = export_mesh(config, tmp_path / "ball.obj", 32, texture=64, faces=1000)
    assert len(mesh.faces) <= 1000
    assert abs(np.linalg.norm(mesh.vertices - middle, axis=1) - 1).max() < 0.02
    color, normal = (cv2.imread(str(tmp_path / f"ball_{name}.png"))[..., ::-1] for name in ("color", "normal"))
    assert (color == [255, 0, 0]).all()
    upright = normal / 127.5 - 1
    assert np.median(upright[..., 2]) > 0.99
    with pytest.raises(InputError, match=r"textures are written as .glb or .obj"):
        export_mesh(config, tmp_path / "ball.ply", 32, texture=64)
    with pytest.raises(InputError, match="--texture 4: expected 16 to"):
        export_mesh(config, tmp_path / "ball.glb", 32, texture=4)


def test_undoing_the_move_of_the_data_is_exact() -> None:
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    shift, points = rng.normal(size=3), rng.normal(size=(20, 3))
    moved = 0.3 * (points @ turn.T + shift)
    normals = rng.normal(size=(20, 3)).astype(np.float32)
    mesh = Mesh(moved, np.zeros((0, 3), np.int32), (normals @ turn.T).astype(np.float32))
    found = in_data_coordinates(mesh, np.concatenate([turn, shift[:, None]], axis=1), 0.3)
    np.testing.assert_allclose(found.vertices, points, atol=1e-14)
    np.testing.assert_allclose(found.normals, normals, atol=1e-6)  # pyright: ignore[reportArgumentType]


def test_bad_exports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match=r"no such file; expected the config.yml"):
        export_mesh(tmp_path / "none.yml", tmp_path / "mesh.ply")
    config, _ = exported(monkeypatch, tmp_path, nn.Identity())
    with pytest.raises(InputError, match="trained by another method"):
        export_mesh(config, tmp_path / "mesh.ply")
    with pytest.raises(InputError, match="unknown mesh format"):  # said before the training is read, which is none
        export_mesh(config, tmp_path / "mesh.png")
    away = NerfstudioField(Sphere(radius=3.0), ViewColor(0, width=8, depth=1), heads=Heads)
    exported(monkeypatch, tmp_path, away)
    words = ["--load-config", str(config), "--output-path", str(tmp_path / "mesh.ply"), "--resolution", "8"]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ns-mplicits-export: error: ")
