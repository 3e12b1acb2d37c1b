"""Smoothing of depth maps names what it lacks."""

import cv2
import numpy as np
import pytest
from mplicits.datasets.depth.cleaning import smooth_depth
from mplicits.neural_fields import InputError


def test_another_build_of_opencv_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "ximgproc", raising=False)
    with pytest.raises(InputError, match="without its contributed modules"):
        smooth_depth(np.full((30, 40), 2.0), 3, noise=0.01)
