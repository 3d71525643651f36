"""Few TensoRF (TensoRF + frequency masks + occlusion loss) on a scene in Blender format, or on the built-in one.

python examples/few_tensorf_blender.py
python examples/few_tensorf_blender.py --scene DIR --protocol dietnerf8 --preset few_tensorf --out DIR
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from gridreg.errors import InputError
from gridreg.export import Model, camera_path, render_video, write_mesh
from gridreg.training import Execution, TrainOptions, configure, execute, open_scene, output_folder


def draw(run: Execution, options: TrainOptions) -> None:
    """What can be held and shown: a mesh and a film."""
    trainer, scene = run.trainer, run.scene
    model = Model(trainer.field, trainer.occupancy, trainer.march, scene.background)
    if options.mesh:
        try:
            write_mesh(trainer.field, run.out / "mesh.ply", trainer.occupancy)
        except InputError as error:
            # A field without a surface (a very short run) is scored all the same.
            print(f"no mesh: {error}", file=sys.stderr)
    if options.video:
        cameras = camera_path("turntable", trainer.field.bounds, scene.train, frames=60, width=200)
        render_video(model, run.out / "turntable.mp4", cameras)


def main(options: TrainOptions) -> int:
    """Train, score, draw."""
    config = configure(options)
    out = output_folder(options, config)
    scene = open_scene(config, cache=Path("outputs"))
    print(
        f"{scene.name}, {scene.protocol}: {len(scene.train)} training views; results go to {out}", flush=True
    )
    run, metrics = execute(config, scene, out, resume=options.resume, command=sys.argv)
    if metrics is None:
        return 130
    draw(run, options)
    mean, seconds = metrics["mean"], metrics["seconds"]
    print(
        f"{metrics['scene']}: mean of {metrics['test_views']} test views: PSNR {mean['psnr']:.2f} dB, "
        f"SSIM {mean['ssim_gaussian']:.4f} (11x11 Gaussian); trained in {seconds['train']:.0f} s"
    )
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(TrainOptions)))
    except KeyboardInterrupt:
        print("stopped; --resume goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
