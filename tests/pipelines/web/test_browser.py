"""The page in a real browser, from a file, with WebGL and WebGPU in software; skipped where there is no Chromium.

What it traces is compared with the tracer of this package, both to the same precision, from the same cameras.
"""

from contextlib import contextmanager

import numpy as np
import pages
import pytest
import torch
from mplicits.datasets.cameras import look_at, turntable
from mplicits.neural_fields import MultiscaleSDF, Siren, extract_mesh, map_colors, save_field
from mplicits.pipelines.web.export import BITS, WebOptions, web_run
from mplicits.pipelines.web.payload import rounded_field
from pages import TITLE, bumpy, differences, open_page, painted, round_field, until

pytest.importorskip("selenium")

from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

SIZE = (96, 72)
# Depths of both tracers are known to this, in units of the field.
PRECISION = 1e-4


def complaints(browser):
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def message(browser):
    """What the page says instead of a picture, or nothing."""
    return browser.find_element(By.ID, "reason").text if browser.find_element(By.ID, "message").is_displayed() else ""


def pictures(browser):
    """How many the page has drawn."""
    return int(browser.execute_script("return document.documentElement.dataset.drawn"))


def rendered(browser, camera, **wanted):
    return pages.rendered(browser, camera, precision=PRECISION, **wanted)


def cameras():
    width, height = SIZE
    outline = extract_mesh(bumpy(), resolution=48, normals=False).vertices
    around = turntable(outline, 1, azimuth=-60.0, elevation=35.0, width=width, height=height)[0]
    # Within the mesh around the band, with the surface on all sides of the picture.
    near = look_at((0.0, 0.2, 0.9), (0.1, 0.0, 0.0), fov=60.0, width=width, height=height)
    return {"around": (around, 2), "coarse": (around, 0), "near": (near, 1)}


KINDS = ("WebGL 2", "WebGPU")
# The software adapter takes its time to compile: WebGPU draws what the two might draw differently.
DRAWN = [*((KINDS[0], name) for name in ("around", "coarse", "near")), (KINDS[1], "around"), (KINDS[1], "near")]


@pytest.mark.parametrize(("kind", "name"), DRAWN, indirect=["kind"])
def test_the_page_traces_what_this_package_traces(opened, name):
    camera, level = cameras()[name]
    found, counts = rendered(opened, camera, level=level)
    assert_same(found, rounded_field(bumpy(), BITS), camera, level)
    # A finer level is evaluated in the band of the one before it alone, and no level that is not wanted.
    for evaluated in (counts["values"][:3], counts["jets"][:3]):
        assert evaluated == sorted(evaluated, reverse=True)
    assert counts["values"][level + 1 :] == [0] * (3 - level)  # the last are the colours
    assert (found[..., 3] > 0).sum() <= counts["jets"][0] <= 3 * (found[..., 3] > 0).sum()
    assert not complaints(opened)


def assert_same(found, field, camera, level):
    """That a picture of a page shows what the tracer of this package finds."""
    found = differences(found, field, camera, level, tolerance=PRECISION, resolution=PRECISION)
    assert found.hits > 500
    assert found.mask <= 5e-4
    assert (found.depth <= 1e-3).mean() >= 0.999
    assert (found.angle <= 2).mean() >= 0.99


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_a_residual_may_be_larger_than_its_band(browser, tmp_path, kind):
    """Twice as large: then level 0 alone does not say on which side of the surface a place is."""
    field = bumpy(gain=1.5)
    places = torch.from_numpy(np.random.default_rng(0).uniform(-0.8, 0.8, (4000, 3)).astype(np.float32))
    moved = (field.value(places, level=1) - field.value(places, level=0)).abs()
    assert float(moved.max()) > 2 * float(field.deltas[0])
    file, page = tmp_path / "large.safetensors", tmp_path / "large.html"
    save_field(file, field)
    web_run(file, page, WebOptions(levels=2, float32=True))
    open_page(browser, page.as_uri(), kind=kind)
    camera, level = cameras()["near"]
    assert_same(rendered(browser, camera, level=level)[0], field, camera, level)


