"""What a person does with the page: reading places, measuring, slicing, saving. Compared with the field in float32."""

import base64
import re

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from mplicits.pipelines.web.export import BITS
from mplicits.pipelines.web.payload import rounded_field
from pages import bumpy, open_page, until

pytest.importorskip("selenium")

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select

CENTER, UNIT = np.array([5.0, 6.0, 7.0]), 100.0  # of the run that `page` shows
NUMBER = r"-?\d+\.?\d*(?:e[-+]\d+)?"


@pytest.fixture
def resting(browser, page):
    """A page of its own, seen along −x, at rest; higher than others, so that the panel leaves room for the shape."""
    before = browser.get_window_size()
    browser.set_window_size(500, 500)
    open_page(browser, page.as_uri(), "camera=90,0")
    rest(browser)
    yield browser
    browser.set_window_size(before["width"], before["height"])


def tool(browser, name):
    """A control of the panel of tools, which is opened."""
    if not browser.find_element(By.TAG_NAME, "details").get_attribute("open"):
        browser.find_element(By.TAG_NAME, "summary").click()
    return browser.find_element(By.ID, name)


def away(browser):
    """The panel of tools is closed: in so small a window it covers the picture."""
    if browser.find_element(By.TAG_NAME, "details").get_attribute("open"):
        browser.find_element(By.TAG_NAME, "summary").click()


def rest(browser):
    ended = "const {drawn, finished} = document.documentElement.dataset; return finished && finished === drawn"
    until(lambda: browser.execute_script(ended))


def shown(browser, name):
    found = browser.find_element(By.ID, name)
    return found.text if found.is_displayed() else ""


def at(browser, x, y, *, click=False):
    """Move the pointer to a place of the picture, from the middle of what the panel leaves free."""
    picture = browser.find_element(By.ID, "picture")
    y -= (browser.find_element(By.ID, "panel").rect["height"] + 24) // 2
    # To elsewhere first: a pointer that does not move tells the page nothing.
    actions = ActionChains(browser, duration=0).move_to_element_with_offset(picture, x - 3, y)
    actions.move_to_element_with_offset(picture, x, y)
    (actions.click() if click else actions).perform()


def reading(browser):
    """Position, normal if there is one, and the distances of the levels, in the input's units."""
    text = until(lambda: shown(browser, "reading"))
    lines = {line.split()[0]: re.findall(rf"(?<![f\d]){NUMBER}", line.split(": ")[-1]) for line in text.splitlines()}
    place, normal = (np.array(lines[name], float) if name in lines else None for name in ("on", "normal"))
    return text, place, normal, np.array(re.findall(rf"= ({NUMBER})", text), float)


def values_at(place):
    """Of all levels at a place of the input, in its units; the place is read to five digits of the radius."""
    x = torch.from_numpy((place - CENTER) / UNIT).float()[None]
    field = rounded_field(bumpy(), BITS)
    return x, [field.value(x, level=level).item() * UNIT for level in range(3)]


def test_the_place_under_the_pointer(resting):
    assert shown(resting, "reading") == ""
    at(resting, 10, -20)
    text, place, normal, distances = reading(resting)
    assert text.startswith("on the surface: ")
    x, expected = values_at(place)
    # The ray is known to a tenth of a pixel of the coarse picture: 16 of its 300 pixels see about 2 units.
    assert abs(distances[2]) < 0.02 * UNIT
    assert np.allclose(distances, expected, atol=0.01 + 1e-2 * np.abs(expected).max())
    gradient = torch.nn.functional.normalize(rounded_field(bumpy(), BITS).jet(x).gradient, dim=-1)[0].numpy()
    assert normal @ gradient > 0.999
    assert place[0] > CENTER[0]  # the camera is at +x
    at(resting, 200, 0)
    until(lambda: shown(resting, "reading") == "")  # beside the shape


def test_a_ruler_between_two_places(resting):
    tool(resting, "ruler").click()
    away(resting)
    assert "click on one end" in shown(resting, "length")
    ends = []
    for x, y in ((-25, -30), (20, 15)):
        before = shown(resting, "length")
        at(resting, x, y, click=True)
        until(lambda before=before: shown(resting, "length") != before)
        ends.append(reading(resting)[1])
    length = float(shown(resting, "length").split()[0])
    assert length == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=1e-3)
    marks = """const m = document.getElementById('marks');
    return m.getContext('2d').getImageData(0, 0, m.width, m.height).data.some((v) => v > 0)"""
    assert resting.execute_script(marks)
    tool(resting, "ruler").click()
    assert shown(resting, "length") == ""
    assert not resting.execute_script(marks)


def test_a_slice_shows_distances_and_cuts_what_is_before_it(resting):
    Select(tool(resting, "axis")).select_by_visible_text("x")
    place = float(until(lambda: shown(resting, "placeName")))
    away(resting)
    rest(resting)
    at(resting, 12, -35)
    text, position, normal, distances = reading(resting)
    assert text.startswith("on the plane: ")
    assert normal is None
    assert position[0] == pytest.approx(place, abs=0.01 * UNIT)
    _, expected = values_at(position)
    assert distances[2] < 0
    assert np.allclose(distances, expected, rtol=0.01, atol=0.01)
    # Inside is orange, outside blue: the middle of the picture against the rim of the shape.
    picture = imageio.imread(base64.b64decode(resting.get_screenshot_as_base64()))[..., :3].astype(int)
    canvas = resting.find_element(By.ID, "picture").rect
    free = canvas["height"] - resting.find_element(By.ID, "panel").rect["height"] - 24
    row, column = round(free / 2 - 35), round(canvas["width"] / 2 + 12)
    red, _, blue = np.median(picture[row - 3 : row + 4, column - 3 : column + 4].reshape(-1, 3), axis=0)
    assert red > blue
    Select(tool(resting, "axis")).select_by_visible_text("none")
    away(resting)
    rest(resting)
    at(resting, 12, -35)
    until(lambda: "on the surface" in shown(resting, "reading"))


def test_pictures_and_films_are_saved(resting, tmp_path):
    resting.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    tool(resting, "savePicture").click()
    file = tmp_path / "img_src_x_onerror_alert_1_ball.png"  # nothing of a title is a path
    until(lambda: file.exists() and file.stat().st_size)
    picture = imageio.imread(file)
    size = resting.execute_script("const p = document.getElementById('picture'); return [p.height, p.width]")
    assert list(picture.shape[:2]) == size
    assert picture[..., :3].std() > 10

    film = """const done = arguments[0];
    window.mplicits.turntable({frames: 4, side: 24, rate: 48}).then(async ({blob, ending}) => {
    const bytes = new Uint8Array(await blob.arrayBuffer());
    done([ending, Array.from(bytes)]);
    }, (error) => done([String(error), []]));"""
    ending, data = resting.execute_async_script(film)
    assert ending == "webm"
    (tmp_path / "film.webm").write_bytes(bytes(data))
    _, first = cv2.VideoCapture(str(tmp_path / "film.webm")).read()
    assert min(first.shape[:2]) == 24
    assert first.std() > 10


def test_paper_is_as_bright_as_the_system_and_can_be_changed(browser, page):
    open_page(browser, page.as_uri())
    for theme in ("light", "dark"):
        wish = {"features": [{"name": "prefers-color-scheme", "value": theme}]}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", wish)
        stage = browser.find_element(By.ID, "stage")
        until(lambda theme=theme, stage=stage: stage.get_attribute("data-theme") == theme)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
