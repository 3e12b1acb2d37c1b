"""Cameras checked and drawn: right figures, warnings where something is wrong, none where all is well."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets.cameras import look_at
from mplicits.datasets.clouds.cleaning.orientation import fibonacci_directions
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImage
from mplicits.datasets.views.writing import write_colmap, write_neus, write_transforms
from mplicits.neural_fields import Similarity
from mplicits.pipelines.cli import main
from mplicits.pipelines.cli.views import SCENE_NAMES
from mplicits.pipelines.reconstruct.check import DepthCheck, check_cameras, check_depths, check_files
from mplicits.pipelines.reconstruct.frustums import camera_mesh, frustum_size
from mplicits.pipelines.reconstruct.hull import Agreement
from mplicits.pipelines.surface.surface import read_surface
from reconstructions import painted_sphere, with_views, without

from benchmarks.scenes.view_faults import with_fault

WRITERS = {"neus": write_neus, "transforms": write_transforms, "colmap": write_colmap}
VIEWS = 10  # of the figure with depth maps


@pytest.fixture(scope="module")
def good():
    return painted_sphere(8, 24)


@pytest.fixture(scope="module")
def torus():
    return render_scene(SCENES["striped-torus"](), 12, 32, samples=1)


def turned(images, turn):
    """The images with ``turn`` ``(4, 4) → (4, 4)`` done to every pose."""

    def moved(_, view):
        pose = torch.from_numpy(turn(view.camera.world_from_camera.numpy()))
        return replace(view, camera=replace(view.camera, world_from_camera=pose))

    return with_views(images, moved)


def the_warning(images) -> str:
    """Of a data set in which one thing is wrong."""
    (warning,) = check_cameras(images).warnings
    assert "\n" not in warning
    return warning


def test_figures_are_those_of_the_cameras(good):
    check = check_cameras(good)
    assert check.warnings == ()
    fov = 2 * math.degrees(math.asin(1.1 / 4))
    assert np.abs(check.fields_of_view - fov).max() < 1e-9
    assert np.abs(check.distances - 2.4).max() < 1e-9
    assert (check.points_inside, check.mask_inside) == (1.0, 1.0)


def test_share_of_the_sphere_in_view_is_that_of_the_caps_in_the_pyramid():
    """Far away, a view of half the sphere's width sees what lies within |x|, |y| < 1/2 of it: 4/3 π (…) of its area."""
    camera = look_at((0, 0, 1e6), (0, 0, 0), fov=math.degrees(2e-6 * 0.5), width=9, height=9)
    expected = (np.abs(fibonacci_directions(100_000)[:, :2]) < 0.5).all(axis=1).mean()
    assert check_cameras(single(camera)).in_view[0] == pytest.approx(expected, abs=0.01)


def single(camera):
    color = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    return replace(painted_sphere(1, 8), views=(PosedImage("only.png", camera, color, None),), points=None)


def test_fields_of_view_of_a_lens_off_centre():
    camera = look_at((0, 0, 4), (0, 0, 0), width=30, height=20)
    lens = torch.tensor([[10.0, 0, 9.5], [0, 20, 9.5], [0, 0, 1]], dtype=torch.float64)
    check = check_cameras(single(replace(camera, intrinsics=lens)))
    across, down = 45 + math.degrees(math.atan(2)), 2 * math.degrees(math.atan(0.5))
    assert np.abs(check.fields_of_view - [across, down]).max() < 1e-9
    assert "single view" in check.warnings[0]


def test_figures_do_not_depend_on_where_the_world_is(good):
    """Map coordinates, in millimetres."""
    similarity = Similarity((4e8, -5e9, 1e5), 2500.0)

    def away(pose):
        pose = pose.copy()
        pose[:3, 3] = similarity.to_input(pose[:3, 3])
        return pose

    moved = replace(turned(good, away), similarity=similarity, points=similarity.to_input(good.points))
    check, expected = check_cameras(moved), check_cameras(good)
    assert check.warnings == ()
    assert np.abs(check.distances - expected.distances).max() < 1e-6
    assert np.abs(check.in_view - expected.in_view).max() < 2e-3


