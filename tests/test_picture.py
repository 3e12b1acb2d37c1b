"""Pictures: what is drawn where, with which shade, checked against the projection worked out by hand."""

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from mplicits.neural_fields import InputError
from mplicits.pipelines.picture import BACK, CLAY, Camera, contact_sheet, look_at, picture_of, write_picture
from mplicits.pipelines.surface import Surface

NO_FACES = np.empty((0, 3), np.int64)


def sphere(radius: float = 1.0) -> Surface:
    mesh = trimesh.creation.icosphere(4, radius=radius)
    return Surface(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def drawn(image: np.ndarray) -> np.ndarray:
    return (image < 250).any(axis=2)


def test_a_sphere_is_a_disc_of_the_right_size_without_holes():
    camera = Camera(np.array([0.0, 0, 4]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), fov=60)
    seen = drawn(picture_of(sphere(), camera, size=(200, 200)))
    # The outline of a unit sphere from distance 4 is at slope 1 / √(4² − 1); the image's edge is at slope tan 30°.
    radius = 100 * (1 / np.sqrt(15)) / np.tan(np.radians(30))
    assert seen.sum() == pytest.approx(np.pi * radius**2, rel=0.02)
    rows, columns = np.mgrid[:200, :200] - 99.5
    assert seen[np.hypot(rows, columns) < radius - 1.5].all()
    assert not seen[np.hypot(rows, columns) > radius + 1.5].any()


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_look_at_fits_the_points_into_the_picture_and_touches_its_margin(up, aspect):
    points = np.random.default_rng(1).uniform(-1, 1, (500, 3)) * [3, 1, 2] + [100, -50, 7]
    camera = look_at(points, azimuth=40, elevation=-25, up=up, fov=40, aspect=aspect, margin=0.9)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert camera.axes[1, "xyz".index(up)] < 0  # down in the picture is down in the world
    x, y, z = ((points - camera.eye) @ camera.axes.T).T
    assert (z > 0).all()
    slope = np.tan(np.radians(20))
    filled = max(abs(x / z).max() / (slope * aspect), abs(y / z).max() / slope)
    assert filled == pytest.approx(0.9)


def test_azimuth_and_elevation_are_where_they_say():
    points = sphere().vertices
    np.testing.assert_allclose(look_at(points, azimuth=0, elevation=0).axes[2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(look_at(points, azimuth=90, elevation=0).axes[2], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(look_at(points, azimuth=0, elevation=0, up="z").axes[2], [0, 1, 0], atol=1e-12)
    assert look_at(points, elevation=60).eye[1] > 1
    with pytest.raises(ValueError, match="up='x'"):
        look_at(points, up="x")


def test_the_nearer_of_two_squares_hides_the_other():
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate((corners - [0, 0, 1], corners * 0.5 + [0, 0, 1]))
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int64)
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1]], 4, axis=0)
    camera = Camera(np.array([0.0, 0, 5]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), fov=40)
    for order in (faces, faces[::-1]):
        image = picture_of(Surface(vertices, order, colors=colors), camera, size=(100, 100)).astype(int)
        assert image[50, 50, 2] > image[50, 50, 0] + 100
        assert image[70, 70, 0] > image[70, 70, 2] + 100
        assert (image[2, 2] == 255).all()


def test_back_faces_show_as_such():
    ball = sphere()
    camera = look_at(ball.vertices)
    front = picture_of(ball, camera, size=(64, 64))[32, 32].astype(float)
    back = picture_of(Surface(ball.vertices, ball.faces[:, ::-1]), camera, size=(64, 64))[32, 32].astype(float)
    np.testing.assert_allclose(front / front[0], np.array(CLAY) / CLAY[0], atol=0.02)
    np.testing.assert_allclose(back / back[0], np.array(BACK) / BACK[0], atol=0.02)


def test_a_cloud_is_discs_of_the_size_asked_for():
    point = Surface(np.array([[0.0, 0, 0]]), NO_FACES, colors=np.array([[0.0, 0, 0]]))
    camera = Camera(np.array([0.0, 0, 4]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), fov=40)
    image = picture_of(point, camera, size=(65, 65), point_size=11)
    ink = (255 - image[..., 0].astype(float)).sum() / 255
    assert ink == pytest.approx(np.pi * 5.5**2, rel=0.1)
    assert not drawn(image)[:20].any()


def test_a_dense_cloud_looks_like_its_surface():
    ball = sphere()
    cloud = Surface(ball.vertices, NO_FACES, ball.vertices)
    camera = look_at(ball.vertices)
    mesh, points = (picture_of(shape, camera, size=(96, 96)).astype(float) for shape in (ball, cloud))
    both = drawn(mesh) & drawn(points)
    assert both.sum() > 0.95 * drawn(mesh).sum()
    assert np.median(abs(mesh - points)[both]) < 8


def test_a_cloud_without_normals_is_darker_where_it_is_further():
    points = np.array([[-1.0, 0, 1], [1.0, 0, -1]])
    camera = Camera(np.array([0.0, 0, 6]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), fov=40)
    image = picture_of(Surface(points, NO_FACES), camera, size=(100, 100), point_size=8)
    assert image[:, :50].min() > image[:, 50:].min() + 30


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


def test_pictures_are_written_whole_or_not_at_all(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (8, 9, 3)).astype(np.uint8)
    write_picture(tmp_path / "picture.png", image)
    np.testing.assert_array_equal(iio.imread(tmp_path / "picture.png"), image)
    assert len(list(tmp_path.iterdir())) == 1
    with pytest.raises(InputError, match=r"picture\.bmp: pictures are written as"):
        write_picture(tmp_path / "picture.bmp", image)
    with pytest.raises(InputError, match="does not exist"):
        write_picture(tmp_path / "absent" / "picture.png", image)
