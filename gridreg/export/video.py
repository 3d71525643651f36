"""Videos of fields: MP4, GIF, or a folder of PNG frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from gridreg.errors import InputError
from gridreg.export.images import DepthRange, check_mode, colour_bar, depth_range, to_image
from gridreg.export.writers import check_target, write_video
from gridreg.machine import check_memory
from gridreg.rendering import Rendered
from gridreg.rendering.cameras import Camera
from gridreg.rendering.model import Model
from gridreg.training.images import ImageArray, row

Progress = Callable[[int, int, float], None]
"""Told after every frame: frames done, frames in all, seconds left."""


def render_video(
    models: Model | Sequence[Model],
    path: str | Path,
    cameras: Sequence[Camera],
    *,
    modes: Sequence[str] = ("rgb",),
    fps: float = 30.0,
    depths: DepthRange | None = None,
    progress: Progress | None = None,
) -> None:
    """Render a video of a field, or several fields side by side, along a path of cameras.

    Args:
        models: what to video; several lie side by side, in this order.
        path: ``.mp4`` (H.264), ``.gif`` (colours reduced to 256 a frame, delays in hundredths of a second),
            or a name without suffix: a folder of PNG frames.
        cameras: one for each frame, all of one size.
        modes: what to show of each model, side by side; see `gridreg.export.images.MODES`. Depth has one
            scale for the whole video, shown at the right.
        fps: frames per second.
        depths: near and far end of the depth scale, world units; None: from some of the frames.
        progress: told after every frame.

    Raises:
        InputError: for an unknown mode or suffix, without ffmpeg (MP4), or if the place is not writable.
    """
    check_target(Path(path), fps)
    if cameras:
        height, width = cameras[0].lens.height, cameras[0].lens.width
        beside = (1 if isinstance(models, Model) else len(models)) * len(modes)
        # Colour, depth and opacity as floats, and the frame that is made of them.
        check_memory(40 * beside * height * width, f"frames of {width}x{height}")
    frames = render_frames(models, cameras, modes=modes, depths=depths)
    write_video(path, _reported(frames, len(cameras), progress), fps)


def render_frames(
    models: Model | Sequence[Model],
    cameras: Sequence[Camera],
    *,
    modes: Sequence[str] = ("rgb",),
    depths: DepthRange | None = None,
) -> Iterator[ImageArray]:
    """The frames of `render_video`, ``(H, W, 3)`` uint8, one after the other.

    Raises:
        InputError: for an unknown mode, without cameras or models, or for cameras of different sizes.
    """
    shown = [models] if isinstance(models, Model) else list(models)
    for mode in modes:
        check_mode(mode)
    if not cameras or not shown or not modes:
        raise InputError(
            f"video: found {len(cameras)} cameras, {len(shown)} models, {len(modes)} modes, expected some"
        )
    sizes = sorted({(camera.lens.width, camera.lens.height) for camera in cameras})
    if len(sizes) > 1:
        raise InputError(f"cameras: found the sizes {sizes[0]} and {sizes[1]}, expected one for all frames")
    if "depth" in modes and depths is None:
        depths = _common_depths(shown, cameras)
    return _frames(shown, cameras, modes, depths)


def _frames(
    models: Sequence[Model], cameras: Sequence[Camera], modes: Sequence[str], depths: DepthRange | None
) -> Iterator[ImageArray]:
    for camera in cameras:
        parts = [
            to_image(render, mode, depths) for render in _renders(models, camera, modes) for mode in modes
        ]
        if "depth" in modes and depths is not None:
            parts.append(colour_bar(camera.lens.height, depths))
        yield row(parts, gap=0)


def _renders(models: Sequence[Model], camera: Camera, modes: Sequence[str] = ()) -> list[Rendered]:
    renders = [model.render(camera, deviation="deviation" in modes) for model in models]
    return [render for render in renders if render is not None]


def _common_depths(models: Sequence[Model], cameras: Sequence[Camera], looks: int = 8) -> DepthRange:
    """One scale for all frames, from small images of some of them."""
    chosen = [cameras[i] for i in sorted({round(x) for x in np.linspace(0, len(cameras) - 1, looks)})]
    small = [Camera(c.pose, c.lens.resized(min(64, c.lens.width))) for c in chosen]
    return depth_range([render for camera in small for render in _renders(models, camera)])


def _reported(frames: Iterable[ImageArray], total: int, progress: Progress | None) -> Iterator[ImageArray]:
    start = time.monotonic()
    for done, frame in enumerate(frames, start=1):
        if progress is not None:
            progress(done, total, (time.monotonic() - start) / done * (total - done))
        yield frame
