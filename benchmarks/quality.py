"""Score presets and compositions on real scenes, one JSON file a run.

    python benchmarks/quality.py --data DIR --scenes lego chair --runs quick quick:tensorf quick:few_tensorf --seeds 0

A run is PRESET or PRESET:COMPOSITION. Results that are stored already are not computed again. The table is printed
from the stored files: `python benchmarks/quality.py --table`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))
from speed.whole_run import Spans

from gridreg.cli import run_cli
from gridreg.ops import use_backend
from gridreg.training import StepReport, configure, execute, open_scene
from gridreg.training.checkpoint import has_checkpoint
from gridreg.training.files import write_json
from gridreg.training.options import TrainOptions

RESULTS = Path(__file__).parent / "results" / "quality"
PROTOCOL = "dietnerf8"
"""Where none is named."""


class Trained(Spans):
    """Leaves the plain path when training has ended: it would take minutes for a picture, and they are the same."""

    def step(self, report: StepReport) -> None:
        super().step(report)
        if self.run.trainer.step == self.run.trainer.settings.steps:
            use_backend("auto")


def result_path(
    scene: str, run: str, seed: int, steps: int | None, protocol: str, changes: tuple[str, ...]
) -> Path:
    length = "" if steps is None else f"-{steps}steps"
    other = "".join(f"-{change}" for change in sorted(changes)).replace("/", "_")
    return RESULTS / f"{scene}-{protocol}-{run.replace(':', '+')}{other}{length}-seed{seed}.json"


def score(
    folder: Path,
    run: str,
    seed: int,
    steps: int | None,
    protocol: str,
    backend: str,
    changes: tuple[str, ...],
    keep: Path | None = None,
    resume: bool = False,
) -> None:
    name = run if backend == "auto" else f"{run}-{backend}"
    target = result_path(folder.name, name, seed, steps, protocol, changes)
    if target.exists():
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
    scene = open_scene(config, cache=Path(tempfile.gettempdir()))
    spans = Trained(config.train)
    use_backend(backend)
    with ExitStack() as stack:
        out = stack.enter_context(tempfile.TemporaryDirectory()) if keep is None else keep / target.stem
        stopped = resume and has_checkpoint(Path(out) / "checkpoint")
        _, metrics = execute(config, scene, out, resume=stopped, watch=spans)
    if metrics is None:
        raise KeyboardInterrupt
    # Peak memory is that of the process, which may have done other runs before.
    metrics["spans"] = spans.rows
    metrics["config"] = {**metrics["config"], "scene": folder.name}
    RESULTS.mkdir(parents=True, exist_ok=True)
    metrics["run"] = run
    metrics["command"] = [
        "benchmarks/quality.py",
        "--scenes",
        folder.name,
        "--runs",
        run,
        "--seeds",
        str(seed),
        *([] if protocol == PROTOCOL else ["--protocol", protocol]),
        *([] if steps is None else ["--steps", str(steps)]),
        *([] if backend == "auto" else ["--backend", backend]),
        *(["--set", *changes] if changes else []),
    ]
    metrics["changes"] = list(changes)
    write_json(target, metrics)
    print(row(metrics), flush=True)


def row(metrics: dict) -> str:
    mean, seconds = metrics["mean"], metrics["seconds"]
    return (
        f"| {metrics['scene']} | {metrics['protocol']} | {' '.join([metrics['run'], *metrics.get('changes', [])])} "
        f"| {metrics['seed']} | {metrics['steps']} "
        f"| {mean['psnr']:.2f} | {mean['ssim_gaussian']:.4f} | {mean['ssim_uniform']:.4f} | {seconds['train']:.0f} "
        f"| {metrics['versions']['threads']} |"
    )


def table() -> None:
    print(
        "| scene | protocol | run | seed | steps | PSNR (dB) | SSIM 11x11 | SSIM 7x7 | training (s) | threads |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for path in sorted(RESULTS.glob("*.json")):
        print(row(json.loads(path.read_text())))


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder that holds the scenes")
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--runs", nargs="+", default=["quick"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="such as field.decoder=mlp")
    parser.add_argument("--protocol", default=PROTOCOL)
    parser.add_argument("--threads", type=int)
    parser.add_argument(
        "--backend", choices=("auto", "torch"), default="auto", help="torch: train by the plain path"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep the output folders of the runs here, pictures included"
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with runs that were stopped, where --keep has their folder",
    )
    parser.add_argument("--table", action="store_true", help="print what is stored, and end")
    arguments = parser.parse_args(words)
    if arguments.table:
        table()
        return 0
    if arguments.data is None:
        parser.error("--data: expected the folder that holds the scenes")
    if arguments.resume and arguments.keep is None:
        parser.error("--resume: expected the folder of the stopped runs with --keep")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for seed in arguments.seeds:
        for scene in arguments.scenes:
            for run in arguments.runs:
                folder = arguments.data / scene
                changes = tuple(arguments.set)
                score(
                    folder,
                    run,
                    seed,
                    arguments.steps,
                    arguments.protocol,
                    arguments.backend,
                    changes,
                    arguments.keep,
                    arguments.resume,
                )
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