FLIP, SHIFT = np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(4)
SHIFT[:3, 3] = 0.6, -0.4, 0.5
BESIDE = Similarity((0.0, 0.0, 1.3), 0.5)


def darker(images, factor):
    return with_views(images, lambda k, v: replace(v, color=v.color * np.float32(factor)) if k == 6 else v)


def with_masks(images, change, which=None):
    """With the masks of some views, or of all, changed."""
    return with_views(images, lambda k, v: replace(v, mask=change(v.mask)) if which is None or k in which else v)


WRONG = {
    "flipped": (lambda good: turned(good, lambda pose: pose @ FLIP), "look away: 8 of 8"),
    # Inverted poses of cameras around the origin all stand in one place.
    "inverse": (lambda good: turned(good, np.linalg.inv), "one place.*camera-to-world"),
    "inverse-moved": (lambda good: turned(good, lambda pose: np.linalg.inv(SHIFT @ pose)), "camera-to-world"),
    "large": (lambda good: replace(good, similarity=Similarity((0, 0, 0), 2.5)), "8 of 8 cameras stand inside"),
    "beside": (lambda good: replace(good, similarity=BESIDE, points=None), "middle of the region .* is out of view"),
    "dark": (lambda good: darker(good, 0.3), "1 of 8 images are two stops .*: 006.png"),
    "hardly-dark": (lambda good: darker(good, 0.8), None),
    "empty": (lambda good: with_masks(good, np.zeros_like, (2, 5)), "2 of 8 masks are empty: 002.png, 005.png"),
    "full": (
        lambda good: with_masks(good, np.ones_like),
        "8 of 8 masks are full: 000.png, 001.png, 002.png and 5 more",
    ),
    "mirrored": (lambda good: with_masks(good, lambda mask: mask[:, ::-1].copy()), None),  # a sphere stays the same
}


