"""``gridreg reconstruct``: from photographs to an object and a page, in one command."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from gridreg.cli.arguments import OptionalInt
from gridreg.machine import DeviceName

_ENOUGH = 24
"""Photographs of which an eighth is not missed."""


@dataclass
class ReconstructOptions:
    """Make an object of photographs: cameras and masks, training, mesh, and a page to pass on.

    It is `prepare` and `train` one after the other; what is done already in OUT is kept, so that the same command goes
    on where it was stopped. On the sheet of `gridreg board` eight photographs are enough, and sizes are true.
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photographs, or a video; the word `builtin` for the built-in photographs."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for everything: scene/, checkpoint/, mesh.ply, index.html, ..."""
    preset: str = "quick"
    """Field, schedule and regularizers by name, see `gridreg train`."""
    steps: OptionalInt = None
    """Iterations; default: the preset's."""
    seed: OptionalInt = None
    """Of every random number; default: 0."""
    threads: OptionalInt = None
    """Processor threads; default: all cores."""
    longest_edge: int = 800
    """Pixels; larger photographs are reduced to this once their cameras are known."""
    hold_out: bool = False
    """Keep every eighth photograph out of training, to score on it; of 24 photographs and more that is always done."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""


def run(options: ReconstructOptions) -> int:
    """Prepare what is not prepared, train, and draw.

    Raises:
        InputError: as `gridreg.scenes.prepare` and `gridreg train`.
    """
    from gridreg.cli import train
    from gridreg.cli.runs import photographs_of
    from gridreg.scenes import prepare
    from gridreg.scenes.load import read_folder
    from gridreg.training import TrainOptions, configure
    from gridreg.training.checkpoint import has_checkpoint

    scene = options.out / "scene"
    chosen = TrainOptions(
        protocol="all",
        scene=scene,
        out=options.out,
        preset=options.preset,
        steps=options.steps,
        seed=options.seed,
        threads=options.threads,
        device=options.device,
        video=False,
        # A telephone chooses exposure and white balance anew for each photograph.
        set=("train.exposure=true",),
        resume=has_checkpoint(options.out / "checkpoint"),
    )
    # A wrong option is said before an hour of work, not after it.
    configure(chosen)
    if scene.is_dir():
        print(f"{scene}: is there already and is used as it is; remove it to prepare photographs anew")
    else:
        made = prepare(
            photographs_of(options.photographs),
            scene,
            longest_edge=options.longest_edge,
            progress=lambda stage: print(f"{stage} ...", file=sys.stderr, flush=True),
        )
        print(made, flush=True)
    listed = read_folder(scene)
    if options.hold_out or len(listed.train) + len(listed.test) >= _ENOUGH:
        chosen = replace(chosen, protocol="holdout8")
    return train.run(chosen)
