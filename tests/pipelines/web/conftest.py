"""One browser, and one page of a field with colours, for all tests of pages; skipped where there is no Chromium."""

import pytest
from browser import start_browser
from mplicits.neural_fields import Similarity, save_field
from mplicits.neural_fields.checkpoint import save_texture
from mplicits.pipelines.cli import main
from pages import TITLE, bumpy, painted, until


@pytest.fixture(scope="session")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    save_field(folder / "ball.safetensors", bumpy(), similarity=Similarity((5.0, 6.0, 7.0), 100.0))
    save_texture(folder / "texture.safetensors", painted())
    out = folder / "ball.html"
    assert main(["web", str(folder / "ball.safetensors"), "-o", str(out), "--title", TITLE]) == 0
    return out


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    pytest.importorskip("selenium")
    driver = start_browser(tmp_path_factory.mktemp("chromium"))
    if driver is None:
        pytest.skip("no chromium and chromedriver on this machine")
    yield driver
    driver.quit()


@pytest.fixture
def opened(browser, page):
    """The page, with rays of 16 pixels at rest: software is slow."""
    browser.get_log("browser")  # what pages before this one said is not its own
    address = f"{page.as_uri()}?pixel=16&webgl"
    if browser.current_url != address:
        browser.get(address)
        until(lambda: browser.execute_script("return !!window.mplicits"))
    return browser


@pytest.fixture(scope="module")
def kind(request):
    return request.param


@pytest.fixture
def drawn(browser, page, kind):
    """The page, with either of the two that trace: "WebGL 2" or "WebGPU"."""
    browser.get_log("browser")  # what pages before this one said is not its own
    address = f"{page.as_uri()}?pixel=16{'&webgl' if kind == 'WebGL 2' else ''}"
    if browser.current_url != address:
        browser.get(address)
        until(lambda: browser.execute_script("return window.mplicits?.renderer?.kind"))
    assert browser.execute_script("return window.mplicits.renderer.kind") == kind
    return browser
