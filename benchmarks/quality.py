"""Score presets and compositions on real scenes, one record a run in benchmarks/results/quality.jsonl.

    python benchmarks/quality.py --data DIR --scenes lego chair --runs quick quick:tensorf quick:few_tensorf --seeds 0

A run is PRESET or PRESET:COMPOSITION; with --opaque it sees nothing of the alpha, and is called RUN-opaque. Results
that are stored already are not computed again. `docs/make_results.py` makes tables of them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import stored
import torch
from timing.whole_run import Spans

from gridreg.cli import run_cli
from gridreg.errors import InputError
from gridreg.ops import use_backend
from gridreg.scenes import Scene, Views
from gridreg.training import StepReport, configure, execute, open_scene
from gridreg.training.checkpoint import has_checkpoint
from gridreg.training.options import TrainOptions
from gridreg.training.record import summary

STUDY = "quality"
PROTOCOL = "dietnerf8"
"""The protocol where none is named."""


class Trained(Spans):
    """Leaves the plain path when training has ended: it would take minutes for an image, and they are the same."""

    def step(self, report: StepReport) -> None:
        super().step(report)
        if self.run.trainer.step == self.run.trainer.settings.steps:
            use_backend("auto")


def record_name(
    scene: str, run: str, seed: int, steps: int | None, protocol: str, changes: Sequence[str]
) -> str:
    length = "" if steps is None else f"-{steps}steps"
    other = "".join(f"-{change}" for change in sorted(changes)).replace("/", "_")
    return f"{scene}-{protocol}-{run.replace(':', '+')}{other}{length}-seed{seed}"


def kept_run(folder: Path, scene: str, run: str, seed: int, protocol: str) -> Path:
    """Return the output folder of a run that is kept in a folder.

    Raises:
        InputError: if it is not there.
    """
    found = folder / record_name(scene, run, seed, None, protocol, ())
    if not (found / "metrics.json").is_file():
        raise InputError(f"{found}: found no finished run, expected what benchmarks/quality.py --keep leaves")
    return found


def on_paper(scene: Scene) -> Scene:
    """Return the scene as opaque images on its background: nothing of the alpha is left."""

    def flat(views: Views) -> Views:
        rgb = views.composited(scene.background)
        return replace(views, pixels=torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=-1))

    validation = None if scene.validation is None else flat(scene.validation)
    return replace(scene, train=flat(scene.train), test=flat(scene.test), validation=validation)


def score(folder: Path, run: str, seed: int, arguments: argparse.Namespace) -> None:
    """Train and score one run, and store it, unless it is stored already."""
    steps, protocol, changes = arguments.steps, arguments.protocol, tuple(arguments.set)
    shown = run if arguments.backend == "auto" else f"{run}-{arguments.backend}"
    shown += "-opaque" if arguments.opaque else ""
    name = record_name(folder.name, shown, seed, steps, protocol, changes)
    if stored.find(STUDY, name, arguments.results):
        return
    preset, _, composition = run.partition(":")
    options = TrainOptions(
        scene=folder,
        protocol=protocol,
        preset=preset,
        composition=composition or None,
        seed=seed,
        steps=steps,
        set=changes,
    )
    config = configure(options)
    scene = open_scene(config, cache=stored.SCENES)
    scene = on_paper(scene) if arguments.opaque else scene
    spans = Trained(config.train)
    use_backend(arguments.backend)
    with ExitStack() as stack:
        keep = arguments.keep
        out = Path(stack.enter_context(tempfile.TemporaryDirectory())) if keep is None else keep / name
        stopped = arguments.resume and has_checkpoint(out / "checkpoint")
        _, metrics = execute(config, scene, out, resume=stopped, watch=spans)
    if metrics is None:
        raise KeyboardInterrupt
    command = ["benchmarks/quality.py", "--scenes", folder.name, "--runs", run, "--seeds", str(seed)]
    command += [] if protocol == PROTOCOL else ["--protocol", protocol]
    command += [] if steps is None else ["--steps", str(steps)]
    command += [] if arguments.backend == "auto" else ["--backend", arguments.backend]
    command += ["--opaque"] if arguments.opaque else []
    command += ["--set", *changes] if changes else []
    # Peak memory among the spans is that of the process, which may have done other runs before.
    metrics |= {
        "spans": spans.rows,
        "run": shown if arguments.opaque else run,
        "command": command,
        "changes": list(changes),
    }
    metrics["config"] = {**metrics["config"], "scene": folder.name}
    stored.save(STUDY, name, metrics, arguments.results)
    print(f"{name}: {summary(metrics)}; trained in {metrics['seconds']['train']:.0f} s", flush=True)


def main(words: Sequence[str] | None = None) -> int:
    parser = stored.parser_of(__doc__, threads=True)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the scenes")
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--runs", nargs="+", default=["quick"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="such as field.decoder=mlp")
    parser.add_argument("--protocol", default=PROTOCOL)
    parser.add_argument(
        "--backend", choices=("auto", "torch"), default="auto", help="torch: train by the plain path"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep the output folders of the runs here, images included"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with stopped runs, where --keep has their folder"
    )
    parser.add_argument(
        "--opaque", action="store_true", help="without alpha: the images on the protocol's background"
    )
    arguments = parser.parse_args(words)
    if arguments.resume and arguments.keep is None:
        parser.error("--resume: expected the folder of the stopped runs with --keep")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for seed in arguments.seeds:
        for scene in arguments.scenes:
            for run in arguments.runs:
                score(arguments.data / scene, run, seed, arguments)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
