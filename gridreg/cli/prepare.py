"""``gridreg prepare``: images in, a scene out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gridreg.cli.arguments import OptionalFile, OptionalFloat

Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint=""),
]


@dataclass
class PrepareOptions:
    """Turn photographs, a video, or a scene of COLMAP, nerfstudio or instant-ngp into a scene folder.

    Photographs on the sheet of `gridreg board` (extra `photos`) need no overlap, and their scene is in metres, z up.
    Others need about forty (extra `colmap`); their world is turned so that z is up, centred, and scaled so that the box
    reaches 1.3 to each side. Look at cameras.png before training; give near, far and box anew where they are wrong.
    """

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
    """Folder of images (.jpg, .heic, ...) or of a scene with cameras, or a video; `builtin`: the built-in ones."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Scene folder to make; must not exist."""
    masks: Annotated[str, tyro.conf.arg(metavar="DIR|auto|none|rembg")] = "auto"
    """Folder with a mask for every image, white where it is kept, called like the image with .png; auto: on the sheet,
    what stands there is cut out; rembg: by a network."""
    model: OptionalFile = None
    """The network for --masks rembg: an .onnx file of rembg's, which you bring (package onnxruntime)."""
    near: OptionalFloat = None
    """Distance from a camera where looking begins, world units of the made scene; default: from cameras and points."""
    far: OptionalFloat = None
    """Distance from a camera where looking ends, likewise."""
    longest_edge: int = 800
    """Pixels; larger images are reduced to this once their cameras are known."""
    box: Box = None
    """Lower and upper corner, world units of the made scene; default: from cameras and points."""


def run(options: PrepareOptions) -> int:
    """Make the scene folder and say what was found.

    Raises:
        InputError: as `gridreg.scenes.prepare`.
    """
    import sys

    from gridreg.cli.runs import photographs_of
    from gridreg.scenes import prepare

    box = None if options.box is None else (options.box[:3], options.box[3:])

    def say(stage: str) -> None:
        print(f"{stage} ...", file=sys.stderr, flush=True)

    made = prepare(
        photographs_of(options.images),
        options.out,
        masks=options.masks,
        model=options.model,
        near=options.near,
        far=options.far,
        bounds=box,
        longest_edge=options.longest_edge,
        progress=say,
    )
    print(made)
    print(f"look at {made.drawing}, then: gridreg train --scene {options.out} --out RUN")
    return 0
