"""The changes of docs/drop-in.md, made to hosts that consist of stubs."""

import functools
import os
import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hosts import Heads, points, ray_samples
from torch import nn

DOCUMENT = Path(__file__).parents[3] / "docs" / "drop-in.md"
TOKEN = re.compile(r"`[\w/]*\.(py|conf|yaml)`|^```diff\n(.*?)^```", re.MULTILINE | re.DOTALL)


def changed_code(section: str) -> list[str]:
    """The Python of one section of the document as it is after the change, block by block."""
    text = DOCUMENT.read_text(encoding="utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    language, blocks = "py", []
    for token in TOKEN.finditer(text):
        language = token[1] or language
        if token[2] and language == "py":
            after = [line[1:] for line in token[2].splitlines() if not line.startswith("-")]
            blocks.append(textwrap.dedent("\n".join(after)))
    return blocks


def apply(section: str, names: dict[str, Any]) -> dict[str, Any]:
    blocks = changed_code(section)
    assert blocks
    for block in blocks:
        exec(compile(block, f"{DOCUMENT.name}: {section}", "exec"), names)
    return names


def provide(monkeypatch: pytest.MonkeyPatch, module: str, *names: str) -> None:
    """Make ``from module import names`` work."""
    stub = ModuleType(module)
    for name in names:
        setattr(stub, name, Heads if name == "FieldHeadNames" else nn.Identity)
    for parent in [module[: match.start()] for match in re.finditer(r"\.", module)]:
        monkeypatch.setitem(sys.modules, parent, ModuleType(parent))
    monkeypatch.setitem(sys.modules, module, stub)


def test_neus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    provide(monkeypatch, "models.fields", "RenderingNetwork", "SDFNetwork", "SingleVarianceNetwork", "NeRF")
    runner = mock.Mock(device="cpu", learning_rate=5e-4, base_exp_dir=str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    torch.save({"lr": np.float64(5e-4)}, tmp_path / "checkpoints" / "last.pth")  # NeuS's rates are NumPy's
    names = {"self": runner, "os": os, "torch": torch, "checkpoint_name": "last.pth"}
    names["render_out"] = {"s_val": torch.full((4, 1), 0.05)}
    assert apply("NeuS", names)["checkpoint"] == {"lr": 5e-4}
    x = points(10)
    assert runner.sdf_network(x).shape == (10, 33)
    assert runner.sdf_network.gradient(x).shape == (10, 1, 3)
    assert runner.sdf_network.field.deltas.tolist() == pytest.approx([4 * 0.05 * 0.7])


def test_instant_nsr_pl() -> None:
    registry: dict[str, Any] = {}
    models = SimpleNamespace(register=lambda name: functools.partial(registry.setdefault, name))
    found = apply("instant-nsr-pl", {"models": models})
    config = SimpleNamespace(feature_dim=13, radius=1.5, isosurface=SimpleNamespace(resolution=64))
    geometry = registry["multiscale-sdf"](config)
    sdf, gradient, feature = geometry(points(10), with_grad=True, with_feature=True)
    assert (sdf.shape, gradient.shape, feature.shape) == ((10,), (10, 3), (10, 13))
    corner = torch.full((1, 3), 1.5)
    assert (corner * geometry.scale).norm() == pytest.approx(1)
    model = SimpleNamespace(geometry=geometry, variance=SimpleNamespace(inv_s=torch.tensor(40.0)))
    found["training_step"](mock.Mock(model=model, return_value=None), None, 0)  # the forward pass alone
    assert geometry.field.deltas.tolist() == pytest.approx([4 / 40 * geometry.scale])


def test_nerfstudio(monkeypatch: pytest.MonkeyPatch) -> None:
    provide(monkeypatch, "nerfstudio.field_components.field_heads", "FieldHeadNames")
    box = SimpleNamespace(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    model = SimpleNamespace(config=SimpleNamespace(sdf_field=SimpleNamespace(beta_init=0.1)), scene_box=box)
    apply("nerfstudio and sdfstudio", {"self": model, "anneal": 0.5})
    assert model.field.scale == pytest.approx(3**-0.5)
    assert model.field.cos_anneal_ratio == 0.5
    assert model.field.field.deltas.tolist() == pytest.approx([0.3])  # s is e at first: as wide as a band gets
    outputs = model.field(ray_samples(torch.ones(2, 3)), return_alphas=True)
    assert outputs[Heads.RGB].shape == (2, 3, 3)
    assert set(outputs) == set(Heads)
    assert model.field.deviation_network.get_variance().item() == pytest.approx(2.71828, rel=1e-4)
