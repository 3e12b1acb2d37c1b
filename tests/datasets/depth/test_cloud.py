"""Depth maps of closed forms → clouds on them, with their normals and colours, and without curtains."""

import json
import signal
import weakref

import cv2
import numpy as np
import pytest
from mplicits import datasets
from mplicits.datasets import DepthCamera, DepthSettings, RgbdFrame, frame_cloud, fuse_frames
from mplicits.datasets.depth import cloud as depth_fusion
from mplicits.datasets.depth.cleaning import measure_noise
from mplicits.neural_fields import InputError
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.fit import depth as fit_depth_module
from mplicits.pipelines.fit.depth import DepthInput, depth_cloud, fit_depth
from mplicits.pipelines.fit.train import FitConfig
from mplicits.pipelines.training.trainer import Interrupted

LENS = DepthCamera(96, 72, 90.0, 92.0, 46.5, 36.5)
EXACT = DepthSettings(smoothing=0)


def plane_depth(normal, offset, lens=LENS):
    """z of the plane ⟨normal, p⟩ = offset along the pixels' rays."""
    return offset / (lens.rays().numpy() @ np.asarray(normal, float))


def sphere_depth(center, radius, lens=LENS):
    """z of the near side of a sphere in camera coordinates; NaN where the rays miss it."""
    rays = lens.rays().numpy()
    a, b = (rays**2).sum(axis=2), rays @ np.asarray(center, float)
    inside = b**2 - a * (np.dot(center, center) - radius**2)
    return np.where(inside > 0, (b - np.sqrt(inside.clip(min=0))) / a, np.nan)


def pose_looking(eye, target):
    return datasets.look_at(eye, target, up=(0, 0, 1), width=4, height=4).world_from_camera.numpy()


def degrees_between(a, b):
    return np.degrees(np.arccos((a * b).sum(axis=1).clip(-1, 1)))


@pytest.mark.parametrize("incidence", [0, 45, 80])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.2, 0.05, 1e-3, -1e-3, 0.0)])
def test_plane_is_met_exactly_however_steep(incidence, distortion):
    """The steepest is seen at up to 83 degrees from its normal, and is no edge."""
    lens = DepthCamera(96, 72, 900.0, 920.0, 46.5, 36.5, distortion)
    normal = np.array([np.sin(np.radians(incidence)), 0, np.cos(np.radians(incidence))])
    depth = plane_depth(normal, 2 * normal[2], lens)
    cloud, report = frame_cloud(RgbdFrame(depth, lens), DepthSettings())
    assert (report.kept, report.smoothing) == (len(cloud), 0) == (depth.size, 0)
    assert np.abs(cloud.points @ normal - 2 * normal[2]).max() < 1e-12
    assert degrees_between(cloud.normals, -normal[None]).max() < 0.05


def test_sphere_points_normals_and_colours():
    lens = DepthCamera(240, 180, 225.0, 230.0, 118.0, 92.0)
    center, radius = np.array([0.1, -0.05, 3.0]), 0.8
    depth = sphere_depth(center, radius, lens)
    v, u = np.mgrid[:180, :240]
    color = np.stack((u, v, np.full_like(u, 7)), axis=-1).astype(np.uint8)
    cloud, report = frame_cloud(RgbdFrame(depth, lens, color), EXACT)
    out = (cloud.points - center) / radius
    assert np.abs(np.linalg.norm(out, axis=1) - 1).max() < 1e-6
    angles = degrees_between(cloud.normals, out)
    facing = -(out * cloud.points).sum(axis=1) / np.linalg.norm(cloud.points, axis=1)
    assert angles[facing > 0.35].max() < 1  # seen at less than 70 degrees from the normal
    assert angles.max() < 20  # at the rim, where the neighbours on one side are missing
    assert ((cloud.normals * cloud.points).sum(axis=1) < 0).all()
    pixels = lens.at(np.eye(4)).in_view(cloud.points)[0]
    assert np.abs(cloud.colors[:, :2] * 255 - pixels).max() < 1e-4
    assert report.without_reading == int(np.isnan(depth).sum())
    assert report.pixels == report.without_reading + report.edges + report.grazing + report.specks + report.kept
    assert report.kept > 0.95 * (report.pixels - report.without_reading)


