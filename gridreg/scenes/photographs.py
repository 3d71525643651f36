"""Photographs as people have them: sharp frames of a video, and doubts about blurred ones and duplicates."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes.decoding import open_image

__all__ = ["VIDEOS", "doubtful_photographs", "is_video", "sharpest_frames"]

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".3gp")
"""Extensions of videos."""

_SMALL = 512
# Frames that are looked at for each one taken.
_CHOICE = 6
# Of skimage's blur_effect, 0 to 1: how much above the usual of its set a blurred photograph is.
_BLURRED = 0.12
# Mean difference of two thumbnails whose contrast is 1.
_ALIKE = 0.06


def is_video(path: Path) -> bool:
    """Tell whether a file is called like a video."""
    return path.suffix.lower() in VIDEOS


def sharpest_frames(video: Path, folder: Path, count: int = 40) -> int:
    """Write the sharpest frame of each of ``count`` equal stretches of a video as JPEG, and return how many there are.

    Args:
        video: the file; it is turned upright as it says.
        folder: new folder for the images.
        count: stretches of the video.

    Raises:
        InputError: when the file is no video that ffmpeg reads, or too short.
    """
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        raise InputError(f"{video}: needs ffmpeg, and there is none; install imageio-ffmpeg") from None
    command = [program, "-hide_banner", "-nostdin", "-i", str(video)]
    said = subprocess.run(command, capture_output=True, check=False).stderr.decode(errors="replace")
    length = re.search(r"Duration: (\d+):(\d+):(\d+\.\d+)", said)
    if length is None or "Video:" not in said:
        raise InputError(f"{video}: not a video that ffmpeg can read")
    hours, minutes, seconds = map(float, length.groups())
    rate = _CHOICE * count / max(3600 * hours + 60 * minutes + seconds, 0.1)
    folder.mkdir(parents=True)
    options = ["-vf", f"fps={rate:.6f}", "-q:v", "2", str(folder / "frame_%05d.jpg")]
    subprocess.run([*command, *options], capture_output=True, check=False)
    frames = sorted(folder.iterdir())
    kept = {max(frames[k : k + _CHOICE], key=_sharpness) for k in range(0, len(frames), _CHOICE)}
    for frame in set(frames) - kept:
        frame.unlink()
    if not kept:
        raise InputError(f"{video}: no frame of it can be read")
    return len(kept)


def doubtful_photographs(paths: Sequence[Path]) -> list[str]:
    """Return a line for photographs that are blurred, beside their set, and one for each pair that shows the same.

    Raises:
        InputError: when an image cannot be read.
    """
    from skimage.measure import blur_effect

    blurs, thumbnails = [], []
    for path in paths:
        with open_image(path) as image:
            grey = image.convert("L")
            grey.thumbnail((2 * _SMALL, 2 * _SMALL))
        blurs.append(float(blur_effect(np.asarray(grey) / 255)))  # type: ignore[no-untyped-call]
        small = np.asarray(grey.resize((24, 24), Image.Resampling.BOX), dtype=np.float32)
        thumbnails.append((small - small.mean()) / max(float(small.std()), 1.0))
    usual = float(np.median(blurs)) if blurs else 0.0
    blurred = [path.name for path, blur in zip(paths, blurs, strict=True) if blur > usual + _BLURRED]
    doubts = [f"blurred beside the others: {', '.join(blurred)}"] if blurred else []
    for k, thumbnail in enumerate(thumbnails):
        for other in range(k):
            if float(np.abs(thumbnail - thumbnails[other]).mean()) < _ALIKE:
                doubts.append(
                    f"show the same, one of them adds nothing: {paths[other].name} and {paths[k].name}"
                )
    return doubts


def _sharpness(path: Path) -> float:
    """Return how much neighbouring pixels of a reduced image differ from their mean."""
    with open_image(path) as opened:
        image = opened.convert("L")
        image.thumbnail((_SMALL, _SMALL))
    grey: NDArray[np.float32] = np.asarray(image, dtype=np.float32)
    inner = grey[1:-1, 1:-1]
    around = (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]) / 4
    return float((inner - around).var())