@pytest.mark.parametrize(("change", "words"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_alone(good, change, words):
    if words is None:
        assert check_cameras(change(good)).warnings == ()
    else:
        assert re.search(words, the_warning(change(good)))


def test_one_camera_astray_shows_in_its_mask_alone(good):
    flipped = turned(good, lambda pose: pose @ FLIP)
    mixed = with_views(good, lambda k, view: flipped.views[k] if k == 3 else view)
    assert the_warning(mixed).startswith("1 of 8 silhouettes contradict the others: 003.png")
    check = check_cameras(without(mixed, "mask"))
    assert (check.warnings, check.mask_inside) == ((), None)


def test_a_region_that_cuts_the_object(good):
    check = check_cameras(replace(good, similarity=Similarity((0, 0, 0), 0.3)))
    # Discs of the projected spheres: (0.3² / (2.4² − 0.3²)) / (0.6² / (2.4² − 0.6²))
    assert check.mask_inside == pytest.approx(0.25 * 5.4 / 5.67, abs=0.02)
    assert check.points_inside == 0
    (warning,) = check.warnings
    assert "% of the object's pixels see past the region" in warning


def test_masks_that_are_inverted_all_or_one(good, torus):
    for images in (good, torus):
        inverted = with_masks(images, lambda mask: 1 - mask)
        assert any("they look inverted" in line for line in check_cameras(inverted).warnings)
        one = check_cameras(with_masks(images, lambda mask: 1 - mask, (3,))).warnings
        assert any(re.search(f"1 of .* contradict .*{images.views[3].name}", line) for line in one)


@pytest.mark.parametrize(("inverted", "outliers"), [((), []), ((3, 11), ["003.png", "011.png"]), ((3, 11, 17), [])])
def test_a_tenth_of_the_pictures_may_be_outliers(figure, inverted, outliers):
    images = with_masks(figure, lambda mask: 1 - mask, inverted)
    agreement = Agreement.of(images.views, images.similarity)
    assert len(agreement.contradictions()) == len(inverted)
    assert [view.name for view in agreement.outliers()] == outliers


def test_a_single_look_from_above_is_no_outlier(torus, figure):
    for images in (torus, figure):
        by_height = sorted(images.views, key=lambda view: abs(float(view.camera.eye[2])))
        some = (*by_height[: len(by_height) // 2], by_height[-1])
        assert Agreement.of(some, images.similarity).outliers() == []


def test_a_picture_of_something_else(torus):
    """In the place of a picture that sees the ring from above, one that sees it from its side."""
    height = [abs(float(view.camera.eye[2])) for view in torus.views]
    side, above = torus.views[int(np.argmin(height))], int(np.argmax(height))
    wrong = with_views(torus, lambda k, v: replace(v, color=side.color, mask=side.mask) if k == above else v)
    assert the_warning(wrong).startswith(f"1 of 12 silhouettes contradict the others: {torus.views[above].name};")


@pytest.fixture(scope="module")
def figure():
    return render_scene(SCENES["figure"](), 24, 64, samples=1)


def test_masks_with_holes(figure):
    assert Agreement.of(figure.views, figure.similarity).holes() == {}
    torn = with_fault(figure, "holes")
    assert the_warning(torn).startswith("2 of 24 masks have a hole where all others see object: 002.png, 014.png")
    found = Agreement.of(torn.views, torn.similarity).holes()
    for index, hole in found.items():
        missing = (figure.views[index].mask > 0.5) & (torn.views[index].mask <= 0.5)
        # All of it, and nothing else but gaps that are no wider than a cell away from it.
        assert hole[missing].all()
        assert not hole[torn.views[index].mask > 0.5].any()
        assert (hole & ~missing).sum() < 0.2 * missing.sum()
    assert Agreement.of(torn.views, torn.similarity).outliers() == []  # the rest of those pictures is right
    few = replace(torn, views=torn.views[:12])  # each of these may cut much
    assert Agreement.of(few.views, few.similarity).holes() == {}
    notch = np.array(figure.views[2].mask)
    notch[20:44, :32] = 0  # open to the border: it may be the outline
    cut = with_masks(figure, lambda _: notch, (2,))
    assert Agreement.of(cut.views, cut.similarity).holes() == {}


@pytest.mark.parametrize("axes", [(1,), (0,), (0, 1)])
def test_pictures_that_are_turned(figure, axes):
    assert check_cameras(figure).warnings == ()
    flipped = with_views(figure, lambda _, v: replace(v, color=np.flip(v.color, axes), mask=np.flip(v.mask, axes)))
    assert "the silhouettes fit no shape" in the_warning(flipped)


def test_inexact_poses_are_not_taken_for_turned_pictures(figure):
    for seed in range(3):
        inexact = with_fault(figure, "poses", seed)
        assert not any("silhouettes" in line for line in check_cameras(inexact).warnings)


def assert_eyes_drawn(mesh, images):
    for view in images.views:
        assert np.linalg.norm(mesh.vertices - view.camera.eye.numpy(), axis=1).min() < 0.02


def test_the_mesh_shows_spheres_eyes_pictures_and_points(good):
    mesh = camera_mesh(good)
    assert mesh.vertices[:, 2].max() > 0.99
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(2.4, abs=0.01)  # no further than the eyes
    assert_eyes_drawn(mesh, good)
    # The first and the last camera have the ends of viridis.
    for view, color in ((good.views[0], (0.27, 0.0, 0.33)), (good.views[-1], (0.99, 0.91, 0.14))):
        at = np.linalg.norm(mesh.vertices - view.camera.eye.numpy(), axis=1).argmin()
        assert np.abs(mesh.colors[at] - color).max() < 0.02
    assert (mesh.faces.min(), mesh.faces.max()) == (0, len(mesh.vertices) - 1)


def test_a_picture_hangs_where_its_pixels_are_seen(good):
    camera = look_at((3.0, 1.0, 0.5), (0, 0, 0), up=(0, 0, 1), width=40, height=20)
    x, y = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 20))
    color = np.stack((x, y, 0.5 + 0 * x), axis=-1).astype(np.float32)
    view = PosedImage("ramp.png", camera, color, None)
    mesh = camera_mesh(replace(good, views=(view,), points=None))
    blue = np.abs(mesh.colors[:, 2] - 0.5) < 1e-6
    assert blue.sum() == 2 * 40 * 20
    pixels, z = camera.project(torch.from_numpy(mesh.vertices[blue]))
    eye_side = (z < z.min() + 1e-9).numpy()
    assert eye_side.sum() == 40 * 20
    assert 0 < float(z.min()) < float(z.max()) < 1.02 * float(z.min()) < float(camera.eye.norm())
    shares = (pixels.numpy() + 0.5) / [40, 20]
    assert np.abs(shares - mesh.colors[blue, :2])[eye_side].max() < 1e-5
    triangle = mesh.vertices[mesh.faces[blue[mesh.faces].all(axis=1)]]
    facing = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]) @ camera.forward.numpy()
    assert (facing > 0).sum() == (facing < 0).sum() == 2 * 39 * 19
    nearest = camera.project(torch.from_numpy(triangle[:, 0]))[1].numpy() < float(z.min()) + 1e-9
    assert np.array_equal(nearest, facing < 0)  # the side towards the eye is nearer to it


