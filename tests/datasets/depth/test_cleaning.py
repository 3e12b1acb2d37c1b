"""The bilateral filter that stands in where OpenCV has been built without its contributed modules."""

import cv2
import numpy as np
import pytest
from mplicits.datasets.depth.cleaning import joint_bilateral, smooth_depth


def table_bound(guide: np.ndarray, image: np.ndarray, size: int) -> float:
    """OpenCV's error at most: h²/8 in each weight, by interpolating exp(-t²/2) in a table of 4096 entries a channel."""
    step = float(np.ptp(guide, axis=(0, 1)).sum()) / (4096 * guide.shape[2])
    weight = step**2 / 8 + 16 * float(np.finfo(np.float32).eps)
    # A mean changes by less than twice the changes of its weights, which sum to 1 or more, times the largest value.
    return 2 * size**2 * weight * float(np.abs(image).max())


@pytest.mark.skipif(not hasattr(cv2, "ximgproc"), reason="this build of OpenCV has no contributed modules")
@pytest.mark.parametrize("size", [3, 7, 11])
def test_it_is_opencvs_filter(size: int) -> None:
    rng = np.random.default_rng(size)
    guide = (2 * rng.normal(size=(40, 50, 3))).astype(np.float32)
    image = rng.normal(size=(40, 50)).astype(np.float32)
    theirs = cv2.ximgproc.jointBilateralFilter(guide, image, size, 1.0, size / 3)
    assert np.abs(joint_bilateral(guide, image, size, 1.0, size / 3) - theirs).max() <= table_bound(guide, image, size)


def test_the_weights_are_those_of_the_formula() -> None:
    rng = np.random.default_rng(0)
    guide = rng.normal(size=(9, 9, 2)).astype(np.float32)
    image = rng.normal(size=(9, 9)).astype(np.float32)
    found = joint_bilateral(guide, image, 5, 0.7, 1.3)
    y, x = np.mgrid[:9, :9]
    for row, column in ((4, 4), (2, 6)):  # whose discs lie within the image
        away = (y - row) ** 2 + (x - column) ** 2
        apart = np.abs(guide.astype(np.float64) - guide[row, column]).sum(axis=2)
        weight = np.exp(-(apart**2) / (2 * 0.7**2) - away / (2 * 1.3**2)) * (away <= 4)
        assert found[row, column] == pytest.approx((weight * image).sum() / weight.sum(), rel=1e-5, abs=1e-6)


def test_depth_is_smoothed_without_the_contributed_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "ximgproc", raising=False)
    rng = np.random.default_rng(0)
    depth = 2 + 0.01 * rng.normal(size=(30, 40))
    depth[3, 5] = np.nan
    smooth = smooth_depth(depth, 3, noise=0.01)
    assert np.isnan(smooth[3, 5])
    assert np.nanstd(smooth) < 0.4 * np.nanstd(depth)
