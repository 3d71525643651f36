"""``gridreg train``: the example's own way, installed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gridreg.export import check_drawing, draw_run, live_view
from gridreg.machine import choose_device
from gridreg.scenes import Scene
from gridreg.training import (
    RunConfig,
    Trainer,
    TrainOptions,
    Watch,
    build_trainer,
    configure,
    execute,
    open_scene,
    output_folder,
)
from gridreg.training.record import summary
from gridreg.training.tensorboard import TensorBoard


def run(
    options: TrainOptions,
    make: Callable[[RunConfig, Scene], Trainer] = build_trainer,
    command: Sequence[str] = (),
) -> int:
    """Train, score, draw; 130 if it was interrupted, with its checkpoint saved.

    Args:
        options: of the command line.
        make: makes the trainer at step 0.
        command: the command line, for the record; default: that of ``gridreg``.

    Raises:
        InputError: for anything that a user can mend.
    """
    with live_view(options.view, options.host, options.port) as look:
        config, device = configure(options), choose_device(options.device)
        check_drawing(video=options.video)
        boards = [TensorBoard()] if options.tensorboard else []
        out = output_folder(options, config)
        scene = open_scene(config, cache=Path("outputs")).to(device)
        print(
            f"{scene.name}, {scene.protocol}: {len(scene.train)} training and {len(scene.test)} test views of "
            f"{scene.train.width}x{scene.train.height}; results go to {out}",
            flush=True,
        )
        watching: list[Watch] = [*boards, *([] if look is None else [look])]
        command = command or ["gridreg", *sys.argv[1:]]
        execution, metrics = execute(
            config, scene, out, resume=options.resume, command=command, watch=watching, make=make
        )
        if metrics is None:
            return 130
        # The score first: mesh and video take their time, and may fail.
        print(f"{summary(metrics)}; trained in {metrics['seconds']['train']:.0f} s", flush=True)
        written = draw_run(execution, mesh=options.mesh, video=options.video)
        for path in [out / "metrics.json", out / "test.png", *written]:
            print(f"  {path}")
        sys.stdout.flush()
        if look is not None:
            look.finish()
    return 0
