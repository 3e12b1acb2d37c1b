"""Frames to an MP4 or a looping GIF, one at a time, so that a long animation takes no more memory than a short one."""

from __future__ import annotations

import itertools
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import imageio_ffmpeg
import numpy as np

from ...neural_fields import InputError
from ...neural_fields.backend.files import whole_file
from .picture import Image

ANIMATIONS = (".mp4", ".gif")
# Without these, players guess the matrix from the frame's size, and colours shift a little.
BT709 = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv"]


def write_animation(path: str | Path, frames: Iterable[Image], *, fps: float = 30) -> None:
    """Write RGB frames ``(H, W, 3)``, uint8, to an H.264 MP4, or a GIF that loops with one palette for all frames.

    Frames are taken one by one, and the file appears when it is complete. An odd width or height of an MP4 is padded by
    repeating the last column or row, since colour is stored at half resolution. A GIF shows at most 50 frames per
    second. Raises an InputError if the file cannot be written, and a ValueError for no frames, frames of several sizes,
    or ``fps`` ≤ 0.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in ANIMATIONS:
        raise InputError(f"{path}: animations are written as {' or '.join(ANIMATIONS)}")
    if not 0 < fps < float("inf"):
        raise ValueError(f"{path}: fps={fps}; expected a number > 0")
    checked = _checked(path, frames)
    with whole_file(path) as partial:
        (_write_mp4 if suffix == ".mp4" else _write_gif)(partial, checked, fps)


def _checked(path: Path, frames: Iterable[Image]) -> Iterator[Image]:
    """The frames as they come, or an error that says what is wrong with one."""
    first: tuple[int, ...] | None = None
    count = 0
    for count, frame in enumerate(frames, start=1):
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
            raise ValueError(f"{path}: frame {count} is {frame.dtype} {frame.shape}; expected uint8 (H, W, 3)")
        first = first or frame.shape
        if frame.shape != first:
            raise ValueError(
                f"{path}: frame {count} is {frame.shape[1]}×{frame.shape[0]} after frames of {first[1]}×{first[0]}; "
                "draw all of them in one size"
            )
        yield frame
    if not count:
        raise ValueError(f"{path}: no frames to write; expected at least one")


def _write_mp4(path: Path, frames: Iterator[Image], fps: float) -> None:
    matrix = ["-vf", "scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p", *BT709]
    # x264's constant rate factor 16: flat colours and thin lines stay clean, and files are still small.
    settings = ["-vcodec", "libx264", "-crf", "16", "-movflags", "+faststart"]
    even = (np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in frames)
    _encode(even, fps, [*matrix, *settings, path])


def _write_gif(path: Path, frames: Iterator[Image], fps: float) -> None:
    """Two passes over a lossless copy: the best 256 colours of all frames, then the frames in these.

    Ordered dithering gives a resting pixel the same colour in every frame; error diffusion does not.
    """
    with tempfile.TemporaryDirectory() as folder:
        clip, palette = Path(folder) / "clip.mkv", Path(folder) / "palette.png"
        _encode(frames, fps, ["-vcodec", "ffv1", "-pix_fmt", "bgr0", clip])
        with _ffmpeg(["-i", clip, "-vf", "palettegen", "-update", "1", palette]):
            pass
        dither = "paletteuse=dither=bayer:bayer_scale=5:diff_mode=rectangle"
        with _ffmpeg(["-i", clip, "-i", palette, "-lavfi", dither, "-loop", "0", path]):
            pass


def _encode(frames: Iterator[Image], fps: float, output: Sequence[str | Path]) -> None:
    """Send frames to ffmpeg; nothing is started before the first one, whose size ffmpeg must be told, is there."""
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    with _ffmpeg(["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-", *output]) as stdin:
        for frame in itertools.chain([first], frames):
            stdin.write(np.ascontiguousarray(frame).data)


@contextmanager
def _ffmpeg(arguments: Sequence[str | Path]) -> Iterator[IO[bytes]]:
    """Run ffmpeg around a block that writes to its input; kill it if the block fails; raise an OSError if ffmpeg fails.

    imageio's own writer leaves ffmpeg running when a frame cannot be made, and ignores its exit code.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *map(str, arguments)]
    with tempfile.TemporaryFile() as log:
        # In a session of its own ffmpeg does not see Ctrl-C: it is for us to stop it.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True
        )
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError), process.stdin:  # ffmpeg is gone: its log says why
                yield process.stdin
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        if code:
            log.seek(0)
            reason = " ".join(log.read().decode(errors="replace").split())[:200]
            raise OSError(f"ffmpeg failed: {reason or code}")
