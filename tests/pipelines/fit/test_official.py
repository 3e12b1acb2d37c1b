"""Models of the paper's own code: read as written by a few independent lines, and written again."""

import itertools
from pathlib import Path

import mplicits
import numpy as np
import pytest
import torch
from fields import cube, small_encoded, small_multiscale, small_spacetime
from mplicits.datasets import PointCloud, read_cloud, write_cloud_ply
from mplicits.neural_fields import Field, FunctionField, MultiscaleSDF, Sphere, extract_mesh, load_field, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.fit.official import export_official, import_official, read_official, read_siren
from mplicits.pipelines.training.folder import find_field
from refusals import refused
from torch import Tensor, nn

DELTAS = (0.2, 0.05)
SIZES = ((32, 2), (24, 2), (20, 1))
STAGES = ("coarse", "medium", "fine")


class Sine(nn.Module):
    """What their layers apply."""

    def __init__(self, w0: float = 1.0) -> None:
        super().__init__()
        self.w0 = w0

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.w0 * x)


def network(widths: list[int], frequency: float, gain: float, seed: int, *, w0: float = 1.0) -> nn.Sequential:
    """A network of their structure, with keys such as ``1.0.weight``; frequency / w0 is folded into the weights."""
    torch.manual_seed(seed)
    layers = []
    for index, (a, b) in enumerate(itertools.pairwise([3, *widths, 1])):
        linear = nn.Linear(a, b)
        hidden = index < len(widths)
        bound = (1 / a if index == 0 else (6 / a) ** 0.5 / frequency) if hidden else gain * (6 / a) ** 0.5 / frequency
        for part in linear.parameters():
            nn.init.uniform_(part, -bound, bound)
            part.requires_grad_(False).mul_(frequency / w0 if hidden else 1.0)
        layers.append(nn.Sequential(linear, Sine(w0)) if hidden else nn.Sequential(linear))
    return nn.Sequential(*layers)


@pytest.fixture(scope="module")
def networks() -> list[nn.Sequential]:
    """A ball of radius about a half, and two residuals that dent it."""
    base = network([32, 32], 5.0, 1.0, 0)
    x = 2 * torch.rand(4000, 3) - 1
    hidden = torch.cat([base[:-1](x), torch.ones(len(x), 1)], dim=1)
    solution = torch.linalg.lstsq(hidden, x.norm(dim=1, keepdim=True) - 0.5, driver="gelsd").solution[:, 0]
    base[-1][0].weight[:] = solution[:-1]
    base[-1][0].bias[:] = solution[-1]
    return [base, network([24, 24], 15.0, 0.2, 1), network([20], 30.0, 0.05, 2)]


def write(folder: Path, networks: list[nn.Sequential]) -> Path:
    for stage, net in zip(STAGES, networks, strict=False):
        (folder / stage).mkdir(parents=True)
        torch.save({f"net.{key}": tensor for key, tensor in net.state_dict().items()}, folder / stage / "best.pth")
    return folder


def by_hand(networks: list[nn.Sequential], deltas: tuple[float, ...] | None) -> FunctionField:
    """What their ``create_mesh_multistage`` adds up; without bands if there are none."""

    def value(x: Tensor) -> Tensor:
        rows = x.reshape(-1, 3)
        f = networks[0](rows)[:, 0]
        inside = torch.ones_like(f, dtype=torch.bool)
        for index, net in enumerate(networks[1:]):
            inside = inside & (f.abs() < (torch.inf if deltas is None else deltas[index]))
            f = torch.where(inside, f + net(rows)[:, 0], f)
        return f.reshape(x.shape[:-1])

    return FunctionField(value)


