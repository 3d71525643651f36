"""Kill a training at random moments with SIGKILL, resume it each time, and compare its end with an uninterrupted run.

    python benchmarks/kill_resume.py --kills 10

Trains the built-in scene; the result goes to benchmarks/results/kill_resume.json. Exit status 1 if any number differs.
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
import torch

from gridreg.training.files import write_json
from gridreg.training.versions import versions

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "kill_resume.json"


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
        whole, broken = Path(folder) / "whole", Path(folder) / "broken"
        run = {"cwd": folder, "capture_output": True, "text": True}
        began = time.monotonic()
        subprocess.run(command(whole, arguments.steps, False), check=True, **run)
        span = time.monotonic() - began
        moments: list[float] = []
        while len(moments) < arguments.kills:
            resume = (broken / "checkpoint").exists()
            wait = rng.uniform(0.15, 0.75) * span
            process = subprocess.Popen(
                command(broken, arguments.steps, resume), cwd=folder, stderr=subprocess.PIPE, text=True
            )
            try:
                process.wait(wait)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.communicate()
                moments.append(round(wait, 2))
                continue
            # It came to its end before the moment: start over, so that every kill hits a living run.
            process.communicate()
            broken = Path(folder) / f"broken{len(moments)}"
        resume = (broken / "checkpoint").exists()
        subprocess.run(command(broken, arguments.steps, resume), check=True, **run)
        one, two = tensors(whole), tensors(broken)
        different = sorted(
            k for k in {*one, *two} if k not in one or k not in two or not torch.equal(one[k], two[k])
        )
        scores = [json.loads((out / "metrics.json").read_text())["images"] for out in (whole, broken)]
        record = {
            "kills": len(moments),
            "seconds_before_each": moments,
            "steps": arguments.steps,
            "tensors_compared": len(one),
            "tensors_that_differ": different,
            "metrics_equal": scores[0] == scores[1],
            "versions": versions(),
        }
    write_json(RESULT, record)
    print(
        json.dumps(
            {k: record[k] for k in ("kills", "tensors_compared", "tensors_that_differ", "metrics_equal")}
        )
    )
    return 0 if not different and record["metrics_equal"] else 1


if __name__ == "__main__":
    sys.exit(main())
