"""What rays see survives the disk, bit for bit; what is damaged or another geometry's is one clear line."""

import json
from pathlib import Path

import pytest
import torch
from fields import small_multiscale
from mplicits.neural_fields import InputError, Siren, ViewColor, render_volume, save_field
from mplicits.neural_fields.checkpoint import load_radiance, save_radiance
from mplicits.neural_fields.networks.hash_encoding import HashEncoding
from mplicits.neural_fields.networks.radiance import Outside, Radiance
from safetensors import safe_open
from safetensors.torch import save_file

GEOMETRY = Siren(8, 2, num_features=3)


def radiance(*, grid: bool = True, outside: bool = True) -> Radiance:
    """A small one, of random numbers."""
    table = {"levels": 3, "table_size": 64, "features": 2, "coarsest": 2, "finest": 9}
    torch.manual_seed(0)
    color = ViewColor(3, width=8, depth=1, point_frequencies=2, grid=HashEncoding(**table) if grid else None)
    around = HashEncoding(**table, extent=2.0) if grid else None
    behind = Outside(width=6, depth=2, point_frequencies=3, view_frequencies=2, grid=around) if outside else None
    return Radiance(color, behind, torch.tensor([0.1, 0.2, 0.3]), 123.5)


def header_of(path: Path) -> dict[str, object]:
    with safe_open(path, framework="pt") as file:
        return json.loads((file.metadata() or {})["mplicits-radiance"])


@pytest.mark.parametrize(("grid", "outside"), [(True, True), (False, True), (True, False)])
def test_rays_see_the_same_before_and_after(grid: bool, outside: bool, tmp_path: Path) -> None:
    before, path = radiance(grid=grid, outside=outside), tmp_path / "r.safetensors"
    save_radiance(path, before, GEOMETRY, metadata={"sampling": [1, 2]})
    after, metadata = load_radiance(path, GEOMETRY)
    assert metadata == {"sampling": [1, 2]}
    assert not any(p.requires_grad for p in after.color.parameters())
    generator = torch.Generator().manual_seed(1)
    origins = torch.tensor([[0.0, 0.0, 3.0]]).expand(20, 3)
    directions = torch.nn.functional.normalize(0.4 * torch.randn(20, 3, generator=generator) - origins, dim=1)
    first, second = (
        render_volume(
            GEOMETRY,
            one.color,
            origins,
            directions,
            inv_std=one.inv_std,
            background=one.background,
            outside=one.outside,
        ).color
        for one in (before, after)
    )
    assert torch.equal(first, second)
    assert float(first.detach().std()) > 0


def test_colours_of_another_geometry_are_refused(tmp_path: Path) -> None:
    save_radiance(tmp_path / "r.safetensors", radiance(), GEOMETRY)
    with pytest.raises(InputError, match=r"r\.safetensors: the colours of another field than this one"):
        load_radiance(tmp_path / "r.safetensors", Siren(8, 2, num_features=3))


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.safetensors"
    with pytest.raises(InputError, match=r"no such file; expected a radiance .* \(radiance\.safetensors\)"):
        load_radiance(path, GEOMETRY)
    save_field(path, small_multiscale(0.2))
    with pytest.raises(InputError, match="a safetensors file, but not a radiance"):
        load_radiance(path, GEOMETRY)
    save_radiance(path, radiance(), GEOMETRY)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"r\.safetensors: damaged"):
        load_radiance(path, GEOMETRY)


@pytest.mark.parametrize(
    ("place", "number"),
    [
        (("color", "width"), 10**9),
        (("color", "depth"), 10**6),
        (("color", "grid", "levels"), 10**3),
        (("color", "grid", "levels"), 10**9),
        (("color", "grid", "table_size"), 3),
        (("outside", "width"), 7),
        (("inv_std",), float("nan")),
        (("outside",), 3),
        (("metadata",), [1]),
    ],
)
def test_numbers_that_cannot_be_are_refused(place: tuple[str, ...], number: object, tmp_path: Path) -> None:
    path = tmp_path / "r.safetensors"
    save_radiance(path, radiance(), GEOMETRY)
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header = header_of(path)
    inner: dict = header
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = number
    save_file(tensors, path, metadata={"mplicits-radiance": json.dumps(header)})
    with pytest.raises(InputError, match=r"r\.safetensors: damaged, or not a radiance"):
        load_radiance(path, GEOMETRY)
