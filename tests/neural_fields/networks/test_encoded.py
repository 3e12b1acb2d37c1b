from pathlib import Path

import pytest
import torch
from fields import cube, small_encoded, small_multiscale
from mplicits.neural_fields import NeuSGeometry, Plane, Siren, load_field, save_field
from mplicits.neural_fields.networks.encoded import EncodedField
from mplicits.neural_fields.networks.grids import HashEncoding


def test_geometry_is_the_fields_own_bit_for_bit() -> None:
    field, x = small_encoded(), cube(200, dtype=torch.float32)
    inner = field.field
    assert field.num_levels == inner.num_levels
    assert field.deltas is inner.deltas
    for level in range(field.num_levels):
        found, own = (
            [
                *part.jet(x, level=level)[:2],
                part.value(x, level=level),
                part.in_band(x, level=level),
                part.second_jet(x, level=level, dims=2).hessian,
            ]
            for part in (field, inner)
        )
        torch.testing.assert_close(found, own, rtol=0, atol=0)


def test_features_are_the_fields_and_then_the_encodings() -> None:
    field, x = small_encoded(), cube(200, dtype=torch.float32)
    inner, encoded = field.field, 2.0 * field.grid(x)
    for features, own in (
        (field.jet(x).features, inner.jet(x).features),
        (field.value_features(x)[1], inner.value_features(x)[1]),
        (field.second_jet(x).features, inner.second_jet(x).features),
    ):
        assert features.shape == (200, 2 + field.grid.size)
        assert torch.equal(features, torch.cat((own, encoded), dim=-1))
    assert EncodedField(Siren(8, 1)).jet(x).features.shape == (200, 24)


def test_colours_alone_do_not_bend_the_surface() -> None:
    network, x = NeuSGeometry(small_encoded(), scale=0.7), cube(200, dtype=torch.float32)
    network(x)[:, 3:].square().sum().backward()
    field = network.field
    assert field.grid.table.grad.abs().max() > 0
    assert all(p.grad is None or not p.grad.any() for p in field.field.parameters())


def test_a_step_of_adam_moves_what_a_table_says_by_the_gain_times_the_rate() -> None:
    """Adam's first step is the rate, whatever the gradient: in the middle of a cell all eight corners move by it."""
    field = EncodedField(Plane(), HashEncoding(levels=1, coarsest=1, finest=1, features=1), gain=64.0)
    optimizer = torch.optim.Adam(field.parameters(), lr=5e-4)
    before = field.jet(torch.zeros(1, 3)).features
    before.sum().backward()
    optimizer.step()
    moved = field.jet(torch.zeros(1, 3)).features - before
    assert moved.item() == pytest.approx(-64 * 5e-4, rel=1e-3)


def test_it_is_kept_in_files_and_state_dicts(tmp_path: Path) -> None:
    field, x = small_encoded(), cube(200, dtype=torch.float32)
    save_field(tmp_path / "field.safetensors", field)
    saved = load_field(tmp_path / "field.safetensors").field
    assert isinstance(saved, EncodedField)
    torch.testing.assert_close(saved.jet(x), field.jet(x), rtol=0, atol=0)
    other = EncodedField(small_multiscale(0.4), HashEncoding(levels=2, table_size=512, coarsest=4, finest=16))
    with pytest.raises(RuntimeError, match=r"gain is 2\.0 where the tensors come from and 64\.0 here"):
        other.load_state_dict(field.state_dict())
