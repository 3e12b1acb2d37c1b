"""What the direction of view adds to a texture, on a sphere under a lamp."""

import numpy as np
import pytest
import torch
from mplicits.neural_fields import Jet, Mesh, MultiscaleSDF, Siren, Sphere, TextureField, Union, ViewColor, extract_mesh
from mplicits.neural_fields.networks.sphere_init import solve_sphere
from mplicits.neural_fields.networks.texture import ColorSiren
from mplicits.pipelines.texture import highlights
from mplicits.pipelines.texture.highlights import FACING, LOOKS, fit_highlights
from mplicits.pipelines.training.trainer import StopFlag
from torch import Tensor

LAMP = torch.tensor([0.0, 0.6, 0.8])
PAINT = 0.25


def mirrored(direction: Tensor, normal: Tensor) -> Tensor:
    return direction - 2 * (direction * normal).sum(dim=-1, keepdim=True) * normal


class Lacquer(ViewColor):
    """Phong's: paint, and a power of the cosine between a mirrored ray and the lamp."""

    def __init__(self, shine: float) -> None:
        super().__init__(0, width=1, depth=1)
        self.shine = shine

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        normal = torch.nn.functional.normalize(jet.gradient, dim=-1)
        lobe = (mirrored(direction, normal) @ LAMP).clamp(min=0) ** 12
        return PAINT + self.shine * lobe[..., None].expand(*lobe.shape, 3)


def plain_texture() -> TextureField:
    network = ColorSiren(8, 1, mean=(PAINT, PAINT, PAINT))
    with torch.no_grad():
        network.siren.output.weight.zero_()
    return TextureField(Sphere(radius=0.5), network, delta=0.05)


def ball() -> Mesh:
    return extract_mesh(Sphere(radius=0.5), resolution=48)


@pytest.mark.parametrize("watched", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_lamp_is_learnt(watched: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At points and from directions that the network has not seen."""
    monkeypatch.setattr(highlights, "BATCH", 2048)  # a quarter: one lamp is soon learnt
    eyes = np.random.default_rng(1).normal(size=(30, 3))
    eyes *= 2 / np.linalg.norm(eyes, axis=1, keepdims=True)
    seen = list[str]()
    found = fit_highlights(
        Lacquer(0.5),
        plain_texture(),
        ball(),
        eyes if watched else None,
        steps=300,
        progress=lambda p: seen.append(p.stage),
    )
    assert found.before > 0.05
    assert found.after < 0.15 * found.before
    assert found.worth_it
    assert found.network.siren.in_dim == 6
    assert set(seen) == {highlights.STAGE}
    if watched:
        return
    # A place, and rays that are mirrored into the lamp and away from it; no camera may stand there.
    place, up = torch.tensor([0.0, 0.0, 0.5]), torch.tensor([0.0, 0.0, 1.0])
    lit, dark = (torch.cat((place, mirrored(way, up))) for way in (LAMP, torch.tensor([0.0, -0.6, 0.8])))
    gained = found.network.value(torch.stack((lit, dark)))
    assert (gained[0] - 0.5).abs().max() < 0.1
    assert gained[1].abs().max() < 0.1


def test_what_is_the_same_from_everywhere_is_not_worth_a_network() -> None:
    found = fit_highlights(Lacquer(0.0), plain_texture(), ball(), steps=20)
    assert found.before < 1e-6
    assert not found.worth_it


def test_points_are_seen_from_cameras_that_face_them_and_from_nowhere_else() -> None:
    """Two balls, one before the other: what the first hides is not looked at."""
    pair = Union(Sphere(radius=0.3), Sphere(center=(0.0, 0.0, -0.6), radius=0.2))
    texture = TextureField(pair, plain_texture().network, delta=0.05)
    eyes = np.array([[0.0, 0.0, 3.0], [2.0, 0.0, 2.0], [0.0, 0.0, 40.0]])
    looks = highlights._Looks.of(Lacquer(0.5), texture, extract_mesh(pair, resolution=48), eyes, 0)
    x, v = looks.places.double().split(3, dim=1)
    normal = torch.nn.functional.normalize(pair.jet(x.float()).gradient, dim=-1).double()
    # Each ray leads back to a camera, and faces the surface.
    towards = torch.from_numpy(eyes)[None] - x[:, None]
    off = torch.linalg.cross(towards, v[:, None].expand_as(towards)).norm(dim=-1) / towards.norm(dim=-1)
    assert off.min(dim=1).values.max() < 1e-4
    assert ((v * normal).sum(dim=-1) < -FACING + 1e-4).all()
    # Of the ball behind only what is seen past the first one.
    behind = x[:, 2] < -0.35
    assert 0 < behind.sum() < (~behind).sum()
    past = torch.linalg.cross(x, v).norm(dim=-1)
    assert past[behind].min() > 0.3 - 2e-3
    assert (looks.points.diff() >= 0).all()
    assert looks.points.bincount().max() <= len(eyes)


def test_without_cameras_points_are_seen_from_all_around() -> None:
    ball_texture = plain_texture()
    away = np.array([[0.0, 0.0, 0.01]])  # in the ball: sees nothing of its outside
    for eyes in (None, away):
        looks = highlights._Looks.of(Lacquer(0.5), ball_texture, ball(), eyes, 0)
        assert len(looks.points) == LOOKS * highlights.PLACES
        x, v = looks.places.split(3, dim=1)
        cosine = -(v * torch.nn.functional.normalize(x, dim=-1)).sum(dim=-1)
        # Density by the cosine: its mean is 2/3, of which so many are known to within a thousandth.
        assert float(cosine.mean()) == pytest.approx(2 / 3, abs=5e-3)
        known, unseen = looks.parted(0.1)
        assert len(unseen.points) == LOOKS * highlights.PLACES // 10
        assert int(known.points.max()) < int(unseen.points.min())


def test_a_stop_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while it learns."""
    monkeypatch.setattr(StopFlag, "requested", True, raising=False)
    monkeypatch.setattr(StopFlag, "__init__", lambda self: None)
    with pytest.raises(highlights.Interrupted):
        fit_highlights(Lacquer(0.5), plain_texture(), ball(), steps=5)


def test_any_geometry_and_level() -> None:
    """Two levels and features: the texture's level is the one whose normals and features are asked for."""
    torch.manual_seed(0)
    base = Siren(16, 2, omega=6.0, num_features=4)
    solve_sphere(base, 0.6)
    field = MultiscaleSDF(base, [Siren(8, 2, omega=8.0, num_features=4, output_gain=0.1)], [0.1])
    color = ViewColor(4, width=8, depth=1)
    texture = TextureField(field, ColorSiren(8, 1), delta=0.05, geometry_level=0)
    found = fit_highlights(color.requires_grad_(False), texture, extract_mesh(field, resolution=32, level=0), steps=2)
    assert np.isfinite([found.before, found.after]).all()