@pytest.mark.parametrize("ramp", [0, 1, 2, 3, 6])
@pytest.mark.parametrize("axis", [0, 1])
def test_step_grows_no_curtain(ramp, axis):
    lens = DepthCamera(96, 72, 500.0, 500.0, 46.5, 36.5)
    across, length = (72, 96) if axis else (96, 72)
    profile = np.where(np.arange(length) < length // 2, 1.0, 2.0)
    profile[length // 2 : length // 2 + ramp] = 1 + (1 + np.arange(ramp)) / (ramp + 1)
    depth = np.broadcast_to(profile[None] if axis else profile[:, None], (72, 96)).copy()
    cloud, report = frame_cloud(RgbdFrame(depth, lens), EXACT)
    assert np.isin(cloud.points[:, 2], (1.0, 2.0)).all()
    assert degrees_between(cloud.normals, np.array([[0, 0, -1.0]])).max() < 1e-3
    assert report.kept == across * (length - ramp - 2)  # a pixel on each side goes, and nothing else
    assert report.edges + report.grazing + report.specks == across * (ramp + 2)


def test_step_in_front_of_a_steep_floor_is_found():
    floor = plane_depth((0, -1.0, 0.12), -1.0)
    floor = np.where((floor > 0) & (floor < 6), floor, np.nan)
    depth = floor.copy()
    depth[:, 40:50] = np.fmin(depth[:, 40:50], 1.5)
    cloud, _ = frame_cloud(RgbdFrame(depth, LENS), EXACT)
    on_post = cloud.points[:, 2] == 1.5
    on_floor = np.abs(cloud.points @ (0, -1.0, 0.12) + 1) < 1e-9
    assert (on_post | on_floor).all()
    assert on_post.sum() > 200
    assert on_floor.sum() > 0.6 * np.isfinite(floor).sum()


def test_noise_is_measured_and_smoothed_away_but_not_over_the_edge():
    random = np.random.default_rng(0)
    lens = DepthCamera(96, 72, 500.0, 500.0, 47.5, 35.5)
    normal = np.array([0.5, 0.2, 0.8]) / 0.93**0.5
    depth = plane_depth(normal, 2 * normal[2], lens)
    depth[:, 48:] += 1
    noisy = depth * (1 + 0.002 * random.normal(size=depth.shape))
    raw, _ = frame_cloud(RgbdFrame(noisy, lens), EXACT)
    cloud, report = frame_cloud(RgbdFrame(noisy, lens))
    assert report.noise == pytest.approx(0.002, rel=0.1)
    assert 2 <= report.smoothing <= 8
    left = cloud.points[:, 2] < 2.5
    off = np.abs(cloud.points[left] @ normal - 2 * normal[2])
    assert off.mean() < 0.4 * 0.002 * 2
    assert np.median(degrees_between(raw.normals, -normal[None])) > 20
    assert np.median(degrees_between(cloud.normals[left], -normal[None])) < 6
    u, v = np.rint(lens.at(np.eye(4)).in_view(cloud.points)[0]).astype(int).T
    assert np.abs(cloud.points[:, 2] - depth[v, u]).max() < 0.05


def test_plateaus_of_quantised_depth_are_smoothed_over():
    """A Kinect's depth has steps, here of 2 cm with noise that flips whole patches; pixel by pixel little is seen."""
    random = np.random.default_rng(0)
    lens = DepthCamera(160, 120, 525.0, 525.0, 79.5, 59.5)
    normal = np.array([0.3, 0.1, 0.95]) / 1.0025**0.5
    depth = plane_depth(normal, 2.5 * normal[2], lens)
    patches = cv2.resize(random.normal(size=(20, 27)), (160, 120), interpolation=cv2.INTER_CUBIC)
    quantised = np.rint((depth + 0.01 * patches) / 0.02) * 0.02
    noise = measure_noise(quantised, pixel_angle=lens.pixel_angle)
    white = measure_noise(depth * (1 + 0.002 * random.normal(size=depth.shape)), pixel_angle=lens.pixel_angle)
    assert (noise.patchy, white.patchy) == (True, False)
    assert white.deviation == pytest.approx(0.002, rel=0.1)
    assert noise.radius > white.radius
    choices = (DepthSettings(), DepthSettings(smoothing=4), EXACT)
    clouds = [frame_cloud(RgbdFrame(quantised, lens), settings)[0] for settings in choices]
    auto, narrow, raw = (np.mean(degrees_between(cloud.normals, -normal[None])) for cloud in clouds)
    assert auto < 8 < 0.6 * narrow < raw


def test_exact_curved_surfaces_are_not_smoothed():
    depth = sphere_depth((0.1, 0, 3.0), 0.8)
    assert measure_noise(depth, pixel_angle=LENS.pixel_angle).radius == 0


def test_colours_guide_the_smoothing():
    random = np.random.default_rng(0)
    depth, color = np.full((72, 96), 1.0), np.zeros((72, 96, 3), np.uint8)
    depth[:, 48:], color[:, 48:] = 1.004, 255  # a step no higher than the noise
    noisy = depth * (1 + 0.002 * random.normal(size=depth.shape))

    def step(picture):
        cloud, _ = frame_cloud(RgbdFrame(noisy, LENS, picture), DepthSettings(smoothing=6))
        pixels = np.rint(LENS.at(np.eye(4)).in_view(cloud.points)[0][:, 0])
        return cloud.points[pixels == 48, 2].mean() - cloud.points[pixels == 47, 2].mean()

    assert step(color) == pytest.approx(0.004, abs=0.0008)
    assert step(None) < 0.75 * step(color)


def test_range_specks_and_nothing_left():
    depth = np.full((72, 96), np.nan)
    depth[10:40, 10:40] = 1.0
    depth[50:53, 50:53] = 1.0
    depth[50:70, 70:90] = 5.0
    settings = DepthSettings(max_depth=4.0, smallest_piece=0.01, smoothing=0)
    cloud, report = frame_cloud(RgbdFrame(depth, LENS), settings)
    assert (len(cloud), report.kept, report.specks, report.out_of_range) == (900, 900, 9, 400)
    with pytest.raises(InputError, match="0 of 1309 readings"):
        frame_cloud(RgbdFrame(depth, LENS), DepthSettings(max_depth=0.5))
    assert "400 beyond the largest depth" in report.summary()


@pytest.mark.parametrize("name", ["max_depth", "jump", "max_incidence", "smoothing", "max_points"])
def test_settings_out_of_range(name):
    with pytest.raises(ValueError, match=name):
        DepthSettings(**{name: -1})


def test_frames_say_what_does_not_fit():
    depth = np.ones((72, 96))
    for message, parts in (
        ("depth: float64", (depth[2:], LENS)),
        ("color: float64", (depth, LENS, np.ones((72, 96, 3)))),
        ("world_from_camera", (depth, LENS, None, 2 * np.eye(4))),
    ):
        with pytest.raises(ValueError, match=message):
            RgbdFrame(*parts)


def test_pose_is_camera_to_world():
    eye, target = np.array([5.0, 1, 2]), np.array([1.0, 2, 0.5])
    depth = sphere_depth((0, 0, np.linalg.norm(target - eye)), 1.0)
    cloud, _ = frame_cloud(RgbdFrame(depth, LENS, None, pose_looking(eye, target)), EXACT)
    out = cloud.points - target
    assert np.abs(np.linalg.norm(out, axis=1) - 1).max() < 1e-9
    assert (out @ (eye - target) > 0).all()  # the side that the camera sees
    assert np.median(degrees_between(cloud.normals, out)) < 1


def sphere_frames(eyes):
    """Unit sphere around the origin, seen from there."""
    depths = [sphere_depth((0, 0, np.linalg.norm(eye)), 1.0) for eye in eyes]
    return [RgbdFrame(d, LENS, None, pose_looking(eye, (0, 0, 0))) for d, eye in zip(depths, eyes, strict=True)]


def test_views_of_a_sphere_keep_its_sides_and_drop_what_flies():
    """A patch of air beside the sphere, 16 pixels wide, is in the first map alone; the others see through it."""
    frames = sphere_frames([(4.0, 0, 0), (-4.0, 0, 0), (0, 4.0, 0)])
    clean, clean_report = fuse_frames(frames, EXACT)
    assert clean_report.seen_through == 0
    first, *others = (frame.depth.copy() for frame in frames)
    assert np.isnan(first[28:44, 4:20]).all()
    first[28:44, 4:20] = 4.0
    depths = [first, *(np.where(np.isnan(depth), 9.0, depth) for depth in others)]  # walls behind the free space
    flown = [RgbdFrame(d, LENS, None, f.world_from_camera) for d, f in zip(depths, frames, strict=True)]
    alone, _ = frame_cloud(flown[0], EXACT)
    flying = np.abs(np.linalg.norm(alone.points, axis=1) - 1) > 0.01
    assert flying.sum() > 100
    cloud, report = fuse_frames(flown, EXACT)
    radius = np.linalg.norm(cloud.points, axis=1)
    assert ((np.abs(radius - 1) < 1e-9) | (radius > 4)).all()
    assert (report.frames, report.seen_through) == (3, flying.sum())
    on_sphere = cloud.points[radius < 2]
    assert 0.9 * len(clean) < len(on_sphere) < len(clean)  # before walls, the rims of the sphere are edges
    assert min((side * on_sphere[:, 0] > 0.9).sum() for side in (1, -1)) > 50
    accounted = report.without_reading + report.edges + report.grazing + report.specks
    assert report.pixels == accounted + report.seen_through + report.thinned + report.kept


def test_fusion_thins_what_several_frames_saw():
    frames = sphere_frames([(4.0, 0, 0.1 * k) for k in range(5)])
    every, _ = fuse_frames(frames, EXACT)
    few, report = fuse_frames(frames, DepthSettings(smoothing=0, max_points=1500))
    assert 1200 <= len(few) <= 1500
    assert report.thinned == len(every) - len(few)
    assert np.isin(few.points, every.points).all()
    assert fuse_frames(frames, EXACT, views=2)[1].seen_through == 0


class Watched:
    """Frames that are made anew in each pass; counts those that still exist when the next one is made."""

    def __init__(self, eyes):
        self.eyes, self.passes, self.alive, self.most = eyes, 0, weakref.WeakSet(), 0

    def __iter__(self):
        self.passes += 1
        for eye in self.eyes:
            self.most = max(self.most, len(self.alive))
            frames = sphere_frames([eye])
            self.alive.add(frames[0])
            yield frames.pop()


def test_fusion_holds_no_frame_longer_than_it_looks_at_it():
    frames = Watched([(4 * np.cos(a), 4 * np.sin(a), 0.2) for a in np.linspace(0, 5, 6)])
    cloud, report = fuse_frames(frames, EXACT)
    assert (frames.passes, frames.most, report.frames) == (2, 0, 6)
    whole, same = fuse_frames(list(frames), EXACT)
    assert same == report
    assert np.array_equal(whole.points, cloud.points)
    assert frames.most == 5  # a list holds them
    with pytest.raises(ValueError, match="frames: an iterator"):
        fuse_frames(iter(frames), EXACT)


def test_fusion_keeps_few_points_of_long_sequences():
    settings = DepthSettings(smoothing=0, max_points=100)
    pool = depth_fusion._Pool(settings)
    eyes = np.array([(4 * np.cos(a), 4 * np.sin(a), 0.2) for a in np.linspace(0, 6, 20)])
    for frame in sphere_frames(eyes):
        pool.add(frame)
        cloud, owner = pool.joined()
        assert len(cloud) == len(owner) <= 2 * depth_fusion.FUSION.room * settings.max_points
    # Rows stay together: a point was seen by the camera of its frame, from the front.
    assert (((eyes[owner] - cloud.points) * cloud.points).sum(axis=1) > 0).all()
    assert len(np.unique(owner)) > 10


@pytest.mark.parametrize(("stray", "hinted"), [(7.0, True), (1.4, False)])
def test_far_strays_give_a_hint(stray, hinted):
    depth = np.full((72, 96), 1.0)
    depth[60:66, :10] = stray
    assert ("--max-depth 1.1 " in frame_cloud(RgbdFrame(depth, LENS), EXACT)[1].summary()) == hinted


def test_fusion_refuses_what_does_not_fit():
    bare, other = sphere_frames([(4.0, 0, 0), (0, 4.0, 0)])
    colored = RgbdFrame(bare.depth, LENS, np.zeros((72, 96, 3), np.uint8), bare.world_from_camera, "a.png")
    for frames, message in (([colored, other], "no colour picture"), ([], "none given")):
        with pytest.raises(InputError, match=message):
            fuse_frames(frames)
    with pytest.raises(ValueError, match="tolerance=0"):
        fuse_frames([bare], tolerance=0)


def test_thinning_keeps_points_and_spreads_them():
    random = np.random.default_rng(0)
    points = np.concatenate((random.random((9000, 3)) * (1, 1, 0), random.random((1000, 3)) * (1, 1, 0) + (1, 0, 0)))
    cloud = datasets.PointCloud(points + 1e6, points, points.clip(0, 1))
    few = datasets.thin(cloud, 500)
    assert 450 <= len(few) <= 500
    assert np.isin(few.points, cloud.points).all()
    assert np.abs(few.points - 1e6 - few.normals).max() < 1e-6  # rows stay together
    assert 0.4 < (few.points[:, 0] < 1e6 + 1).mean() < 0.6  # of the points, 90 % lie there
    assert datasets.thin(cloud, 10_000) is cloud
    assert len(datasets.thin(cloud, 1)) == 1


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Frames as a user has them: folders of PNG, a trajectory and intrinsics; each picture has a colour of its own."""
    folder, scale, lines = tmp_path_factory.mktemp("scene"), 5000.0, []
    for name in ("depth", "color"):
        (folder / name).mkdir()
    for index, frame in enumerate(sphere_frames([(3.0, 0, 0), (-1.5, 2.6, 0), (-1.5, -2.6, 0.3)])):
        steps = np.rint(np.nan_to_num(frame.depth) * scale).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{index:03d}.png"), steps)
        picture = np.full((*frame.depth.shape, 3), (40 * index, 100, 200), np.uint8)
        cv2.imwrite(str(folder / "color" / f"{index:03d}.png"), picture[..., ::-1])
        pose = (" ".join(map(repr, map(float, row))) for row in frame.world_from_camera)
        lines += [f"{index} {index} {index + 1}", *pose]
    (folder / "trajectory.log").write_text("\n".join(lines))
    lens = {name: getattr(LENS, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps(lens | {"depth_scale": scale}))
    return folder


SMALL = "--widths 16 --depths 1 --omegas 5 --steps 200 --learning-rates 5e-3 --batch 256 --samples 2000 --quiet"


def run_fit(*arguments):
    return main(["fit", *map(str, arguments), *SMALL.split()])


def test_fit_of_one_depth_map(scene, tmp_path, capsys):
    run = tmp_path / "run"
    given = ["--intrinsics", scene / "camera.json", "--color", scene / "color" / "000.png"]
    assert run_fit(scene / "depth" / "000.png", *given, "-o", run) == 0
    trim = capsys.readouterr().out.rsplit("--trim-distance ", 1)[1].split()[0]
    cloud = datasets.read_cloud(run / "cloud.ply")
    assert np.abs(np.linalg.norm(cloud.points - (0, 0, 3), axis=1) - 1).max() < 1e-3  # in the camera's own axes
    assert np.abs(cloud.colors * 255 - (0, 100, 200)).max() < 1e-3
    assert json.loads((run / "run.json").read_text())["cleaning"]["normals_source"] == "file"
    assert main(["mesh", str(run), "-o", str(tmp_path / "m.ply"), "--resolution", "48", "--trim-distance", trim]) == 0


def test_fit_of_several_posed_depth_maps(scene, tmp_path, capsys, monkeypatch):
    alive, most = weakref.WeakSet(), 0

    def watched(*arguments, **options):
        nonlocal most
        most = max(most, len(alive))
        alive.add(frame := datasets.read_frame(*arguments, **options))
        return frame

    monkeypatch.setattr(fit_depth_module, "read_frame", watched)
    run = tmp_path / "run"
    given = ["--intrinsics", scene / "camera.json", "--color", scene / "color", "--poses", scene / "trajectory.log"]
    assert run_fit(scene / "depth", *given, "-o", run) == 0
    assert "3 depth maps: " in capsys.readouterr().out
    assert most == 0
    cloud = datasets.read_cloud(run / "cloud.ply")
    assert np.abs(np.linalg.norm(cloud.points, axis=1) - 1).max() < 1e-3
    from_first = cloud.points[:, 0] > 0.95
    assert np.abs(cloud.colors[from_first] * 255 - (0, 100, 200)).max() < 1e-3
    assert len(np.unique(np.rint(cloud.colors[:, 0] * 255))) == 3


def test_depth_maps_whose_pose_is_lost_are_left_out_and_counted(scene, tmp_path):
    poses = [pose for _, pose, _ in datasets.read_poses(scene / "trajectory.log")]
    for name, pose in zip(("000", "001", "002"), (poses[0], poses[1] - np.inf, poses[2]), strict=True):
        np.savetxt(tmp_path / f"{name}.txt", pose)
    source = DepthInput(scene / "depth", (str(scene / "camera.json"),), color=scene / "color", poses=tmp_path)
    cloud, report = depth_cloud(source)
    assert (report.frames, report.lost) == (2, 1)
    assert "2 depth maps (1 without a pose left out)" in report.summary()
    assert np.abs(np.linalg.norm(cloud.points, axis=1) - 1).max() < 1e-3
    assert len(np.unique(np.rint(cloud.colors[:, 0] * 255))) == 2  # each map kept its own picture
    for name in ("000", "002"):
        np.savetxt(tmp_path / f"{name}.txt", np.full((4, 4), -np.inf))
    with pytest.raises(InputError, match="all 3 poses are lost"):
        depth_cloud(source)


def test_resuming_takes_the_cloud_of_the_run(scene, tmp_path):
    run, depth = tmp_path / "run", scene / "depth" / "000.png"
    source = DepthInput(depth, (str(scene / "camera.json"),))
    one = {"widths": (16,), "depths": (1,), "omegas": (5,), "steps": (400,), "learning_rates": (5e-3,)}
    config = FitConfig(**one, batch=256, samples=2000)

    def stop(progress):
        if progress.step > 0:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        fit_depth(source, config, out=run, progress=stop)
    assert main(["fit", str(depth), "-o", str(run), "--resume", "--quiet"]) == 0  # neither lens nor scale again
    assert json.loads((run / "run.json").read_text())["finished"]
    with pytest.raises(InputError, match=r"cloud\.ply"):
        fit_depth(source, None, out=tmp_path, resume=True)


def test_intrinsics_as_numbers_or_an_angle(scene, tmp_path):
    depth = scene / "depth" / "000.png"
    numbers = [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
    assert run_fit(depth, "--intrinsics", *numbers, "--depth-scale", 5000, "-o", tmp_path / "a") == 0
    exact = datasets.read_cloud(tmp_path / "a" / "cloud.ply").points
    assert np.abs(np.linalg.norm(exact - (0, 0, 3), axis=1) - 1).max() < 1e-3
    assert run_fit(depth, "--fov", 40, "--max-points", 300, "-o", tmp_path / "b") == 0
    rough = datasets.read_cloud(tmp_path / "b" / "cloud.ply").points
    assert len(rough) <= 300
    assert rough[:, 2].min() == pytest.approx(10, rel=0.01)  # millimetres were assumed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("depth/000.png", "a depth map needs its camera"),
        ("none.png --fov 40", "no such file or folder"),
        ("depth --intrinsics camera.json", "3 depth maps, but no poses"),
        ("depth/000.png --intrinsics 1 2 3", "expected a JSON file, or FX FY CX CY"),
        ("depth/000.png --intrinsics camera.json --fov 40", "--fov: does not go with --intrinsics"),
        ("depth/000.png --intrinsics camera.json --poses trajectory.log", "3 poses, but 1 depth maps"),
        ("depth/000.png --intrinsics camera.json --color small.png", "--resize-color"),
        ("small.png --intrinsics camera.json --color color", "3 pictures, but 1 depth maps"),
        ("small.npy --intrinsics camera.json", "the intrinsics are for 96 × 72"),
        ("ball.xyz --max-depth 3", "--max-depth: is for depth maps"),
    ],
)
def test_mistakes_of_the_command_line(scene, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(scene)
    cv2.imwrite("small.png", np.zeros((36, 48, 3), np.uint8))
    np.save("small.npy", np.ones((10, 20)))
    (scene / "ball.xyz").write_text("0 0 0\n")
    assert run_fit(*words.split(), "-o", tmp_path / "run") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "run").exists()


def test_read_frame_resizes_pictures_and_takes_the_scale_of_the_camera(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.full((6, 8), 5000, np.uint16))
    cv2.imwrite(str(tmp_path / "c.png"), np.full((12, 16, 3), (10, 20, 30), np.uint8))
    lens = DepthCamera(8, 6, 10.0, 10.0, 4.0, 3.0, depth_scale=2500.0)
    frame = datasets.read_frame(tmp_path / "d.png", lens, color=tmp_path / "c.png", resize_color=True)
    assert (frame.depth == 2).all()
    assert (frame.color == (30, 20, 10)).all()
