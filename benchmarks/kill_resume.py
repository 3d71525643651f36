"""Kill a training at random moments with SIGKILL, resume it each time, and compare its end with an uninterrupted run.

    python benchmarks/kill_resume.py --kills 10

Trains the built-in scene; the result goes to benchmarks/results/kill_resume.jsonl. Exit status 1 if any number differs.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import safetensors.torch
import stored
import torch

from gridreg.training.versions import versions

ROOT = Path(__file__).parents[1]
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def command(out: Path, steps: int, resume: bool) -> list[str]:
    return [
        sys.executable,
        str(ROOT / "examples" / "few_tensorf_blender.py"),
        *("--out", str(out), "--steps", str(steps), "--threads", "1", "--no-mesh", "--no-video"),
        *("--set", "train.checkpoint_minutes=0.02", "train.voxels_end=262144"),
        *(["--resume"] if resume else []),
    ]


def tensors(out: Path) -> dict[str, torch.Tensor]:
    return safetensors.torch.load_file(out / "checkpoint" / "tensors.safetensors")


def differences(whole: Path, broken: Path) -> tuple[list[str], bool]:
    """Names of the tensors that differ, and whether the metrics of all images are equal."""
    one, two = tensors(whole), tensors(broken)
    different = sorted(
        k for k in {*one, *two} if k not in one or k not in two or not torch.equal(one[k], two[k])
    )
    scores = [json.loads((out / "metrics.json").read_text())["images"] for out in (whole, broken)]
    return different, scores[0] == scores[1]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        run = {"cwd": folder, "capture_output": True, "text": True}
        # Kernels are compiled and the scene is made before anything is timed.
        subprocess.run(command(Path(folder) / "warm", 5, False), check=True, **run)
        whole = Path(folder) / "whole"
        began = time.monotonic()
        subprocess.run(command(whole, arguments.steps, False), check=True, **run)
        span = time.monotonic() - began
        moments: list[float] = []
        ended: list[Path] = []
        broken = Path(folder) / "broken0"
        while True:
            resume = (broken / "checkpoint").exists()
            last = len(moments) == arguments.kills
            wait = None if last else rng.uniform(0.1, 0.6) * span
            process = subprocess.Popen(
                command(broken, arguments.steps, resume), text=True, **PIPES, cwd=folder
            )
            try:
                _, complaint = process.communicate(timeout=wait)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.communicate()
                moments.append(round(wait or 0.0, 2))
                print(f"kill {len(moments)} after {wait:.1f} s", flush=True)
                continue
            if process.returncode:
                print(complaint, file=sys.stderr)
                return 1
            # It came to its end: compare it, and begin anew if there are kills left.
            ended.append(broken)
            if last:
                break
            broken = Path(folder) / f"broken{len(ended)}"
        results = [differences(whole, out) for out in ended]
        record = {
            "kills": len(moments),
            "seconds_before_each": moments,
            "steps": arguments.steps,
            "runs_compared": len(ended),
            "tensors_compared": len(tensors(whole)),
            "tensors_that_differ": sorted({name for names, _ in results for name in names}),
            "metrics_equal": all(equal for _, equal in results),
            "versions": versions(),
        }
    stored.save("kill_resume", "kill_resume", record)
    shown = ("kills", "runs_compared", "tensors_compared", "tensors_that_differ", "metrics_equal")
    print(json.dumps({key: record[key] for key in shown}))
    return 0 if record["metrics_equal"] and not record["tensors_that_differ"] else 1


if __name__ == "__main__":
    sys.exit(main())
