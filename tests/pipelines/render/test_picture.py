"""Pictures as files and on sheets: what stands where, and what is refused."""

import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.render.picture import check_picture_path, contact_sheet, in_rows, write_picture


def test_a_sheet_holds_every_picture_under_its_label():
    red, blue = np.full((50, 40, 3), (255, 0, 0), np.uint8), np.full((50, 70, 3), (0, 0, 255), np.uint8)
    sheet = contact_sheet([("red", red), ("a very long label that would not fit", blue)], gap=10, strip=30)
    assert sheet.shape == (80, 40 + 70 + 20, 3)
    np.testing.assert_array_equal(sheet[30:, 5:45], red)
    np.testing.assert_array_equal(sheet[30:, 55:125], blue)
    assert (sheet[:30] < 128).any()
    assert (sheet[:30, 125:] == 255).all()
    with pytest.raises(ValueError, match=r"heights \[50, 60\]"):
        contact_sheet([("a", red), ("b", np.zeros((60, 40, 3), np.uint8))])


def test_a_sheet_of_rows_is_filled_up_with_white():
    pictures = [(f"picture {shade}", np.full((20, 30, 3), shade, np.uint8)) for shade in (10, 20, 30, 40, 50)]
    sheet = contact_sheet(*in_rows(pictures, 3), gap=4, strip=30)
    assert sheet.shape == (100, 3 * 34, 3)
    for index, (_, picture) in enumerate(pictures):
        top, left = 50 * (index // 3) + 30, 34 * (index % 3) + 2
        np.testing.assert_array_equal(sheet[top : top + 20, left : left + 30], picture)
    assert (sheet[50:, 68:] == 255).all()
    wide = np.zeros((10, 200, 3), np.uint8)
    assert contact_sheet([pictures[0]], [("wide", wide)], gap=4, strip=30).shape == (90, 204, 3)


@pytest.mark.parametrize("channels", [3, 4])
def test_pictures_are_written_whole_or_not_at_all(channels, tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (8, 9, channels)).astype(np.uint8)
    write_picture(tmp_path / "picture.png", image)
    np.testing.assert_array_equal(iio.imread(tmp_path / "picture.png"), image)
    assert len(list(tmp_path.iterdir())) == 1
    with pytest.raises(InputError, match=r"picture\.bmp"):
        write_picture(tmp_path / "picture.bmp", image)
    with pytest.raises(InputError, match=r"picture\.png is no folder"):
        write_picture(tmp_path / "picture.png" / "picture.png", image)


def test_transparency_and_jpeg_do_not_go_together(tmp_path):
    with pytest.raises(InputError, match=r"picture\.jpg: JPEG"):
        write_picture(tmp_path / "picture.jpg", np.zeros((4, 4, 4), np.uint8))
    assert not list(tmp_path.iterdir())
    check_picture_path(tmp_path / "picture.jpg")