def test_normals_of_the_finest_level_on_the_coarsest(opened):
    camera, _ = cameras()["around"]
    coarse, _ = rendered(opened, camera, level=0)
    mapped, counts = rendered(opened, camera, level=0, normalLevel=2)
    assert ((coarse[..., 3] > 0) == (mapped[..., 3] > 0)).all()
    assert counts["values"][1:] == [0, 0, 0]
    assert counts["jets"][2] > 0
    seen = coarse[..., 3] > 0
    assert np.abs(coarse - mapped)[seen][:, :3].max() > 0.05


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_colours_are_those_of_the_texture(opened):
    """In its band, and on a coarse surface outside of it, from where points are moved to the one that was coloured."""
    camera, _ = cameras()["around"]
    found, counts = rendered(opened, camera, level=0, colored=True)
    seen = found[..., 3] > 0
    eye, directions = camera.rays()
    points = eye + torch.from_numpy(np.array(found[..., 3:])) * directions
    away = bumpy().value(points[seen]).abs() > 0.02
    assert 0 < int(away.sum()) < len(away)
    expected = map_colors(painted(), points[seen]).values.numpy()
    # Rounded weights, and depths in float32, change smooth colours by far less than a step of a display.
    close = np.abs(counts["color"].reshape(*seen.shape, 4)[seen][:, :3] - expected).max(axis=1) < 1 / 255
    assert close.mean() > 0.99
    assert np.ptp(expected, axis=0).max() > 0.1
    assert len(rendered(opened, camera, level=0)[1]["color"]) == 0


def test_a_single_ray_finds_what_the_picture_shows(opened):
    camera, level = cameras()["around"]
    found, _ = rendered(opened, camera, level=level)
    row, column = np.argwhere(found[..., 3] > 0)[len(found) // 2].tolist()
    pick = "return window.mplicits.renderer.pick(arguments[0], arguments[1])"
    picked = opened.execute_script(pick, column, row)
    assert np.allclose([*picked["normal"], picked["depth"]], found[row, column], atol=1e-4)
    script = "return window.mplicits.renderer.values(Float32Array.from(arguments[0]), 2).then((f) => Array.from(f))"
    (value,) = opened.execute_script(script, picked["position"])
    assert abs(value) <= 2 * PRECISION
    assert opened.execute_script(pick, -50, -50) is None


def test_the_bench_counts_what_networks_are_asked(opened):
    found = opened.execute_script("return window.mplicits.bench({size: 24, frames: 2, level: 1})")
    base, fine, none, colors = found["evaluations"]
    assert base > fine > 0
    assert none == colors == 0
    # Each evaluation of (32, 2) is 32·3 + 32·32 + 32 products; a jet is two.
    once = 2 * (base * (32 * 3 + 32 * 32 + 32) + fine * (18 * 3 + 18 * 18 + 18)) * 24**2
    assert once < found["operations"] < 2 * once
    assert min(found["fps"], found["read"]) > 0


def test_what_a_person_sees_and_does(opened):
    assert message(opened) == ""
    assert opened.title == opened.find_element(By.ID, "title").text == TITLE
    assert not opened.find_elements(By.TAG_NAME, "img")
    facts = opened.find_element(By.ID, "facts").text
    for words in ("SIRENs 32 × 2, 18 × 2, 16 × 3", "δ = 12, 5 input units", f"weights of {BITS} bits: off by ≤ "):
        assert words in facts
    canvas = opened.find_element(By.ID, "picture")
    level = opened.find_element(By.ID, "level")
    assert level.get_attribute("value") == "2"
    assert opened.find_element(By.ID, "shading").get_attribute("value") == "3"  # colours, as there are some
    canvas.send_keys("0")
    assert level.get_attribute("value") == "0"
    drawn = pictures(opened)
    before = opened.get_screenshot_as_png()
    canvas.send_keys(Keys.ARROW_LEFT, "+")
    until(lambda: pictures(opened) > drawn)
    assert opened.get_screenshot_as_png() != before
    drawn = pictures(opened)
    opened.find_element(By.TAG_NAME, "summary").click()
    opened.find_element(By.ID, "theme").click()
    until(lambda: pictures(opened) > drawn)
    assert not complaints(opened)


def test_at_rest_the_picture_is_refined(browser, page):
    browser.get(f"{page.as_uri()}?pixel=4&camera=10,80&webgl")
    until(lambda: browser.execute_script("return document.documentElement.dataset.finished"))
    width, height = browser.execute_script("return [innerWidth, innerHeight]")
    assert browser.find_element(By.ID, "state").text == f"{round(width / 4)} × {round(height / 4)} rays"


def test_a_lost_context_is_told_and_comes_back(opened):
    script = "const gl = document.getElementById('picture').getContext('webgl2'); "
    opened.execute_script(f"{script} window.loss = gl.getExtension('WEBGL_lose_context'); window.loss.loseContext();")
    assert "taken away" in until(lambda: message(opened))
    opened.execute_script("window.loss.restoreContext();")
    until(lambda: message(opened) == "")
    camera, level = cameras()["around"]
    found, _ = rendered(opened, camera, level=level)
    assert (found[..., 3] > 0).sum() > 500


@pytest.mark.parametrize("kind", ["WebGPU"], indirect=True)
def test_a_lost_device_is_replaced(opened):
    camera, _ = cameras()["around"]
    before, _ = rendered(opened, camera, level=0)
    opened.execute_script("window.mplicits.renderer.tracer.device.destroy()")
    after, _ = rendered(opened, camera, level=0)
    assert (before[..., 3] > 0).sum() > 500
    assert (before == after).all()
    assert message(opened) == ""


def test_a_tab_in_the_background_goes_on_where_it_was(opened):
    """What changes meanwhile is drawn when it comes back."""
    here = opened.current_window_handle
    change = """const level = arguments[0];
    document.addEventListener('visibilitychange', () => {
    window.hid = document.hidden;
    level.value = 0;
    level.dispatchEvent(new Event('input'));
    window.before = Number(document.documentElement.dataset.drawn); }, {once: true})"""
    opened.execute_script(change, opened.find_element(By.ID, "level"))
    opened.switch_to.new_window("tab")
    opened.close()
    opened.switch_to.window(here)
    assert opened.execute_script("return window.hid") is True
    until(lambda: pictures(opened) > opened.execute_script("return window.before"))
    assert opened.find_element(By.ID, "levelName").text == "0"
    assert message(opened) == ""
    assert not complaints(opened)


@contextmanager
def before_pages(browser, script):
    """A script that runs before those of every page."""
    number = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})
    try:
        yield
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", number)