@pytest.mark.parametrize("deltas", [DELTAS, None], ids=["bands", "everywhere"])
def test_values_and_mesh_are_those_of_independent_lines(
    networks: list[nn.Sequential], deltas: tuple[float, ...] | None, tmp_path: Path
) -> None:
    model = write(tmp_path / "ball", networks)
    everywhere = 1e6  # finite, and wider than any value
    field = read_official(model, deltas=deltas or [everywhere] * 2).field
    expected, x = by_hand(networks, deltas), cube(4000, dtype=torch.float32)
    near = torch.nn.functional.normalize(x, dim=1) * (0.5 + 0.05 * x[:, :1])
    for points in (x, near):
        assert float((field.value(points) - expected.value(points)).abs().max()) <= 1e-6
    ours, theirs = extract_mesh(field, resolution=48), extract_mesh(expected, resolution=48, lipschitz=1e6)
    assert np.array_equal(ours.faces, theirs.faces)
    # Values differ by rounding, and f falls by at least a half of a length: one Newton step is no further off.
    assert np.abs(ours.vertices - theirs.vertices).max() < 1e-5


def renamed(state: dict[str, Tensor], form: str) -> dict[str, object]:
    """The same state dict as other code names it."""
    last = max(int(key.split(".")[0]) for key in state)
    names = {}
    for key, tensor in state.items():
        layer, _, kind = key.split(".")
        names[
            {
                "v1": f"net.net.{layer}.0.{kind}",
                "i3d": f"net.{layer}.0.{kind}",
                "siren": f"net.{layer}.{kind}" if int(layer) == last else f"net.{layer}.linear.{kind}",
                "deepsdf": f"lin{layer}.{kind}",
                "parallel": f"module.net.{layer}.0.{kind}",
            }[form]
        ] = tensor
    return names


@pytest.mark.parametrize("wrap", [None, "model_state_dict", "state_dict"])
@pytest.mark.parametrize("form", ["v1", "i3d", "siren", "deepsdf", "parallel"])
def test_every_form_of_a_single_file(form: str, wrap: str | None, tmp_path: Path) -> None:
    net = network([16, 16, 16], 30.0, 0.3, 4, w0=30.0)
    state: dict[str, object] = renamed(net.state_dict(), form)
    path = tmp_path / "siren.pth"
    torch.save(state if wrap is None else {wrap: state, "epoch": 3, "optimizer": {"state": {}}}, path)
    x = cube(500, dtype=torch.float32)
    shape = mplicits.load(path, w0=30.0)
    # |z| reaches 60 here, and sin rounds its argument to 60 ε; three layers of 16 add up.
    assert float((shape.field.value(x) - net(x)[:, 0]).abs().max()) < 60 * 16 * 2**-24
    assert float((mplicits.load(path).field.value(x) - net(x)[:, 0]).abs().max()) > 0.01  # ω₀ is not guessed


def test_layers_of_different_widths_are_the_same_function(tmp_path: Path) -> None:
    net = network([12, 20, 8], 10.0, 0.3, 5).double()
    torch.save({f"net.{key}": tensor for key, tensor in net.state_dict().items()}, tmp_path / "best.pth")
    siren, x = read_siren(tmp_path / "best.pth"), cube(300)
    assert (siren.width, siren.depth) == (20, 3)
    assert float((siren.double().value(x) - net(x)[:, 0]).abs().max()) < 1e-5


