"""Colours by direction on a page: what the networks of this package say of its own rays."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from mplicits.datasets.cameras import turntable
from mplicits.neural_fields import MultiscaleSDF, TextureField, ViewColor, extract_mesh, save_field
from mplicits.neural_fields.checkpoint import save_radiance, save_texture
from mplicits.neural_fields.networks.radiance import Radiance
from mplicits.neural_fields.networks.texture import ColorSiren
from mplicits.pipelines.texture.highlights import fit_highlights
from mplicits.pipelines.web import export
from mplicits.pipelines.web.export import WebOptions, pack_run, web_run
from pages import bumpy, rendered, until

KINDS = ("WebGL 2", "WebGPU")
STEPS = 60


def gaudy() -> ViewColor:
    """Untrained colours, far from grey, that change with the direction of view."""
    torch.manual_seed(5)
    color = ViewColor(0, width=16, depth=2)
    with torch.no_grad():
        color.layers[-1].weight.mul_(30.0)
    return color.requires_grad_(False)


def painted() -> TextureField:
    torch.manual_seed(4)
    return TextureField(bumpy(), ColorSiren(16, 2, omega=8.0), delta=0.1).requires_grad_(False)


def write_run(folder, geometry: MultiscaleSDF, eyes=None):
    save_field(folder / "field.safetensors", geometry)
    save_texture(folder / "texture.safetensors", painted())
    radiance = Radiance(gaudy(), None, torch.ones(3), inv_std=300.0)
    metadata = {} if eyes is None else {"eyes": eyes}
    save_radiance(folder / "radiance.safetensors", radiance, geometry, metadata=metadata)
    return folder


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    """A page, and what was learnt for it."""
    folder, said = write_run(tmp_path_factory.mktemp("glossy"), bumpy()), list[str]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "fit_highlights", partial(fit_highlights, steps=STEPS))
        done = web_run(folder, folder / "page.html", WebOptions(float32=True), say=said.append)
    assert done.highlights is not None
    assert done.highlights.worth_it
    assert any(line.startswith("colours by direction: off by 0.") for line in said)
    return folder / "page.html", done.highlights.network


@pytest.mark.parametrize("kind", KINDS)
def test_colours_are_texture_and_what_the_direction_adds(browser, glossy, kind):
    page, network = glossy
    browser.get_log("browser")  # what pages before this one said is not its own
    browser.get(f"{page.as_uri()}?pixel=16{'&webgl' if kind == 'WebGL 2' else ''}")
    until(lambda: browser.execute_script("return window.mplicits?.renderer?.kind"))
    assert browser.execute_script("return window.mplicits.renderer.kind") == kind
    assert browser.execute_script("return document.getElementById('shading').value") == "5"  # as photographed
    field, texture = bumpy(), painted()
    outline = extract_mesh(field, resolution=48, normals=False).vertices
    for turn in (-60.0, 120.0):
        camera = turntable(outline, 1, azimuth=turn, elevation=35.0, width=64, height=48)[0]
        found, counts = rendered(browser, camera, precision=1e-4, directed=True)
        _, asked = rendered(browser, camera, precision=1e-4, colored=True)
        seen = found[..., 3] > 0
        assert seen.sum() > 300
        eye, directions = camera.rays()
        way = directions[torch.from_numpy(seen)]
        points = eye + torch.from_numpy(found[seen][:, 3:].copy()) * way
        base = texture.colors(points)
        expected = texture.network.value(points) + network.value(torch.cat((points, way), dim=1))
        colors = [told["color"].reshape(*seen.shape, 4)[seen][:, :3] for told in (counts, asked)]
        assert (np.abs(colors[0] - expected.clamp(0, 1).numpy()).max(axis=1) < 1 / 255).mean() > 0.99
        assert (np.abs(colors[1] - base.numpy()).max(axis=1) < 1 / 255).mean() > 0.99
        assert np.abs(colors[0] - colors[1]).max() > 0.2
        # One evaluation more for each ray that hits, and none of the bare colours.
        assert counts["values"][-1] == seen.sum()
        assert asked["values"][-1] == 0
    assert not [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_shadings_of_a_page_with_colours_by_direction(browser, glossy):
    """The list has all of them; colours in light ask the second network for nothing."""
    browser.get(f"{glossy[0].as_uri()}?pixel=16&webgl")
    until(lambda: browser.execute_script("return document.documentElement.dataset.finished"))
    names = browser.execute_script("return [...document.getElementById('shading').options].map((o) => o.text)")
    assert names[:3] == ["as photographed", "colours", "bare colours"]
    select = "const s = document.getElementById('shading'); s.value = 3; s.dispatchEvent(new Event('change'))"
    counts = "return window.mplicits.renderer.counts().values"
    assert browser.execute_script(counts)[-1] > 0
    drawn = "return Number(document.documentElement.dataset.drawn)"
    before = browser.execute_script(drawn)
    browser.execute_script(select)
    until(lambda: browser.execute_script(drawn) > before and browser.execute_script(counts)[-2] > 0)
    assert browser.execute_script(counts)[-1] == 0


@pytest.mark.slow
def test_what_a_page_says_and_leaves_out(tmp_path, monkeypatch):
    """Highlights are learnt once, from where cameras stood; and never where nobody wants them."""
    asked = []

    def learn(color, texture, mesh, eyes, *, progress):
        asked.append(eyes)
        return fit_highlights(color, texture, mesh, eyes, steps=2, progress=progress)

    monkeypatch.setattr(export, "fit_highlights", learn)
    folder = write_run(tmp_path, bumpy(), eyes=[[0.0, 0.0, 3.0], [2.0, 0.0, 0.0]])
    packed = pack_run(folder)
    assert np.array_equal(asked.pop(), [[0.0, 0.0, 3.0], [2.0, 0.0, 0.0]])
    # Two steps teach nothing: then there is no such network on the page.
    assert packed.page.highlights is not None
    assert (packed.header["highlights"] is not None) == packed.page.highlights.worth_it
    for options in (WebOptions(highlights=False), WebOptions(colors=False)):
        header = pack_run(folder, options).header
        assert header["highlights"] is None
        assert "highlights" not in json.dumps(header["blocks"])
    with pytest.raises(export.InputError, match="--levels"):
        pack_run(folder, WebOptions(levels=9))
    assert not asked  # what cannot be shown is refused before anything is learnt
    (folder / "radiance.safetensors").unlink()
    assert pack_run(folder).header["highlights"] is None
    assert not asked


def test_damaged_eyes_are_named(tmp_path):
    folder = write_run(tmp_path, bumpy(), eyes=[[0.0, "above", 1.0]])
    with pytest.raises(export.InputError, match=r"radiance\.safetensors"):
        pack_run(folder)