@pytest.mark.parametrize("widest", [30, 12])
def test_levels_too_wide_for_the_adapter_are_left_out(browser, tmp_path, widest):
    """Level 0 is 16 wide and level 1 is 40."""
    base = round_field(0.5).base
    save_field(tmp_path / "wide.safetensors", MultiscaleSDF(base, [Siren(40, 1, omega=5.0, output_gain=0.05)], [0.2]))
    web_run(tmp_path / "wide.safetensors", tmp_path / "wide.html")
    narrow = f"""const told = WebGL2RenderingContext.prototype.getParameter;
    WebGL2RenderingContext.prototype.getParameter = function (name) {{
    return name === this.MAX_TEXTURE_SIZE ? {widest} : told.call(this, name); }}"""
    with before_pages(browser, narrow):
        if widest < 16:
            browser.get(f"{(tmp_path / 'wide.html').as_uri()}?webgl")
            assert "Level 0 has 16 neurons" in failure(browser)
            return
        open_page(browser, (tmp_path / "wide.html").as_uri())
    assert browser.find_element(By.ID, "facts").text.startswith("Level 1 has 40 neurons in a layer")
    assert not browser.find_element(By.ID, "levels").is_displayed()  # there is one alone
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=30.0, width=32, height=32)
    found, _ = rendered(browser, camera)
    seen = differences(found, base, camera, 0, tolerance=PRECISION, resolution=PRECISION)
    assert seen.hits > 100
    assert seen.mask <= 2 / found[..., 0].size


def failure(browser):
    """What the page says once its script has run."""
    return until(lambda: "has not run" not in message(browser) and message(browser))


DAMAGES = {
    "cut": (lambda text: text[: text.index('id="data">') + 4000], "damaged or cut off"),
    "header": (lambda text: text[: text.index('"deltas"')], "not complete"),
    "flipped": (lambda text: text.replace('id="data">', 'id="data">AAAA'), "damaged or cut off"),
    "foreign": (lambda text: text.replace('"mplicits-web"', '"something"'), "no field of mplicits"),
    "newer": (lambda text: text.replace('"version":2', '"version":7'), "version 7"),
    "no base64": (lambda text: text.replace('id="data">', 'id="data">!'), "damaged"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_told(browser, page, tmp_path, name):
    damage, expected = DAMAGES[name]
    broken = tmp_path / "broken.html"
    broken.write_text(damage(page.read_text(encoding="utf-8")), encoding="utf-8")
    browser.get(broken.as_uri())
    assert expected in failure(browser)


def test_a_browser_without_webgl_is_told(browser, page):
    with before_pages(browser, "HTMLCanvasElement.prototype.getContext = () => null"):
        browser.get(page.as_uri())
        assert "no WebGL 2" in until(lambda: message(browser))
