"""Frames to files: MP4 through ffmpeg, GIF, or a folder of PNG images; whole or not at all."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

from gridreg.errors import InputError
from gridreg.training.files import check_output_folder, replacing_folder, writing
from gridreg.training.images import ImageArray


def check_target(path: Path, fps: float) -> None:
    """Refuse what cannot become a video, before it is rendered; make the folder that it goes to.

    Raises:
        InputError: for another suffix or speed, without ffmpeg (MP4), or if the place is not writable.
    """
    if not 0.002 <= fps <= 1000:
        # A GIF holds at most 655 seconds for a frame.
        raise InputError(f"fps={fps}: expected frames per second above 0, from 0.002 to 1000")
    if path.suffix.lower() not in (".mp4", ".gif", ""):
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected .mp4, .gif, or none for PNG frames")
    if path.suffix.lower() == ".mp4":
        find_ffmpeg()
    check_output_folder(path.parent)


def find_ffmpeg() -> str:
    """The ffmpeg program.

    Raises:
        InputError: if there is none.
    """
    try:
        program = str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        program = ""
    if not program or shutil.which(program) is None:
        raise InputError(
            f"ffmpeg: found {program or 'none'}, expected the program for .mp4; "
            "install imageio-ffmpeg or ffmpeg, or write .gif or PNG frames, which do without"
        )
    return program


def write_video(path: str | Path, frames: Iterable[ImageArray], fps: float = 30.0) -> None:
    """Write frames as they come to MP4, GIF or a folder of PNG files, by the suffix; whole or not at all.

    Args:
        path: see `render_video`.
        frames: ``(H, W, 3)`` uint8, all of one size.
        fps: frames per second.

    Raises:
        InputError: as `render_video`.
    """
    path = Path(path)
    check_target(path, fps)
    if path.suffix.lower() == ".mp4":
        with writing(path) as temporary:
            _write_mp4(temporary, frames, fps)
    elif path.suffix.lower() == ".gif":
        with writing(path) as temporary:
            _write_gif(temporary, frames, fps)
    else:
        _check_frames(path)
        with replacing_folder(path) as folder:
            for number, frame in enumerate(frames):
                Image.fromarray(frame).save(folder / f"frame_{number:04d}.png")


def _write_mp4(path: Path, frames: Iterable[ImageArray], fps: float) -> None:
    program = find_ffmpeg()
    process: subprocess.Popen[bytes] | None = None
    # Not a pipe: ffmpeg would stop when nobody empties it.
    with tempfile.TemporaryFile() as log:
        try:
            for frame in frames:
                # Colour is stored for blocks of 2x2 pixels.
                even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
                if process is None:
                    command = [program, *_arguments(even.shape[1], even.shape[0], fps), str(path)]
                    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)
                assert process.stdin is not None
                try:
                    process.stdin.write(np.ascontiguousarray(even).tobytes())
                except OSError:
                    # It has stopped reading; why, its log says.
                    break
            if process is None:
                raise InputError(f"{path}: found no frames, expected at least one")
            _finish(process)
        finally:
            if process is not None and process.returncode is None:
                process.kill()
                _finish(process)
        if process.returncode != 0:
            log.seek(0)
            text = log.read().decode(errors="replace").strip().splitlines()
            raise InputError(f"ffmpeg: failed with {text[-1] if text else f'status {process.returncode}'}")


def _finish(process: subprocess.Popen[bytes]) -> None:
    """Tell ffmpeg that this was all, and wait until it has completed the file."""
    assert process.stdin is not None
    # It may have gone already, for a reason that its status and log tell.
    with suppress(BrokenPipeError):
        process.stdin.close()
    process.wait()


def _arguments(width: int, height: int, fps: float) -> list[str]:
    """Raw frames in, H.264 in 4:2:0 out, which every browser plays, its index first."""
    rate = str(Fraction(fps).limit_denominator(1001))
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-"]
    target = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-movflags", "+faststart"]
    return ["-y", "-v", "error", *source, *target]


def _write_gif(path: Path, frames: Iterable[ImageArray], fps: float) -> None:
    images = (Image.fromarray(frame).quantize(256, dither=Image.Dither.NONE) for frame in frames)
    first = next(images, None)
    if first is None:
        raise InputError(f"{path}: found no frames, expected at least one")
    first.save(path, save_all=True, append_images=images, duration=max(20, round(1000 / fps)), loop=0)


def _check_frames(path: Path) -> None:
    """Refuse a place for frames where anything else stands."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: a file stands where a folder of frames is expected; choose another name")
    others = [p.name for p in path.iterdir() if not p.match("frame_*.png")] if path.is_dir() else []
    if others:
        raise InputError(f"{path}: holds {others[0]!r}, expected a new folder or one of frames alone")
