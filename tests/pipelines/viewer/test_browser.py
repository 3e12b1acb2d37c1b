"""The viewer in a real browser, headless; skipped where there is no Chromium."""

import io
import re
import time

import imageio.v3 as iio
import numpy as np
import pytest
from browser import CHROMEDRIVER, CHROMIUM, FLAGS
from mplicits.neural_fields import MultiscaleSDF, Similarity, Siren, Sphere
from mplicits.pipelines.viewer.server import Viewer, show_field

pytest.importorskip("viser")
pytest.importorskip("selenium")

from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

WINDOW = ("--window-size=1000,700",)
PATIENCE = 30.0
CENTER = (50.0, 60.0, 70.0)


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    cloud = tmp_path_factory.mktemp("viewer") / "cloud.xyz"
    points = np.random.default_rng(0).normal(size=(3000, 3))
    np.savetxt(cloud, CENTER + 5 * points / np.linalg.norm(points, axis=1, keepdims=True))
    field = MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=8.0)], [0.1], taper=0.3).requires_grad_(False)
    similarity = Similarity(CENTER, 10.0)
    with Viewer(show_field(field, name="ball", similarity=similarity, cloud=cloud, side=192)) as running:
        yield running


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None or CHROMEDRIVER is None:
        pytest.skip("no chromium and chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    home = tmp_path_factory.mktemp("chromium")
    for flag in (*FLAGS, *WINDOW, f"--user-data-dir={home / 'profile'}"):
        options.add_argument(flag)
    allowed = {"profile.default_content_setting_values.automatic_downloads": 1}
    options.add_experimental_option("prefs", {"download.default_directory": str(home), **allowed})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMEDRIVER))
    driver.downloads = home
    yield driver
    driver.quit()


@pytest.fixture
def page(browser, viewer):
    browser.get(viewer.url)
    page = Page(browser)
    page.rest()
    yield page
    browser.get("about:blank")
    until(lambda: viewer.num_clients == 0)  # a browser that leaves is forgotten


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)
    return found


def complaints(browser):
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


