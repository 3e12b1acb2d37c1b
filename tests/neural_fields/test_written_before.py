"""Files that earlier versions wrote load, with the same values: types in them are named, and modules move."""

from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import load_field, save_field

WRITTEN = Path(__file__).parent / "written"


def test_a_field_of_the_network_of_neus(tmp_path: Path) -> None:
    """Written by `save_field` at commit 9deaa32, when its module was `neural_fields.baselines.neus`."""
    field = load_field(WRITTEN / "neus.safetensors").field
    x = torch.linspace(-0.8, 0.8, 12).reshape(4, 3)
    expected = [0.23960894, -0.30286300, 0.34135771, 1.64951944]
    assert field.value(x).tolist() == pytest.approx(expected, abs=1e-6)
    save_field(tmp_path / "again.safetensors", field)
    assert load_field(tmp_path / "again.safetensors").field.state_dict().keys() == field.state_dict().keys()
