"""Colours and normals of surface points, to be baked and found again; the browser that shows them."""

import numpy as np
import pytest
from browser import start_browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    driver = start_browser(tmp_path_factory.mktemp("chromium"))
    if driver is None:
        pytest.skip("no chromium and chromedriver on this machine")
    driver.set_window_size(800, 800)
    yield driver
    driver.quit()


@pytest.fixture(scope="session")
def painting():
    """Colours that change smoothly with position; no two channels alike, and dark ones among them."""
    return lambda points: 0.5 + 0.45 * np.sin(points * (3, 4, 5) + (0, 1, 2))


@pytest.fixture(scope="session")
def bumpy():
    """Normals of the sphere, tilted by up to a third."""

    def normals(points):
        tilted = points / np.linalg.norm(points, axis=1, keepdims=True) + 0.3 * np.sin(5 * points[:, [1, 2, 0]])
        return tilted / np.linalg.norm(tilted, axis=1, keepdims=True)

    return normals
