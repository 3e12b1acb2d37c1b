"""Fields, textures and radiances survive the disk; damaged and foreign files are one clear line."""

import functools
import json
from collections.abc import Callable
from pathlib import Path

import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from fields import small_multiscale, small_spacetime
from mplicits.neural_fields.checkpoint import load_radiance, save_radiance, save_texture
from mplicits.neural_fields.fields.csg import Bounded, Placed
from mplicits.neural_fields.networks.colors import BackgroundField, ColorSiren, Radiance
from mplicits.neural_fields.networks.grids import HashEncoding
from safetensors import safe_open
from safetensors.torch import save_file

GEOMETRY = nf.Siren(8, 2, num_features=3)


@pytest.mark.parametrize(
    "field", [nf.Siren(8, 2, omega=3.0, in_dim=4, num_features=2), small_multiscale(0.2), small_spacetime(0.2)]
)
def test_round_trip(field: nf.Field, dtype: torch.dtype, tmp_path: Path) -> None:
    field = field.to(dtype)
    similarity = nf.Similarity((4.5e6, -3.0, 0.25), 12.5)
    nf.save_field(tmp_path / "f.safetensors", field, similarity=similarity, metadata={"seed": 3})
    loaded = nf.load_field(tmp_path / "f.safetensors")
    x = torch.rand(20, field.in_dim, dtype=dtype)
    torch.testing.assert_close(loaded.field.jet(x), field.jet(x), rtol=0, atol=0)
    assert loaded.similarity == similarity
    assert loaded.metadata == {"seed": 3}
    assert [path.name for path in tmp_path.iterdir()] == ["f.safetensors"]


def test_closed_forms_and_combinations_of_fields(tmp_path: Path) -> None:
    scan, far = small_multiscale(0.2), nf.Similarity((0.5, -0.25, 0.125), 0.5)
    placed = Placed(Bounded(nf.Siren(8, 1), radius=1.5), far)
    cut = nf.Union(scan, placed, nf.Shell(nf.Torus(), inside=0.125), smooth=0.25)
    box, plane = nf.Box(half_size=(0.5, 0.25, 0.125)), nf.Plane(normal=(0.0, 0.0, 2.0), offset=0.0625)
    plate, ball = nf.Intersection(box, plane, nf.Capsule()), nf.Sphere(radius=np.float32(0.25))
    field = nf.Difference(cut, plate, nf.Offset(scan, -0.0625), ball)  # `scan` is part of it twice
    nf.save_field(tmp_path / "f.safetensors", field)
    loaded = nf.load_field(tmp_path / "f.safetensors").field
    assert repr(loaded) == repr(field).replace("np.float32(0.25)", "0.25")
    x = torch.rand(50, 3) - 0.5
    for level in range(3):
        torch.testing.assert_close(loaded.jet(x, level=level), field.jet(x, level=level), rtol=0, atol=0)


def test_similarity_goes_there_and_back() -> None:
    points = torch.rand(100, 3, dtype=torch.float64).numpy() * 0.5 + [5e5, 4.2e6, 80.0]
    similarity = nf.Similarity.to_unit_sphere(points)
    unit = similarity.to_unit(points)
    assert abs((unit**2).sum(axis=1).max() - 1) < 1e-9
    assert abs(similarity.to_input(unit.astype("float32")) - points).max() < 1e-6
    with pytest.raises(ValueError, match="scale"):
        nf.Similarity((0.0, 0.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="coincide"):
        nf.Similarity.to_unit_sphere(points[:1].repeat(5, axis=0))


def test_a_field_that_cannot_be_described_leaves_nothing(tmp_path: Path) -> None:
    for field in (
        nf.FunctionField(torch.linalg.vector_norm),
        nf.Union(nf.Sphere(), nf.FunctionField(torch.linalg.vector_norm)),
    ):
        with pytest.raises(TypeError, match="FunctionField cannot be saved"):
            nf.save_field(tmp_path / "f.safetensors", field)
    assert not list(tmp_path.iterdir())


def texture(geometry: nf.Field) -> nf.TextureField:
    network = ColorSiren(16, 3, omega=4.0)
    return nf.TextureField(geometry, network, delta=0.15, geometry_level=-1, outside=(0.1, 0.2, 0.3))


def test_textures_survive_the_disk(tmp_path: Path, dtype: torch.dtype) -> None:
    field, path = texture(small_multiscale()).to(dtype), tmp_path / "t.safetensors"
    save_texture(path, field)
    nf.save_field(tmp_path / "f.safetensors", field.geometry)
    geometry = nf.load_field(tmp_path / "f.safetensors").field
    loaded, x = nf.load_texture(path, geometry), 2 * torch.rand(500, 3, dtype=dtype) - 1
    assert loaded.geometry is geometry
    assert loaded.geometry_level == 2
    assert torch.equal(loaded.value(x), field.value(x))
    assert torch.equal(loaded.jet(x).gradient, field.jet(x).gradient)
    assert not any(parameter.requires_grad for parameter in loaded.network.parameters())
    assert nf.load_texture(path, field.geometry.double()).geometry.like.dtype == torch.float64  # any precision will do


def radiance(*, grid: bool = True, outside: bool = True) -> Radiance:
    table = {"levels": 3, "table_size": 64, "features": 2, "coarsest": 2, "finest": 9}
    torch.manual_seed(0)
    color = nf.ColorNetwork(3, width=8, depth=1, point_frequencies=2, grid=HashEncoding(**table) if grid else None)
    around = HashEncoding(**table, extent=2.0) if grid else None
    sizes = {"width": 6, "depth": 2, "point_frequencies": 3, "view_frequencies": 2}
    behind = BackgroundField(**sizes, grid=around) if outside else None
    return Radiance(color, behind, torch.tensor([0.1, 0.2, 0.3]), 123.5)


@pytest.mark.parametrize(("grid", "outside"), [(True, True), (False, True), (True, False)])
def test_rays_see_the_same_before_and_after(grid: bool, outside: bool, tmp_path: Path) -> None:
    before, path = radiance(grid=grid, outside=outside), tmp_path / "r.safetensors"
    save_radiance(path, before, GEOMETRY, metadata={"sampling": [1, 2]})
    after, metadata = load_radiance(path, GEOMETRY)
    assert metadata == {"sampling": [1, 2]}
    assert not any(p.requires_grad for p in after.color.parameters())
    generator = torch.Generator().manual_seed(1)
    eyes = torch.tensor([[0.0, 0.0, 3.0]]).expand(20, 3)
    rays = eyes, torch.nn.functional.normalize(0.4 * torch.randn(20, 3, generator=generator) - eyes, dim=1)
    first, second = (
        nf.render_volume(GEOMETRY, a.color, *rays, inv_std=a.inv_std, background=a.background, outside=a.outside).color
        for a in (before, after)
    )
    assert torch.equal(first, second)
    assert float(first.detach().std()) > 0


# A kind of file: how one is written, and how it is read.
KINDS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "field": (lambda path: nf.save_field(path, GEOMETRY), nf.load_field),
    "texture": (lambda path: save_texture(path, texture(GEOMETRY)), lambda path: nf.load_texture(path, GEOMETRY)),
    "radiance": (lambda path: save_radiance(path, radiance(), GEOMETRY), lambda path: load_radiance(path, GEOMETRY)),
}


