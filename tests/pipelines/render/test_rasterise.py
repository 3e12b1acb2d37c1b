"""Pictures: what is drawn where, with which shade, checked against the projection worked out by hand."""

import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets import Camera, look_at, orbit
from mplicits.neural_fields import Mesh
from mplicits.pipelines.render.rasterise import cloud_view, mesh_view, picture_of
from mplicits.pipelines.render.shade import LAMPS, ShadeOptions
from mplicits.pipelines.surface.raster import clip

NO_FACES = np.empty((0, 3), np.int64)
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
TWO_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int64)


def sphere(radius: float = 1.0) -> Mesh:
    mesh = trimesh.creation.icosphere(4, radius=radius)
    return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def from_front(distance: float, *, fov: float, size: tuple[int, int]) -> Camera:
    return look_at((0, 0, distance), (0, 0, 0), fov=fov, width=size[0], height=size[1])


def drawn(image: np.ndarray) -> np.ndarray:
    return (image < 250).any(axis=2)


def test_pixels_see_a_tilted_square_where_their_rays_meet_it():
    normal = np.array([0.6, 0.0, 0.8])
    vertices = SQUARE @ np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]])
    mesh = Mesh(vertices, TWO_FACES, colors=SQUARE / 2 + 0.5)
    camera = look_at((0.3, 0.4, 3), (0, 0, 0), up=(0.1, 1, 0), fov=50, width=60, height=40)
    seen = mesh_view(mesh, camera)
    eye, rays = camera.rays(dtype=torch.float64)
    depth = -(eye @ torch.from_numpy(normal)) / (rays @ torch.from_numpy(normal))  # (H, W)
    points = (eye + depth[..., None] * rays).reshape(-1, 3)
    on_square = points @ torch.from_numpy(np.array([[0.8, 0, -0.6], [0, 1, 0]]).T)  # (H·W, 2)
    assert seen.size == (60, 40)
    assert seen.pixel.tolist() == torch.nonzero((on_square.abs() < 1).all(dim=1))[:, 0].tolist()
    torch.testing.assert_close(seen.depth, depth.reshape(-1)[seen.pixel].float())
    torch.testing.assert_close(seen.position, points[seen.pixel].float(), rtol=0, atol=1e-6)
    torch.testing.assert_close(seen.direction, rays.reshape(-1, 3)[seen.pixel].float(), rtol=0, atol=1e-6)
    torch.testing.assert_close(seen.normal, torch.from_numpy(normal).float().expand_as(seen.normal))
    torch.testing.assert_close(seen.color[:, :2], (on_square[seen.pixel] / 2 + 0.5).float(), rtol=0, atol=1e-6)


def test_normals_are_interpolated_to_unit_length_and_do_not_turn_to_the_camera():
    ball, camera = sphere(), from_front(4, fov=40, size=(64, 64))
    seen = mesh_view(ball, camera)
    torch.testing.assert_close(seen.normal.norm(dim=1), torch.ones(len(seen.pixel)))
    assert float((seen.normal * seen.position).sum(dim=1).min()) > 0.998
    inside_out = mesh_view(Mesh(ball.vertices, ball.faces[:, ::-1]), camera)
    torch.testing.assert_close(inside_out.normal, -seen.normal)


def test_the_nearer_of_two_squares_hides_the_other():
    vertices = np.concatenate((SQUARE - [0, 0, 1], SQUARE * 0.5 + [0, 0, 1]))
    faces = np.concatenate((TWO_FACES, TWO_FACES + 4))
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1]], 4, axis=0)
    camera = from_front(5, fov=40, size=(100, 100))
    for order in (faces, faces[::-1]):
        image = picture_of(Mesh(vertices, order, colors=colors), camera).astype(int)
        assert image[50, 50, 2] > image[50, 50, 0] + 100
        assert image[70, 70, 0] > image[70, 70, 2] + 100


def test_back_faces_show_as_such():
    ball = sphere()
    camera = orbit(ball.vertices, width=64, height=64)
    front = picture_of(ball, camera)[32, 32].astype(float)
    back = picture_of(Mesh(ball.vertices, ball.faces[:, ::-1]), camera)[32, 32].astype(float)
    # Under the same light, albedos differ as their linear values do.
    expected = (np.array(LAMPS.back) / ShadeOptions().clay) * front
    np.testing.assert_allclose(back, expected, rtol=0.02)


