"""A run with a texture: its colours in meshes, pictures and the viewer."""

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from mplicits.datasets import look_at, read_textured, sample_textured
from mplicits.neural_fields import MultiscaleSDF, Siren, TextureField, map_colors, save_field
from mplicits.neural_fields.checkpoint import save_texture
from mplicits.neural_fields.networks.colors import ColorSiren
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.render.trace import trace_view
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.web.export import pack


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two levels with a closed surface, and a texture of strong colours."""
    base, residual = Siren(3, 1, omega=1.0), Siren(8, 1, omega=5.0, output_gain=0.02)
    torch.manual_seed(1)
    network = ColorSiren(16, 1, omega=6.0)
    with torch.no_grad():
        # Σ cos(2.2 xᵢ) has convex level sets around the origin.
        (layer,) = base.layers
        layer.weight.copy_(2.2 * torch.eye(3))
        layer.bias.fill_(torch.pi / 2)
        base.output.weight.fill_(-0.5)
        base.output.bias.fill_(1.0)
    field = MultiscaleSDF(base, [residual], [0.1])
    texture = TextureField(field, network, delta=0.1)
    directory = tmp_path_factory.mktemp("run")
    save_field(directory / "field.safetensors", field)
    save_texture(directory / "texture.safetensors", texture)
    return directory, texture.requires_grad_(False)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_vertices_have_the_colours_of_the_texture(run, tmp_path, suffix):
    directory, texture = run
    out = tmp_path / f"mesh{suffix}"
    assert main(["mesh", str(directory), "-o", str(out), "--resolution", "24"]) == 0
    surface = read_surface(out)
    expected = texture.colors(torch.from_numpy(surface.vertices).float()).numpy()
    np.testing.assert_allclose(surface.colors, expected, atol=0.006)
    assert float(expected.std(axis=0).min()) > 0.02
    assert main(["mesh", str(directory), "-o", str(out), "--resolution", "24", "--no-colors"]) == 0
    assert read_surface(out).colors is None


@pytest.mark.parametrize(
    ("level", "delta", "tolerance"),
    [(0, 0.1, 1e-5), (1, 0.1, 1e-5), pytest.param(1, 1e-7, 1e-3, id="moved to the surface from outside the band")],
)
def test_pixels_have_the_colours_of_the_texture(run, level, delta, tolerance):
    _, texture = run
    camera = look_at((0.5, 0.8, 3.0), (0, 0, 0), width=40, height=40)
    banded = TextureField(texture.geometry, texture.network, delta=delta)
    seen = trace_view(texture.geometry, camera, level=level, colors=lambda x: map_colors(banded, x).values)
    assert len(seen.pixel) > 200
    torch.testing.assert_close(seen.color, texture.colors(seen.position), atol=tolerance, rtol=0)
    assert trace_view(texture.geometry, camera, level=level).color is None


def test_render_and_the_page_show_colours(run, tmp_path):
    directory, _ = run
    for shading in ("color", "lambert"):
        out = tmp_path / f"{shading}.png"
        assert main(f"render {directory} -o {out} --size 24 --samples 1 --fast --shading {shading}".split()) == 0
        image = iio.imread(out).astype(float)
        assert np.ptp(image, axis=2).max() > 20  # not grey
    assert pack(directory).page.colored


def test_a_baked_mesh_has_the_colours_of_the_texture(run, tmp_path):
    pytest.importorskip("xatlas")
    directory, texture = run
    out = tmp_path / "baked.glb"
    assert main(f"mesh {directory} -o {out} --resolution 24 --texture 256 --texture-faces 600".split()) == 0
    cloud = sample_textured(read_textured(out), 2000, seed=0)
    expected = texture.colors(torch.from_numpy(cloud.points).float()).numpy()
    assert float(np.abs(cloud.colors - expected).mean()) < 0.01
    assert main(f"mesh {directory} -o {tmp_path}/baked.ply --texture 256".split()) == 2
    assert not (tmp_path / "baked.ply").exists()
