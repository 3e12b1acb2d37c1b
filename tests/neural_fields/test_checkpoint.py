"""Fields survive the disk; damaged and foreign files are one clear line."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fields import small_multiscale, small_spacetime
from mplicits.neural_fields import (
    Box,
    Capsule,
    Difference,
    Field,
    FunctionField,
    InputError,
    Intersection,
    Offset,
    Plane,
    Shell,
    Similarity,
    Siren,
    Sphere,
    Torus,
    Union,
    load_field,
    save_field,
)
from mplicits.neural_fields.fields.csg import Bounded, Placed
from safetensors.torch import save_file


@pytest.mark.parametrize(
    "field", [Siren(8, 2, omega=3.0, in_dim=4, num_features=2), small_multiscale(0.2), small_spacetime(0.2)]
)
def test_round_trip(field: Field, dtype: torch.dtype, tmp_path: Path) -> None:
    field = field.to(dtype)
    similarity = Similarity((4.5e6, -3.0, 0.25), 12.5)
    save_field(tmp_path / "f.safetensors", field, similarity=similarity, metadata={"seed": 3})
    loaded = load_field(tmp_path / "f.safetensors")
    x = torch.rand(20, field.in_dim, dtype=dtype)
    for a, b in zip(loaded.field.jet(x), field.jet(x), strict=True):
        assert torch.equal(a, b)
    assert loaded.similarity == similarity
    assert loaded.metadata == {"seed": 3}
    assert [path.name for path in tmp_path.iterdir()] == ["f.safetensors"]


def test_closed_forms_and_combinations_of_fields(tmp_path: Path) -> None:
    scan, far = small_multiscale(0.2), Similarity((0.5, -0.25, 0.125), 0.5)
    cut = Union(scan, Placed(Bounded(Siren(8, 1), radius=1.5), far), Shell(Torus(), inside=0.125), smooth=0.25)
    plate = Intersection(Box(half_size=(0.5, 0.25, 0.125)), Plane(normal=(0.0, 0.0, 2.0), offset=0.0625), Capsule())
    field = Difference(cut, plate, Offset(scan, -0.0625), Sphere(radius=np.float32(0.25)))  # one part of it twice
    save_field(tmp_path / "f.safetensors", field)
    loaded = load_field(tmp_path / "f.safetensors").field
    assert repr(loaded) == repr(field).replace("np.float32(0.25)", "0.25")
    x = torch.rand(50, 3) - 0.5
    for level in range(3):
        for a, b in zip(loaded.jet(x, level=level), field.jet(x, level=level), strict=True):
            assert torch.equal(a, b)


def test_similarity_goes_there_and_back() -> None:
    points = torch.rand(100, 3, dtype=torch.float64).numpy() * 0.5 + [5e5, 4.2e6, 80.0]
    similarity = Similarity.to_unit_sphere(points)
    unit = similarity.to_unit(points)
    assert abs((unit**2).sum(axis=1).max() - 1) < 1e-9
    assert abs(similarity.to_input(unit.astype("float32")) - points).max() < 1e-6
    with pytest.raises(ValueError, match="scale"):
        Similarity((0.0, 0.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="coincide"):
        Similarity.to_unit_sphere(points[:1].repeat(5, axis=0))


def test_a_field_that_cannot_be_described_leaves_nothing(tmp_path: Path) -> None:
    for field in (FunctionField(torch.linalg.vector_norm), Union(Sphere(), FunctionField(torch.linalg.vector_norm))):
        with pytest.raises(TypeError, match=r"FunctionField cannot be saved.*a mesh of it can"):
            save_field(tmp_path / "f.safetensors", field)
    assert not list(tmp_path.iterdir())


def saved(path: Path) -> Path:
    save_field(path, Siren(8, 2))
    return path


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_field(tmp_path / "none.safetensors")


def test_truncated_file(tmp_path: Path) -> None:
    path = saved(tmp_path / "f.safetensors")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"f\.safetensors: damaged"):
        load_field(path)


def test_not_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "f.safetensors"
    path.write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(InputError, match="damaged, or not a field"):
        load_field(path)


def test_foreign_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "f.safetensors"
    save_file({"a": torch.zeros(3)}, path)
    with pytest.raises(InputError, match="a safetensors file, but not a field"):
        load_field(path)


def test_not_finite(tmp_path: Path) -> None:
    network = Siren(8, 2)
    with torch.no_grad():
        network.output.bias.fill_(float("nan"))
    save_field(tmp_path / "f.safetensors", network)
    with pytest.raises(InputError, match=r"'output\.bias' has NaN"):
        load_field(tmp_path / "f.safetensors")
