"""Animations, read back: as many frames, as long, as large and of the colours that were written."""

import os
import weakref
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.render.film import write_animation

CODES = (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_CODEC_PIXEL_FORMAT)


def flat_frames(count: int) -> list[np.ndarray]:
    """Frames ``(48, 64, 3)`` of four flat quarters whose colours move from frame to frame."""
    shifts = range(0, 5 * count, 5)
    colors = [[(230 - s, 120, 40), (60, 110 + s, 170), (250, 250, 250 - s), (20 + s, 30, 40)] for s in shifts]
    small = np.array(colors, np.uint8).reshape(count, 2, 2, 3)
    return list(small.repeat(24, axis=1).repeat(32, axis=2))


def quarters(frames: np.ndarray) -> np.ndarray:
    """The colours in the middle of the four quarters, ``(N, 2, 2, 3)``."""
    return frames[:, 12::24, 16::32].astype(float)


def read_mp4(path) -> tuple[np.ndarray, float, str, str]:
    """Frames, frames per second, codec and pixel format."""
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    fourcc = [int(video.get(key)).to_bytes(4, "little").decode() for key in CODES]
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(frames)
    return np.stack(frames), video.get(cv2.CAP_PROP_FPS), *fourcc


def read_gif(path) -> np.ndarray:
    return iio.imread(path, plugin="pillow", mode="RGB")


def read_gif_durations(path) -> list[int]:
    with iio.imopen(path, "r", plugin="pillow") as file:
        return [file.metadata(index=k)["duration"] for k in range(file.properties(index=...).shape[0])]


@pytest.mark.parametrize("fps", [10, 24])
def test_an_mp4_holds_its_frames_their_colours_and_their_time(tmp_path, fps):
    frames = flat_frames(12)
    write_animation(tmp_path / "a.mp4", frames, fps=fps)
    back, rate, codec, pixels = read_mp4(tmp_path / "a.mp4")
    assert back.shape == (12, 48, 64, 3)
    np.testing.assert_allclose(quarters(back), quarters(np.array(frames)), atol=4)
    assert (rate, codec, pixels) == (fps, "h264", "I420")
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_a_gif_holds_its_frames_their_colours_and_their_time_and_loops(tmp_path):
    frames = flat_frames(12)
    write_animation(tmp_path / "a.gif", frames, fps=12.5)
    back = read_gif(tmp_path / "a.gif")
    assert back.shape == (12, 48, 64, 3)
    np.testing.assert_allclose(quarters(back), quarters(np.array(frames)), atol=6)  # it is dithered
    assert set(read_gif_durations(tmp_path / "a.gif")) == {80}
    assert iio.immeta(tmp_path / "a.gif", plugin="pillow")["loop"] == 0  # for ever
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_a_gif_of_gradients_stays_near_them_and_small(tmp_path):
    ramp = np.linspace(0, 1, 200)[None, :, None]
    still = np.repeat((ramp * [220, 120, 40] + (1 - ramp) * [240, 245, 250]).astype(np.uint8), 150, axis=0)
    frames = np.stack([still] * 10)
    for k, frame in enumerate(frames):
        frame[60:90, 10 * k : 10 * k + 30] = (30, 60, 150)
    write_animation(tmp_path / "a.gif", frames, fps=30)
    back = read_gif(tmp_path / "a.gif").astype(float)
    assert abs(back - frames).mean() < 2
    assert (back[:, :50] == back[0, :50]).all()  # what rests does not flicker
    assert (tmp_path / "a.gif").stat().st_size < 60_000
    assert sum(read_gif_durations(tmp_path / "a.gif")) == pytest.approx(333, abs=11)


def test_odd_sizes_of_an_mp4_are_padded_with_the_edge_and_a_gif_keeps_them(tmp_path):
    frame = np.full((33, 45, 3), 250, np.uint8)
    frame[:, 36:] = (40, 90, 160)
    frame[28:] = (200, 60, 40)
    write_animation(tmp_path / "a.mp4", [frame, frame])
    write_animation(tmp_path / "a.gif", [frame, frame])
    video = read_mp4(tmp_path / "a.mp4")[0].astype(int)
    assert video.shape == (2, 34, 46, 3)
    np.testing.assert_allclose(video[:, 33, 10], np.broadcast_to((200, 60, 40), (2, 3)), atol=6)
    np.testing.assert_allclose(video[:, 10, 45], np.broadcast_to((40, 90, 160), (2, 3)), atol=6)
    assert read_gif(tmp_path / "a.gif").shape[-3:] == (33, 45, 3)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_frames_are_asked_for_one_at_a_time_and_let_go(tmp_path, suffix):
    made = []

    def frames():
        for flat in flat_frames(6):
            assert sum(reference() is not None for reference in made) <= 2  # the first and the one before at most
            frame = flat.copy()
            made.append(weakref.ref(frame))
            yield frame

    write_animation(tmp_path / f"a{suffix}", frames())
    assert len(made) == 6


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_the_older_file_and_nothing_else(tmp_path, suffix, error):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"older")

    def frames():
        yield from flat_frames(3)
        raise error

    with pytest.raises(error):
        write_animation(path, frames())
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this machine")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_full_disk_is_an_error_with_its_reason(tmp_path, suffix):
    (tmp_path / f".a.{os.getpid()}.partial{suffix}").symlink_to("/dev/full")
    with pytest.raises(InputError, match=rf"a\{suffix}: cannot be written \(ffmpeg failed: .*No space left"):
        write_animation(tmp_path / f"a{suffix}", flat_frames(20))
    assert list(tmp_path.iterdir()) == []


FRAME = np.zeros((8, 10, 3), np.uint8)


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.avi", [FRAME], 30, r"a\.avi: .*\.mp4"),
        ("a.mp4", [], 30, r"a\.mp4: no frames"),
        ("a.gif", [], 30, r"a\.gif: no frames"),
        ("a.gif", [FRAME, FRAME[:, :6]], 30, r"a\.gif: frame 2 is 6×8"),
        ("a.mp4", [FRAME.astype(float)], 30, r"a\.mp4: frame 1 is float64"),
        ("a.mp4", [FRAME], 0, "fps=0"),
    ],
)
def test_mistakes_are_named(tmp_path, name, frames, fps, message):
    with pytest.raises((InputError, ValueError), match=message):
        write_animation(tmp_path / name, iter(frames), fps=fps)
    assert list(tmp_path.iterdir()) == []
