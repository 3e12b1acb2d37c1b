"""Fields of tiles: weights that add up to one, exact where tiles agree, bounded slopes, tiles loaded when needed."""

from itertools import pairwise
from pathlib import Path

import mplicits.neural_fields as nf
import pytest
import torch
from fields import small_multiscale, small_tiled
from mplicits.neural_fields.checkpoint import TileFiles
from mplicits.neural_fields.fields.csg import Placed
from mplicits.neural_fields.fields.tiled import Split, Tile, TiledField
from refusals import refused
from torch import Tensor

HERE = nf.Similarity.identity()
# Planes of all axes; two of them cross, and one ends at another.
SPLITS = [
    Split(0, 0.05, 0.1, 1, 2),
    Split(1, -0.1, 0.1, -1, 3),
    Split(2, 0.2, 0.05, -2, -3),
    Split(1, 0.3, 0.15, -4, -5),
]
FINE = torch.finfo(torch.float64).eps


def tiles_of(field: nf.Field, *, count: int = 5, **options: float) -> TiledField:
    """Tiles that are one field, seen from different places at different scales."""
    tiles = []
    for k in range(count):
        center, scale = (0.1 * k, -0.05 * k, 0.02), 1.1 + 0.1 * k
        moved = nf.Similarity(tuple(-c / scale for c in center), 1 / scale)
        tiles.append(Tile(Placed(field, moved), nf.Similarity(center, scale)))
    return TiledField(tiles.__getitem__, SPLITS[: count - 1], **options).double()


def cube(count: int, half: float = 1.0) -> Tensor:
    return half * (2 * torch.rand(count, 3, dtype=torch.float64) - 1)


def test_weights_add_up_to_one_and_their_gradients_to_zero() -> None:
    field, x = tiles_of(nf.Plane(), reach=1.0), cube(5000).requires_grad_()
    total, slopes, covered = torch.zeros(5000).double(), torch.zeros(5000, 3).double(), torch.zeros(5000)
    for _, rows, weight, slope in field.weights(x):
        (own,) = torch.autograd.grad(weight.sum(), x, retain_graph=True)
        torch.testing.assert_close(own[rows], slope, rtol=0, atol=64 * FINE / 0.05)
        total, slopes = total.index_add(0, rows, weight.detach()), slopes.index_add(0, rows, slope.detach())
        covered.index_add_(0, rows, torch.ones(len(rows)))
        assert bool((weight >= 0).all())
    assert float((total - 1).abs().max()) < 16 * FINE
    assert float(slopes.abs().max()) < 64 * FINE / 0.05
    assert set(covered.tolist()) >= {1, 2, 3}


@pytest.mark.parametrize("level", [0, 1, 2])
def test_tiles_of_one_field_are_that_field_up_to_the_reach(level: int) -> None:
    part = small_multiscale(0.4).double()
    field = tiles_of(part, reach=0.25, deltas=part.deltas.tolist())
    x = cube(3000, 0.7)
    with torch.no_grad():
        jet, truth = field.jet(x, level=level), part.jet(x, level=level)
    near = truth.value.abs() < 0.25 - 1e-9
    assert 0.05 < float(near.double().mean()) < 1
    torch.testing.assert_close(jet.value, truth.value.clamp(-0.25, 0.25), rtol=0, atol=1e-12)
    torch.testing.assert_close(jet.gradient[near], truth.gradient[near], rtol=0, atol=1e-10)
    assert float(jet.gradient[truth.value.abs() > 0.25 + 1e-9].abs().max()) < 1e-10


def test_tiles_that_differ_keep_their_bound_of_the_slope() -> None:
    """Planes at heights up to ``gap`` apart: the slope is that of the planes and what differences add."""
    gap = 0.08
    tiles = [Tile(nf.Plane(offset=sign * gap / 2), HERE) for sign in (1, 1, -1, 1, -1)]
    field = TiledField(tiles.__getitem__, SPLITS, reach=1.0, gap=gap).double()
    slopes = field.jet(cube(20_000)).gradient.norm(dim=1)
    assert 2.1 < float(slopes.max()) < field.slope_bound(1.0)
    assert field.slope_bound(1.0) == 1 + 3 * 0.75 / 0.05 * gap
    assert nf.Union(nf.Sphere(), nf.Offset(field, 0.1)).slope_bound(1.0) == field.slope_bound(1.0)
    assert nf.Union(nf.Sphere(), nf.Plane()).slope_bound(1.25) == 1.25


def test_beyond_its_domain_a_tile_goes_on_as_at_its_border() -> None:
    field = TiledField([Tile(nf.Plane(), HERE)].__getitem__, (), reach=10.0, domain=1.0).double()
    jet = field.jet(torch.tensor([[5.0, 0.0, 0.5], [0.0, 3.0, 4.0]]).double())
    assert jet.value.tolist() == [0.5, 1.0]
    assert jet.gradient.tolist() == [[0, 0, 1], [0, 0, 0]]


