"""``gridreg eval``: the score of a checkpoint, computed again."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

from gridreg.cli.arguments import Checkpoint, OptionalFile, OptionalFolder
from gridreg.machine import DeviceName, choose_device


@dataclass
class EvalOptions:
    """Score a checkpoint on the test views of its scene; another scene is refused."""

    checkpoint: Checkpoint
    """Output folder of a run, or its checkpoint."""
    scene: OptionalFolder = None
    """Where the scene lies now; default: where the run found it."""
    lpips: OptionalFile = None
    """Weights of LPIPS as a safetensors file, network vgg or alex, for that distance as well; default: without it."""
    out: OptionalFolder = None
    """Folder for metrics.json, test.png, test/ (renders beside their targets) and index.html; default: the score."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""


def run(options: EvalOptions) -> int:
    """Print the score of each test view and their mean.

    Raises:
        InputError: for a missing or damaged checkpoint, another scene, other weights, or a place that is not
            writable or that another run writes to.
    """
    from gridreg.training.files import check_output_folder, one_writer

    with nullcontext() if options.out is None else one_writer(check_output_folder(options.out)):
        return _score(options)


def _score(options: EvalOptions) -> int:
    from gridreg.cli.runs import folder_of, scene_of
    from gridreg.export import write_page
    from gridreg.ops.compilation import work_clock
    from gridreg.scenes.doubts import trained_on
    from gridreg.training import load_run
    from gridreg.training.evaluate import Scored, score_views
    from gridreg.training.exposure import AFFINE_CONVENTION, affine_psnr
    from gridreg.training.files import check_output_folder, write_json
    from gridreg.training.metrics import image_metrics
    from gridreg.training.outputs import save_contact_sheet, save_scored
    from gridreg.training.perceptual import read_lpips
    from gridreg.training.record import metrics_record, summary
    from gridreg.training.typed_data import to_data

    lpips = None if options.lpips is None else read_lpips(options.lpips)
    loaded = load_run(options.checkpoint, choose_device(options.device))
    scene = scene_of(loaded, options.checkpoint, options.scene)
    folder = None if options.out is None else check_output_folder(options.out / "test")
    if loaded.step < loaded.config.train.steps:
        print(f"step {loaded.step} of {loaded.config.train.steps}: not trained to its end", file=sys.stderr)
    began = work_clock()

    def each(view: Scored) -> None:
        values = "  ".join(f"{name} {value:.4f}" for name, value in view.metrics.items())
        print(f"{view.name}  {values}", flush=True)
        if folder is not None:
            save_scored(folder, view)

    more: dict[str, Any] = {} if lpips is None else {lpips.name: lpips}
    conventions = {} if lpips is None else {lpips.name: lpips.convention}
    if loaded.exposed:
        more, conventions = {"psnr_affine": affine_psnr, **more}, {**AFFINE_CONVENTION, **conventions}
    members = [{"preset": m.config.preset, "seed": m.config.seed, "steps": m.step} for m in loaded.members]
    scored = score_views(loaded, scene.test, each, partial(image_metrics, more=more))
    record = metrics_record(
        {view.name: view.metrics for view in scored},
        scene=scene.name,
        protocol=scene.protocol,
        builtin=scene.builtin,
        seed=loaded.config.seed,
        steps=loaded.step,
        seconds={"test": work_clock() - began},
        config=to_data(loaded.config),
        command=["gridreg", *sys.argv[1:]],
        train_views=scene.train.names,
        uses_alpha=scene.train.backdrop is None
        and any(run.config.train.carve for run in loaded.members or (loaded,)),
        conventions=conventions,
        trained_on=trained_on(scene.test, scene.train),
        **({"members": members} if members else {}),
    )
    if options.out is not None:
        write_json(options.out / "metrics.json", record)
        save_contact_sheet(options.out / "test.png", scored)
    print(summary(record), flush=True)
    if options.out is not None:
        write_page(options.out, scene, run=folder_of(options.checkpoint), model=loaded)
    return 0
