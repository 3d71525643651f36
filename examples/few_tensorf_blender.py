"""Few TensoRF (TensoRF + frequency masks + occlusion loss) on a scene in Blender format, or on the built-in one.

python examples/few_tensorf_blender.py
python examples/few_tensorf_blender.py --scene DIR --protocol dietnerf8 --preset few_tensorf --out DIR
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from gridreg.cli import run_cli
from gridreg.export import check_drawing, draw_run, live_view
from gridreg.training import TrainOptions, configure, execute, open_scene, output_folder
from gridreg.training.record import summary


def main(options: TrainOptions) -> int:
    """Train, score, draw."""
    with live_view(options.view, options.host, options.port) as look:
        config = configure(options)
        check_drawing(video=options.video)
        out = output_folder(options, config)
        scene = open_scene(config, cache=Path("outputs"))
        print(
            f"{scene.name}, {scene.protocol}: {len(scene.train)} training views; results go to {out}",
            flush=True,
        )
        run, metrics = execute(config, scene, out, resume=options.resume, command=sys.argv, watch=look)
        if metrics is None:
            return 130
        print(f"{summary(metrics)}; trained in {metrics['seconds']['train']:.0f} s", flush=True)
        draw_run(run, mesh=options.mesh, video=options.video)
        if look is not None:
            look.finish()
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(lambda: main(tyro.cli(TrainOptions))))
