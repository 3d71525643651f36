"""``gridreg render``: videos of checkpoints."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gridreg.cli.arguments import OptionalFile, OptionalFloat, OptionalFolder, OptionalInt, OptionalText
from gridreg.machine import DeviceName, choose_device


@dataclass
class RenderOptions:
    """Render a video of a checkpoint along a path of cameras; several checkpoints lie side by side in one video."""

    checkpoints: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="")
    ]
    """Output folders of runs, or their checkpoints; the cameras are those of the first."""
    out: OptionalFile = None
    """Video (.mp4, .gif), or a name without suffix for PNG frames; default: PATH.mp4 in the run's folder."""
    path: OptionalText = None
    """turntable (default), spiral (default facing forward), train (the training cameras), or a JSON file."""
    modes: tuple[Literal["rgb", "depth", "opacity", "deviation"], ...] = ("rgb",)
    """What to show, side by side; depth has a scale in world units; deviation: how far an ensemble's members differ."""
    frames: int = 120
    """Number of images; a camera file has its own."""
    fps: float = 30.0
    """Images per second."""
    width: OptionalInt = None
    """Of each image, pixels; default: that of the training images."""
    elevation: OptionalFloat = None
    """Of the turntable, degrees above the horizon; default: the median of the training cameras'."""
    radius: OptionalFloat = None
    """Distance of turntable and spiral, world units; default: the median of the training cameras'."""
    scene: OptionalFolder = None
    """Where the scene lies now, for its training cameras; default: where the run found it."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""


def run(options: RenderOptions) -> int:
    """Write the video and say where.

    Raises:
        InputError: for missing or damaged checkpoints, bad paths and numbers, or without ffmpeg (MP4).
    """
    from gridreg.cli.runs import folder_of, views_scene
    from gridreg.errors import InputError
    from gridreg.export import render_video, video_path
    from gridreg.training import load_run
    from gridreg.training.progress import Progress

    if not options.checkpoints:
        raise InputError("checkpoints: found none, expected at least one run")
    if options.width is not None and options.width < 1:
        raise InputError(f"--width: found {options.width}, expected at least 1 pixel")
    device = choose_device(options.device)
    runs = [load_run(checkpoint, device) for checkpoint in options.checkpoints]
    first = options.checkpoints[0]
    scene = views_scene(runs[0], first, options.scene)
    if scene is None:
        print(f"{runs[0].config.scene}: not there any more, so the path follows the box", file=sys.stderr)
    cameras = video_path(
        runs[0],
        None if scene is None else scene.train,
        options.path,
        frames=options.frames,
        width=options.width,
        elevation=options.elevation,
        radius=options.radius,
        world=runs[0].world,
    )
    name = Path(options.path).stem if options.path else "spiral" if runs[0].warp else "turntable"
    target = options.out if options.out is not None else folder_of(first) / f"{name}.mp4"
    with Progress(len(cameras), label="frame") as progress:
        render_video(
            runs,
            target,
            cameras,
            modes=options.modes,
            fps=options.fps,
            progress=lambda done, total, left: progress.update(done),
        )
    print(f"{target}: {len(cameras)} frames of {cameras[0].lens.width}x{cameras[0].lens.height}")
    return 0