class Page:
    """What a person sees of the viewer and does with it."""

    def __init__(self, browser):
        self.browser = browser
        until(lambda: browser.find_elements(By.TAG_NAME, "canvas"))
        self.canvas = browser.find_element(By.TAG_NAME, "canvas")

    def text(self):
        return self.browser.find_element(By.TAG_NAME, "body").text

    def rest(self):
        """Wait until the finest image is there and on the screen."""
        until(lambda: re.search(r"\d+ × \d+ in [\d.]+ s", self.text()))
        return self.settled()

    def settled(self):
        """The scene without the panel, once it does not change any more."""
        last = self.pixels()
        while True:
            time.sleep(0.4)
            now = self.pixels()
            if np.array_equal(now, last):
                return now
            last = now

    def pixels(self):
        image = iio.imread(io.BytesIO(self.browser.get_screenshot_as_png()))[..., :3]
        height, width = image.shape[:2]
        return image[height * 2 // 5 :, : width // 2].astype(int)  # below the notice of software rendering

    def control(self, label):
        found = self.browser.find_element(By.XPATH, f"//label[normalize-space()='{label}']")
        return self.browser.find_element(By.ID, found.get_attribute("for"))

    def choose(self, label, option):
        self.browser.execute_script("arguments[0].click()", self.control(label))
        listed = self.control(label).get_attribute("aria-controls")
        path = f"//*[@id='{listed}']//*[@role='option'][normalize-space()='{option}']"
        self.browser.execute_script(
            "arguments[0].click()", until(lambda: self.browser.find_elements(By.XPATH, path))[0]
        )

    def tick(self, label):
        self.browser.execute_script("arguments[0].click()", self.control(label))

    def press(self, label):
        path = f"//button[normalize-space()='{label}']"
        self.browser.execute_script("arguments[0].click()", self.browser.find_element(By.XPATH, path))

    def drag(self, x, y):
        hand = ActionChains(self.browser, duration=100).move_to_element_with_offset(self.canvas, -100, 100)
        hand.click_and_hold().move_by_offset(x, y).release().perform()

    def click(self, x, y):
        ActionChains(self.browser).move_to_element_with_offset(self.canvas, x, y).click().perform()

    def changes(self, before, share=0.01):
        """Wait until a share of the scene's pixels is different, and at rest again; how it looks then."""
        until(lambda: (np.abs(self.pixels() - before).max(axis=2) > 12).mean() > share)
        return self.settled()


def test_the_field_is_seen_and_follows_the_camera_and_the_controls(page, browser):
    first = page.settled()
    assert (first.min(axis=2) < 240).mean() > 0.05  # not blank
    assert (first.min(axis=2) > 250).mean() > 0.2  # nor covered
    page.choose("Shading", "normals")
    normals = page.changes(first)
    assert np.ptp(normals, axis=2).max() > 100  # colours, where clay is grey
    page.drag(120, 0)
    turned = page.changes(normals)
    page.choose("Level", "0")
    coarse = page.changes(turned)
    page.choose("Normals of", "1")
    page.changes(coarse)
    assert complaints(browser) == []


def test_a_click_reads_the_field(page, browser):
    assert "Click on the surface" in page.text()
    page.click(0, 0)
    until(lambda: "On the surface, level 1" in page.text())
    position = [float(number) for number in re.findall(r"position ([-\d., ]+)", page.text())[0].split(",")]
    assert np.linalg.norm(np.subtract(position, CENTER)) == pytest.approx(5, abs=1)
    page.click(-300, 150)
    until(lambda: "Nothing is under the pointer." in page.text())
    assert complaints(browser) == []


@pytest.mark.slow
def test_the_slice_slider_counts_in_input_units(page, browser):
    """The sphere is around (50, 60, 70) with a radius of 10 input units."""
    slider = browser.find_element(By.XPATH, "//*[@role='slider'][@aria-valuemax='60']")
    assert [slider.get_attribute(f"aria-value{name}") for name in ("min", "now")] == ["40", "50"]
    traced = page.settled()
    page.tick("Slice plane")
    page.changes(traced)
    page.choose("Slice across", "z")
    slider = until(lambda: browser.find_elements(By.XPATH, "//*[@role='slider'][@aria-valuemax='80']"))[0]
    assert [slider.get_attribute(f"aria-value{name}") for name in ("min", "now")] == ["60", "70"]
    page.choose("Show", "hidden")
    page.settled()
    for _ in range(3):
        slider.send_keys("\ue014")  # arrow right: three steps of 0.1
    until(lambda: slider.get_attribute("aria-valuenow") == "70.3")
    page.settled()
    page.click(0, 0)
    until(lambda: "On the slice plane" in page.text())
    position = [float(number) for number in re.findall(r"position ([-\d., ]+)", page.text())[0].split(",")]
    assert position[2] == pytest.approx(70.3, abs=1e-3)
    assert complaints(browser) == []


@pytest.mark.slow
def test_what_stands_beside_the_image_is_shown_and_taken_away(page, browser):
    traced = page.settled()
    page.tick("Slice plane")
    sliced = page.changes(traced)
    assert (sliced[..., 2] - sliced[..., 0] > 25).mean() > 0.1  # blue outside
    page.choose("Show", "hidden")
    page.changes(sliced)
    page.tick("Slice plane")
    until(lambda: (page.pixels().min(axis=2) > 250).mean() > 0.99)
    blank = page.settled()
    page.choose("Show", "mesh")
    meshed = page.changes(blank)
    page.choose("Show", "traced")
    traced = page.changes(meshed)
    page.choose("Band", "0")
    banded = page.changes(traced)
    page.choose("Band", "none")
    page.changes(banded)
    page.tick("Input cloud")
    page.changes(traced)
    assert complaints(browser) == []


@pytest.mark.slow
def test_pictures_are_saved_under_new_names(page, browser):
    page.tick("Transparent")
    page.press("Save picture")
    until(lambda: "Saved 1600 ×" in page.text())
    picture = until(lambda: list(browser.downloads.glob("ball-001.png")))[0]
    until(lambda: picture.stat().st_size > 0)
    image = iio.imread(picture)
    assert image.shape[1:] == (1600, 4)
    assert set(np.unique(image[..., 3])) == {0, 255}
    page.press("Save screenshot")
    shot = until(lambda: list(browser.downloads.glob("ball-002.png")))[0]
    assert iio.imread(shot).std() > 5


def test_another_field_is_shown_from_where_one_stands(browser):
    """As a fit that grows: first a ball alone, then a smaller one of three levels; the controls work on."""
    grown = MultiscaleSDF(Sphere(radius=0.3), [Siren(8, 1, omega=1.0) for _ in range(2)], [0.1, 0.05])
    with Viewer(show_field(Sphere(radius=0.6), side=96)) as watched:
        browser.get(watched.url)
        page = Page(browser)
        first = page.rest()
        watched.show(show_field(grown.requires_grad_(False), side=96))
        second = page.changes(first)
        assert ((first - second).max(axis=2) > 12).mean() < ((second - first).max(axis=2) > 12).mean()  # more is white
        page.rest()
        page.choose("Shading", "normals")
        page.changes(second, share=0.003)
        page.choose("Level", "2")
        assert watched.num_clients == 1
        assert complaints(browser) == []
        browser.get("about:blank")
        until(lambda: watched.num_clients == 0)