def test_a_ball_is_traced_and_meshed_across_tiles() -> None:
    ball = nf.Sphere(radius=0.6)
    field = tiles_of(ball, reach=0.2).float()
    mesh = nf.extract_mesh(field, resolution=48, lipschitz=1.0)
    whole = nf.extract_mesh(ball, resolution=48)
    assert len(mesh.vertices) == len(whole.vertices)
    assert abs((mesh.vertices**2).sum(axis=1) ** 0.5 - 0.6).max() < 1e-5
    edges = torch.from_numpy(mesh.faces).sort(dim=1).values
    pairs = torch.cat([edges[:, [a, b]] for a, b in ((0, 1), (1, 2), (0, 2))])
    assert set(torch.unique(pairs, dim=0, return_counts=True)[1].tolist()) == {2}
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    hits = nf.sphere_trace(field, -2 * directions, directions)
    assert bool(hits.mask.all())
    torch.testing.assert_close(hits.depth, torch.full((200,), 1.4), rtol=0, atol=1e-4)


def test_at_most_so_many_tiles_are_held() -> None:
    loaded: list[int] = []

    def load(number: int) -> Tile:
        loaded.append(number)
        return Tile(nf.Plane(), HERE)

    field = TiledField(load, SPLITS, reach=1.0, held=2)
    field(torch.tensor([[-0.9, -0.9, 0.0]]))
    assert loaded == [0]
    field(cube(500).float())
    assert sorted(set(loaded)) == [0, 1, 2, 3, 4]
    assert len(field._open) == 2
    before = len(loaded)
    field.double()(cube(500))  # in another precision they are loaded again
    assert len(loaded) > before


def test_tiles_on_disk(tmp_path: Path) -> None:
    parts = [small_multiscale(0.2), nf.Sphere(radius=0.4)]
    home = nf.Similarity((100.0, 0.0, 0.0), 2.0)
    for number, part in enumerate(parts):
        similarity = nf.Similarity((100.0 + number, 0.0, 0.0), 1.5)
        nf.save_field(tmp_path / f"{number}.safetensors", part, similarity=similarity)
    files = TileFiles(tmp_path, ("0.safetensors", "1.safetensors"), home, (1, -1))
    field = TiledField(files, [Split(0, 0.25, 0.1, -1, -2)], deltas=(0.2, 0.1), reach=0.3, gap=0.01)
    nf.save_field(tmp_path / "field.safetensors", field, similarity=home)
    loaded = nf.load_field(tmp_path / "field.safetensors")
    x = cube(200).float()
    for level in range(3):
        torch.testing.assert_close(loaded.field.jet(x, level=level), field.jet(x, level=level), rtol=0, atol=0)
    # The same point of the second tile, from the input and from both its places.
    place = torch.tensor([[0.5, 0.1, 0.0]])
    own = parts[1]((place * 2 + torch.tensor([100.0, 0, 0]) - torch.tensor([101.0, 0, 0])) / 1.5)
    torch.testing.assert_close(loaded.field(place), (-own * 1.5 / 2).clamp(-0.3, 0.3))
    (tmp_path / "1.safetensors").unlink()
    with refused("1.safetensors", "bring it back"):
        nf.load_field(tmp_path / "field.safetensors")
    with pytest.raises(TypeError, match="TiledField cannot be saved"):
        nf.save_field(tmp_path / "other.safetensors", small_tiled())


@pytest.mark.parametrize(
    ("splits", "options", "message"),
    [
        ([Split(0, 0.0, 0.1, -1, -1)], {}, "each once"),
        ([Split(0, 0.0, 0.1, 0, -1)], {}, "each once"),
        ([Split(0, 0.0, 0.0, -1, -2)], {}, "half"),
        ([], {"reach": 0.0}, "reach"),
        ([], {"domain": -1.0}, "domain"),
    ],
)
def test_refusals(splits: list[Split], options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TiledField([].__getitem__, splits, **{"reach": 1.0} | options)


def test_planes_of_one_axis_do_not_meet() -> None:
    """With tiles wider than two blends, as the docstring of the bound needs, at most one plane of an axis counts."""
    places = [-0.5, 0.0, 0.5]
    splits = [Split(0, places[1], 0.1, 1, 2), Split(0, places[0], 0.1, -1, -2), Split(0, places[2], 0.1, -3, -4)]
    assert all(b - a > 4 * 0.1 for a, b in pairwise(places))
    field = TiledField([Tile(nf.Plane(), HERE)].__getitem__, splits, reach=1.0)
    x = torch.linspace(-1, 1, 401)[:, None] * torch.tensor([1.0, 0, 0])
    covered = torch.zeros(401)
    for _, rows, _, _ in field.weights(x):
        covered[rows] += 1
    assert set(covered.tolist()) == {1, 2}