def test_lines_are_closed_tubes_and_faces_point_outward(good):
    mesh = camera_mesh(replace(good, views=good.views[:1]))
    shells = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=True)
    assert len(shells) == 11 * 64 + 3 + 10 + 1000  # circles, axes, the frustum's lines, points
    assert min(shell.volume for shell in shells) > 0


def test_frustums_are_as_large_as_there_is_room():
    def ring(count, radius):
        angles = 2 * math.pi * np.arange(count) / count
        return [look_at((radius * math.cos(a), 0, radius * math.sin(a)), (0, 0, 0), width=4, height=4) for a in angles]

    sparse, dense = frustum_size(ring(4, 3.0)), frustum_size(ring(60, 3.0))
    assert sparse == pytest.approx((0.9, 1.2))  # at most 0.3 and 0.4 of the distance
    assert dense == pytest.approx((0.3, 1.2))  # at least a tenth
    assert frustum_size(ring(24, 3.0))[0] == pytest.approx(0.5 * 6 * math.sin(math.pi / 24))
    assert frustum_size(ring(1, 3.0)) == pytest.approx((0.9, 1.2))


@pytest.mark.parametrize("name", WRITERS)
def test_a_good_data_set_has_no_warnings(tmp_path, capsys, name, torus):
    WRITERS[name](tmp_path / "data", torus)
    out, record = tmp_path / "cameras.glb", tmp_path / "cameras.json"
    assert main(["check-cameras", str(tmp_path / "data"), "-o", str(out), "--json", str(record)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    for words in ("12 views of 32 × 32 pixels", "field of view: 31.9° across, 31.9° down", "cameras.glb: frustums"):
        assert words in printed.out
    assert_eyes_drawn(read_surface(out), torus)  # in world coordinates
    figures = json.loads(record.read_text())
    assert len(figures["distances_in_radii"]) == 12
    assert figures["warnings"] == []


def test_a_flipped_file_is_shown_around_a_guess(tmp_path, capsys, good):
    write_transforms(tmp_path / "data", turned(good, lambda pose: pose @ FLIP))
    out = tmp_path / "cameras.ply"
    assert main(["check-cameras", str(tmp_path / "data"), "-o", str(out)]) == 0
    first, second = capsys.readouterr().err.splitlines()
    assert "warning: the cameras look away: 8 of 8" in first
    assert "warning: there is no region of interest but a guess" in second
    assert_eyes_drawn(read_surface(out), good)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: no such file"),
        (["DATA"], "003.png"),
        (["DATA", "-o", "cameras.stl"], "unknown extension '.stl'"),
    ],
)
def test_mistakes_end_in_one_line(tmp_path, capsys, good, words, message):
    write_neus(tmp_path / "data", good)
    picture = tmp_path / "data" / "image" / "003.png"
    picture.write_bytes(picture.read_bytes()[:-200])
    assert main(["check-cameras", *(word.replace("DATA", str(tmp_path / "data")) for word in words)]) == 2
    output, error = capsys.readouterr()
    assert (output, error.count("\n")) == ("", 1)
    assert message in error


