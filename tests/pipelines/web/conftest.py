"""One browser, and one page of a field with colours, for all tests of pages; skipped where there is no Chromium."""

import pytest
from browser import start_browser
from mplicits.neural_fields import Similarity, save_field
from mplicits.neural_fields.checkpoint import save_texture
from mplicits.pipelines.cli import main
from pages import TITLE, bumpy, open_page, painted

OPENED = {"WebGL 2": "?pixel=16&webgl", "WebGPU": "?pixel=16"}


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


@pytest.fixture(scope="module")
def kind(request):
    """Either of the two that trace: "WebGL 2", or "WebGPU" where a test says so."""
    return getattr(request, "param", "WebGL 2")


@pytest.fixture
def opened(browser, page, kind):
    """The page, which is loaded again only for another kind."""
    browser.get_log("browser")  # messages of pages before this one
    if browser.current_url != page.as_uri() + OPENED[kind]:
        open_page(browser, page.as_uri(), kind=kind)
    return browser
