"""Words in pictures, with and without OpenCV 5's font."""

import cv2
import numpy as np
import pytest
from mplicits.pipelines.render.legend import plain, text_mask, text_width

WORDS = "|f₁| < δ₁ = 0.5"


@pytest.fixture(params=["as installed", "without fonts"])
def any_opencv(request, monkeypatch) -> None:
    if request.param == "without fonts":
        monkeypatch.delattr(cv2, "FontFace", raising=False)


@pytest.mark.usefixtures("any_opencv")
@pytest.mark.parametrize("size", [9, 20, 64])
def test_words_are_where_their_place_and_width_say(size: int):
    left, width = 2 * size, text_width(WORDS, size)
    mask = text_mask((4 * size, width + 4 * size), WORDS, (left, 2 * size), size)
    assert mask.max() > 0.5
    assert mask.max() <= 1
    rows, columns = np.nonzero(mask > 0.1)
    # Within a quarter of the size: what letters keep free beside them, and how far a bar or a tail goes below the line.
    assert abs(columns.min() - left) <= size / 4 + 1
    assert abs(columns.max() - (left + width)) <= size / 4 + 1
    assert 2 * size - rows.min() <= 3 * size / 4
    assert rows.max() - 2 * size <= 3 * size / 4


def test_letters_that_strokes_do_not_have_get_names():
    assert plain("δ₁ = −2.5 mm⁻¹, 90°") == "delta1 = -2.5 mm-1, 90 deg"
    assert plain("f₀ = 0") == "f0 = 0"
    assert plain("面 1") == " 1"