@pytest.mark.parametrize("form", ["transforms", pytest.param("colmap", marks=pytest.mark.slow)])
def test_scenes_come_with_their_truth(tmp_path, capsys, form):
    assert set(SCENE_NAMES) == set(SCENES)
    folder = tmp_path / "scene"
    command = ["scene", "striped-torus", "-o", str(folder), "--format", form]
    assert main([*command, "--views", "6", "--size", "16", "--samples", "1"]) == 0
    assert "6 views of 16 × 16 pixels" in capsys.readouterr().out
    images, check, _ = check_files(folder)
    assert check.warnings == ()
    assert len(images.views) == 6
    truth = read_surface(folder / "surface.ply")
    distance = SCENES["striped-torus"]().field.value(torch.from_numpy(truth.vertices))
    assert float(distance.abs().max()) < 1e-5
    assert truth.colors is not None
    assert main(command) == 2  # nothing is overwritten
    assert "is not empty" in capsys.readouterr().err


@pytest.fixture(scope="module")
def scene():
    return render_scene(SCENES["figure"](), VIEWS, 48, samples=1, depths=True)


def changed(images, change):
    """The same views; the map of each is ``change(number, all maps)``."""
    maps = [view.depth.numbers for view in images.views]
    return with_views(images, lambda k, v: replace(v, depth=replace(v.depth, numbers=change(k, maps))))


@pytest.mark.parametrize("masks", [True, False])
def test_exact_maps_agree(scene, masks):
    check = check_depths(scene if masks else without(scene, "mask"))
    assert (check.maps, check.inside, check.warnings) == (VIEWS, 1.0, ())
    assert check.seen_through == 0  # what lies around a pixel is nearer than its reading, or as near, but for slopes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param(lambda k, maps: 0.8 * maps[k], "contradict each other.*--depth-scale", id="0.8"),
        pytest.param(lambda k, maps: 1.25 * maps[k], "contradict each other.*--depth-scale", id="1.25"),
        pytest.param(lambda k, maps: 1000.0 * maps[k], "0.0% of the depths in all maps.*--depth-scale", id="1000"),
        pytest.param(lambda k, maps: maps[k][:, ::-1].copy(), "are they of these photographs", id="mirrored"),
        pytest.param(lambda k, maps: maps[k - 1], "are they of these photographs", id="of-the-view-before"),
        pytest.param(lambda k, maps: np.full_like(maps[k], np.nan), "no depth map has a reading", id="empty"),
    ],
)
def test_wrong_maps_are_noticed(scene, change, words):
    (warning,) = check_depths(changed(scene, change)).warnings
    assert re.search(words, warning)


def test_the_noise_of_a_sensor_is_no_contradiction(scene):
    random = np.random.default_rng(0)
    noisy = changed(scene, lambda k, maps: maps[k] * (1 + 0.01 * random.standard_normal(maps[k].shape)))
    assert not check_depths(noisy).warnings


def test_maps_that_cannot_be_compared_are_counted(scene):
    loose = with_views(scene, lambda _, view: replace(view, depth=replace(view.depth, kind="disparity")))
    assert check_depths(loose) == DepthCheck(VIEWS)
    assert check_depths(without(scene, "depth")) is None
    assert check_depths(replace(scene, views=scene.views[:1])).seen_through is None


def test_the_command_checks_depth_maps(tmp_path, scene, capsys):
    write_transforms(tmp_path / "photos", scene)
    assert main(["check-cameras", str(tmp_path / "photos")]) == 0
    said = capsys.readouterr()
    line = f"depth maps: {VIEWS} of {VIEWS} photographs have one; 100.0% of the readings end in the region; other views"
    assert line in said.out
    assert "depth" not in said.err
    wrong = ["--depth-maps", str(tmp_path / "photos" / "depths"), "--depth-scale", "0.8"]
    assert main(["check-cameras", str(tmp_path / "photos"), *wrong]) == 0
    assert "warning: the depth maps contradict each other" in capsys.readouterr().err
    assert main(["check-cameras", str(tmp_path / "photos"), *wrong, "--depth-kind", "relative"]) == 0
    said = capsys.readouterr()
    assert f"depth maps: {VIEWS} of {VIEWS} photographs have one\n" in said.out
    assert "depth" not in said.err


def test_wrong_cameras_are_said_alone(scene):
    check = check_cameras(with_views(scene, lambda _, view: replace(view, camera=scene.views[0].camera)))
    assert check.depths is not None
    assert not any("depth" in warning for warning in check.warnings[1:])