def rewrite(path: Path, kind: str, place: tuple[str, ...], value: object) -> None:
    """Replace a value in a file's header, or a tensor by one that is not finite."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = json.loads((file.metadata() or {})[f"mplicits-{kind}"])
    if value is None:
        tensors[place[0]].fill_(torch.nan)
        header.pop("checksum")
    else:
        functools.reduce(dict.__getitem__, place[:-1], header)[place[-1]] = value
    save_file(tensors, path, metadata={f"mplicits-{kind}": json.dumps(header)})


DAMAGES: dict[str, tuple[str, Callable[[Path, str], object]]] = {
    "missing": ("no such file", lambda path, kind: path.unlink()),
    "truncated": ("damaged", lambda path, kind: path.write_bytes(path.read_bytes()[:-50])),
    "not safetensors": ("damaged, or not a", lambda path, kind: path.write_text("ply\nformat ascii 1.0\n")),
    "foreign": ("a safetensors file, but not a", lambda path, kind: save_file({"a": torch.zeros(3)}, path)),
    "metadata": ("damaged, or not a", lambda path, kind: rewrite(path, kind, ("metadata",), [1])),
    "another kind": ("but not a", lambda path, kind: KINDS["texture" if kind == "field" else "field"][0](path)),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_and_foreign_files_are_one_line(damage: str, kind: str, tmp_path: Path) -> None:
    path, (message, spoil) = tmp_path / "x.safetensors", DAMAGES[damage]
    KINDS[kind][0](path)
    KINDS[kind][1](path)
    spoil(path, kind)
    with pytest.raises(nf.InputError, match=rf"x\.safetensors: .*{message}") as caught:
        KINDS[kind][1](path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("load", [nf.load_texture, load_radiance])
def test_colours_of_another_geometry_are_refused(load: Callable[[Path, nf.Field], object], tmp_path: Path) -> None:
    KINDS["texture" if load is nf.load_texture else "radiance"][0](tmp_path / "x.safetensors")
    with pytest.raises(nf.InputError, match=r"x\.safetensors: .*of another field"):
        load(tmp_path / "x.safetensors", nf.Siren(8, 2, num_features=3))


@pytest.mark.parametrize(
    ("kind", "place", "number"),
    [
        ("field", ("output.bias",), None),  # not finite
        ("texture", ("network.siren.output.bias",), None),
        ("radiance", ("color", "width"), 10**9),
        ("radiance", ("color", "depth"), 10**6),
        ("radiance", ("color", "grid", "levels"), 10**3),
        ("radiance", ("color", "grid", "levels"), 10**9),
        ("radiance", ("color", "grid", "table_size"), 3),
        ("radiance", ("outside", "width"), 7),
        ("radiance", ("inv_std",), float("nan")),
        ("radiance", ("outside",), 3),
    ],
)
def test_numbers_that_cannot_be_are_refused(kind: str, place: tuple[str, ...], number: object, tmp_path: Path) -> None:
    KINDS[kind][0](tmp_path / "x.safetensors")
    rewrite(tmp_path / "x.safetensors", kind, place, number)
    said = place[0].removeprefix("network.") if number is None else "damaged, or not a radiance"
    with pytest.raises(nf.InputError, match=rf"x\.safetensors: .*{said}"):
        KINDS[kind][1](tmp_path / "x.safetensors")