def surface_points(field: FunctionField, count: int = 3000) -> Tensor:
    mesh = extract_mesh(field, resolution=48)
    return torch.from_numpy(mesh.vertices[:: max(1, len(mesh.vertices) // count)]).float()


def test_bands_from_the_cloud_are_equation_5(networks: list[nn.Sequential], tmp_path: Path) -> None:
    model, x = write(tmp_path / "ball", networks), surface_points(by_hand(networks, None))
    write_cloud_ply(tmp_path / "cloud.ply", PointCloud(x.numpy()))
    field = read_official(model, cloud=tmp_path / "cloud.ply").field
    coarse = networks[0](x)[:, 0]
    expected = [1.3 * float(f.abs().max()) for f in (coarse, coarse + networks[1](x)[:, 0])]
    assert field.deltas.tolist() == pytest.approx(expected, rel=1e-5)


def test_a_run_of_it_does_what_runs_do(
    networks: list[nn.Sequential], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, x = write(tmp_path / "ball", networks), surface_points(by_hand(networks, None))
    write_cloud_ply(tmp_path / "cloud.ply", PointCloud(x.numpy()))
    run, mesh = str(tmp_path / "run"), str(tmp_path / "ball.ply")
    assert main(["import", str(model), "-o", run, "--cloud", str(tmp_path / "cloud.ply")]) == 0
    assert main(["import", str(model), "-o", run, "--deltas", "0.1", "0.06"]) == 2  # never overwrites
    assert main(["mesh", run, "-o", mesh, "--resolution", "48"]) == 0
    assert main(["evaluate", mesh, str(tmp_path / "cloud.ply"), "--samples", "2000"]) == 0
    assert main(["render", run, "-o", str(tmp_path / "ball.png"), "--size", "32", "--samples", "1"]) == 0
    assert main(["web", run, "-o", str(tmp_path / "ball.html")]) == 0
    assert main(["info", run]) == 0
    assert "best.pth" in capsys.readouterr().out
    radii = np.linalg.norm(read_cloud(mesh).points, axis=1)
    assert 0.3 < radii.min() < radii.max() < 0.7


def test_inside_out_is_said_and_turned(
    networks: list[nn.Sequential], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = networks[0].state_dict()
    last = list(state)[-2:]
    torch.save({key: -tensor if key in last else tensor for key, tensor in state.items()}, tmp_path / "minus.pth")
    words = ["import", str(tmp_path / "minus.pth"), "-o", str(tmp_path / "run")]
    assert main(words) == 0
    assert "--negate" in capsys.readouterr().err
    assert main([*words, "--force", "--negate"]) == 0
    assert "--negate" not in capsys.readouterr().err
    x = cube(100, dtype=torch.float32)
    found = load_field(find_field(tmp_path / "run")).field.value(x)
    assert float((found - networks[0](x)[:, 0]).abs().max()) <= 1e-6


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("taper", [0.0, 0.3])
def test_round_trip_is_exact(levels: int, taper: float, tmp_path: Path) -> None:
    torch.manual_seed(0)
    omegas = [30.0, 45.0, 100.0][:levels]
    sdf = MultiscaleSDF.from_widths(SIZES[:levels], omegas=omegas, taper=taper, residual_gain=1.0)
    sdf.requires_grad_(False)
    similarity = mplicits.Similarity((1.0, -2.0, 1 / 3), 0.1)
    save_field(tmp_path / "sdf.safetensors", sdf, similarity=similarity)
    export_official(tmp_path / "sdf.safetensors", tmp_path / "out")
    back = import_official(tmp_path / "out")
    x = 0.3 * cube(2000, dtype=torch.float32)
    assert back.similarity == similarity
    for level in range(levels):
        assert torch.equal(back.field.value(x, level=level), sdf.value(x, level=level))
        assert torch.equal(back.field.jet(x, level=level).gradient, sdf.jet(x, level=level).gradient)


@pytest.mark.parametrize("encoded", [False, True])
def test_features_stay_behind(encoded: bool, tmp_path: Path) -> None:
    sdf: Field = small_encoded() if encoded else small_multiscale(0.4)
    save_field(tmp_path / "sdf.safetensors", sdf.requires_grad_(False))
    export_official(tmp_path / "sdf.safetensors", tmp_path / "out")
    back, x = read_official(tmp_path / "out").field, cube(500, dtype=torch.float32)
    assert read_siren(tmp_path / "out" / "coarse" / "best.pth").num_features == 0
    assert float((back.value(x) - sdf.value(x)).abs().max()) <= 1e-6


def test_the_renderers_files_name_the_weights(tmp_path: Path) -> None:
    sdf = MultiscaleSDF.from_widths(SIZES[:2], omegas=[30.0, 45.0])
    save_field(tmp_path / "sdf.safetensors", sdf)
    assert main(["export", str(tmp_path / "sdf.safetensors"), "-o", str(tmp_path / "ball"), "--up", "z"]) == 0
    assert main(["export", str(tmp_path / "sdf.safetensors"), "-o", str(tmp_path / "ball")]) == 2
    lines = [line.split(" = ") for line in (tmp_path / "ball" / "ball.exp").read_text().splitlines() if "=" in line]
    about = dict(lines)
    assert (about["lod0_layers"], about["lod0_hidden"]) == ("1", "32")
    assert about["lod2_weights"] == about["lod1_weights"]  # a level that there is not repeats the one before
    assert (about["surface_w0"], about["swap_y_and_z"]) == ("1", "1")
    state = torch.load(tmp_path / "ball" / "medium" / "best.pth", weights_only=True)
    for name, kind in (("weights", "weight"), ("biases", "bias")):
        path = tmp_path / about[f"lod1_{name}"].removeprefix("data/")
        expected = torch.cat([tensor.flatten() for key, tensor in state.items() if key.endswith(kind)])
        assert np.array_equal(np.fromfile(path, "<f4"), expected.numpy())


LINEAR = {"net.0.0.weight": torch.ones(8, 3), "net.0.0.bias": torch.ones(8)}
LAST = {"net.1.0.weight": torch.ones(1, 8), "net.1.0.bias": torch.ones(1)}


@pytest.mark.parametrize(
    ("held", "match"),
    [
        ([1, 2], "list"),
        ({}, "0 state dicts"),
        ({"a": dict(LINEAR), "b": dict(LINEAR)}, "2 state dicts"),
        (dict(LINEAR), "0 sine layers"),
        ({**LINEAR, "net.1.0.weight": torch.ones(1, 7), "net.1.0.bias": torch.ones(1)}, "layer of 8"),
        ({**LINEAR, "net.1.0.weight": torch.ones(4, 8), "net.1.0.bias": torch.ones(4)}, "4 outputs"),
        ({**LINEAR, "net.1.0.weight": torch.ones(1, 8)}, "the last"),
        ({**LINEAR, "norm.running_mean": torch.ones(8), **LAST}, "running_mean"),
        ({**LINEAR, "net.1.0.weight": torch.full((1, 8), torch.nan), "net.1.0.bias": torch.ones(1)}, "NaN"),
        ({"w": torch.ones(8, 3, dtype=torch.int32), "b": torch.ones(8)}, "'w'"),
        ({**LINEAR, "net.0.0.weight": torch.ones(8, 4), **LAST}, "4 inputs"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_anything_else_is_refused_in_one_line(held: object, match: str, tmp_path: Path) -> None:
    torch.save(held, tmp_path / "other.pth")
    with refused("other.pth", match):
        read_siren(tmp_path / "other.pth")


class Bad:
    """What ``weights_only`` must not make."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("executed",)


def test_code_and_damage_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"net": Bad()}, tmp_path / "bad.pth")
    (tmp_path / "cut.pth").write_bytes((tmp_path / "bad.pth").read_bytes()[:100])
    (tmp_path / "text.pth").write_text("no weights")
    for name in ("bad.pth", "cut.pth", "text.pth", "none.pth"):
        with refused(name, "state dict"):
            read_siren(tmp_path / name)
    assert "executed" not in capsys.readouterr().out


def test_what_is_missing_is_named(networks: list[nn.Sequential], tmp_path: Path) -> None:
    model = write(tmp_path / "ball", networks)
    with refused("best.pth", "--deltas"):
        read_official(model)
    with refused("--deltas", "expected 2"):
        read_official(model, deltas=[0.1])
    write_cloud_ply(tmp_path / "far.ply", PointCloud(30 * cube(500).numpy()))
    with refused("far.ply", "coordinates"):
        read_official(model, cloud=tmp_path / "far.ply")
    with refused("ball", "mplicits import"):
        find_field(model)
    (model / "frame.json").write_text('{"deltas": 3}')
    with refused("frame.json", "remove it"):
        read_official(model, deltas=DELTAS)
    (model / "medium" / "best.pth").unlink()
    with refused("medium", "no such file"):
        read_official(model, deltas=DELTAS)


def test_fields_that_the_format_cannot_hold(tmp_path: Path) -> None:
    for name, field in (("ball", Sphere(radius=0.5)), ("moves", small_spacetime())):
        save_field(tmp_path / f"{name}.safetensors", field)
        with refused(f"{name}.safetensors", "plain SIRENs"):
            export_official(tmp_path / f"{name}.safetensors", tmp_path / "out")