def test_cutting_triangles_keeps_their_area_in_front_and_closes_up():
    vertices = np.random.default_rng(2).uniform(-1, 1, (90, 3))
    faces = np.arange(90).reshape(30, 3)
    height = vertices[:, 2] - 0.1
    every, parts, owner = clip(vertices, height, faces)
    assert len(every) > 90
    np.testing.assert_array_equal(every[:90], vertices)
    np.testing.assert_allclose(every[90:, 2], 0.1, atol=1e-12)
    assert (every[parts][..., 2] > 0.1 - 1e-12).all()

    def cross(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        a, b, c = (points[triangles[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    # Parts lie in their triangle's plane, and what is in front and what is behind are together the whole.
    others, behind, whose = clip(vertices, -height, faces)
    whole, sums = cross(vertices, faces), np.zeros((30, 3))
    for points, triangles, owners in ((every, parts, owner), (others, behind, whose)):
        np.add.at(sums, owners, cross(points, triangles))
        np.testing.assert_allclose(np.cross(cross(points, triangles), whole[owners]), 0, atol=1e-12)
        assert ((cross(points, triangles) * whole[owners]).sum(axis=1) > 0).all()
    np.testing.assert_allclose(sums, whole, atol=1e-12)


@pytest.mark.parametrize("turned", [0, 1, 2])
def test_a_floor_under_the_camera_is_drawn_up_to_the_horizon(turned):
    """Two triangles that reach far behind the camera fill exactly the lower half of the picture."""
    corners = np.array([[-1e4, 0, -1e4], [-1e4, 0, 1e4], [1e4, 0, 1e4], [1e4, 0, -1e4]])
    floor = Mesh(corners, np.roll(TWO_FACES, turned, axis=1), colors=np.ones((4, 3)))
    camera = look_at((0.1, 2, 0.2), (0.1, 2, -5), fov=60, width=40, height=40)
    seen = mesh_view(floor, camera)
    assert seen.pixel.tolist() == list(range(20 * 40, 40 * 40))
    _, rays = camera.rays()
    torch.testing.assert_close(seen.depth, -2 / rays.reshape(-1, 3)[seen.pixel, 1], rtol=1e-4, atol=0)
    torch.testing.assert_close(seen.normal, torch.tensor([[0.0, 1, 0]]).expand_as(seen.normal))


@pytest.mark.parametrize("faces", [TWO_FACES, NO_FACES])
def test_what_is_behind_the_camera_is_not_drawn(faces):
    camera = look_at((0, 0, 5), (0, 0, 10), fov=60, width=20, height=20)
    behind = Mesh(SQUARE, faces)
    assert (picture_of(behind, camera) == 255).all()
    ahead = Mesh(np.concatenate((SQUARE, SQUARE + np.array([0, 0, 8]))), np.concatenate((faces, faces + 4)))
    view = mesh_view if len(faces) else cloud_view
    assert set(view(ahead, camera).position[:, 2].tolist()) == {8.0}


def test_a_view_from_inside_a_closed_mesh_sees_it_everywhere():
    camera = look_at((0.2, 0.1, 0), (1, 0.3, -2), fov=100, width=40, height=30)
    seen = mesh_view(sphere(), camera)
    assert seen.pixel.tolist() == list(range(40 * 30))
    assert float(abs(seen.position.norm(dim=1) - 1).max()) < 0.01
    assert float((seen.normal * seen.direction).sum(dim=1).min()) > 0  # outward, so away from the eye


def test_the_pixels_of_a_disc_see_its_point():
    points = np.array([[0.5, 0.25, 0.0], [0.5, 0.25, 1.0], [-0.5, 0, 0]])
    normals = np.array([[0.0, 0, 1], [0, 1, 0], [0, 0, 0]])
    colors = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])
    camera = from_front(4, fov=40, size=(81, 61))
    seen = cloud_view(Mesh(points, NO_FACES, normals, colors), camera, point_size=3)
    pixels, _ = camera.project(torch.from_numpy(points))
    x, y = (pixels[:, k].round().long() for k in (0, 1))
    rows = dict(zip(seen.pixel.tolist(), range(len(seen.pixel)), strict=True))
    assert len(rows) == 27  # three discs apart from each other: i² + j² ≤ 1.5² holds for 9 pixels
    for index in range(3):
        row = rows[int(y[index] * 81 + x[index])]
        torch.testing.assert_close(seen.position[row], torch.from_numpy(points[index]).float())
        torch.testing.assert_close(seen.color[row], torch.from_numpy(colors[index]).float())
        offset = torch.from_numpy(points[index]) - camera.eye
        torch.testing.assert_close(seen.depth[row], offset.norm().float())
        torch.testing.assert_close(seen.direction[row], (offset / offset.norm()).float())
        expected = torch.from_numpy(normals[index]) if normals[index].any() else -offset / offset.norm()
        torch.testing.assert_close(seen.normal[row], expected.float())
    without = cloud_view(Mesh(points, NO_FACES), camera, point_size=3)
    torch.testing.assert_close(without.normal, -without.direction)


def test_a_cloud_without_normals_is_darker_where_it_is_further():
    points = np.array([[-1.0, 0, 1], [1.0, 0, -1]])
    image = picture_of(Mesh(points, NO_FACES), from_front(6, fov=40, size=(100, 100)), point_size=8)
    near, far = (half[drawn(half)].mean() for half in (image[:, :50], image[:, 50:]))
    assert near > far + 30


def test_pictures_of_the_same_thing_far_from_the_origin_are_the_same():
    ball, home = sphere(), np.array([5e5, 5.4e6, 300])
    shapes = (ball, Mesh(ball.vertices + home, ball.faces))
    here, there = (picture_of(shape, orbit(shape.vertices, width=48, height=48)).astype(int) for shape in shapes)
    np.testing.assert_allclose(there, here, atol=1)
