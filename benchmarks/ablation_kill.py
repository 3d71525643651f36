"""Kill a study of 24 small runs with SIGKILL three times, go on each time, and compare with a study left alone.

    python benchmarks/ablation_kill.py

Runs the built-in scene; the result goes to benchmarks/results/ablation.jsonl. Exit status 1 if a run ended twice or
a number differs.
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

import stored

from gridreg.ablation.store import Store
from gridreg.training.versions import versions

ROOT = Path(__file__).parents[1]
STUDY = """
title: Killed and gone on with
size: 40
test: [0, 9]
seeds: {seeds}
set:
  train.steps: {steps}
  train.rays: 256
  train.voxels_start: 8000
  train.voxels_end: 64000
  train.resample_at: [5, 10]
  train.occupancy_at: [4]
  train.occupancy_every: 0
  train.filter_rays_at: []
  train.occupancy_resolution: 24
  train.checkpoint_minutes: 0.005
compositions: [none, tensorf, quick, fourierf, composition:sanerf, {{name: quick, remove: [FrequencyMask]}}]
"""


def command(study: Path, out: Path, workers: int) -> list[str]:
    runner = ["--runner", "processes", "--workers", str(workers)] if workers > 1 else []
    program = str(ROOT / "examples" / "ablation.py")
    return [sys.executable, program, str(study), "--out", str(out), "--threads", "1", *runner]


def finished(out: Path) -> int:
    """Runs that the store has as done; none before there is a store."""
    return Store.open(out, create=False).counts()["done"] if (out / "store.sqlite").is_file() else 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=4, help="runs are six times as many")
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        study = Path(folder) / "kill.yaml"
        study.write_text(STUDY.format(seeds=list(range(arguments.seeds)), steps=arguments.steps))
        whole, broken = Path(folder) / "whole", Path(folder) / "broken"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        began = time.monotonic()
        subprocess.run(command(study, whole, arguments.workers), check=True, **quiet)
        span = time.monotonic() - began
        runs = finished(whole)
        kills = []
        for number in range(arguments.kills):
            # Spread over the study, at a moment of its own between two ends of runs.
            goal = runs * (number + 1) // (arguments.kills + 1)
            process = subprocess.Popen(command(study, broken, arguments.workers), **quiet)
            while finished(broken) < goal and process.poll() is None:
                time.sleep(0.01)
            time.sleep(rng.uniform(0, span / runs))
            alive = process.poll() is None
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills.append({"finished": finished(broken), "alive": alive})
        subprocess.run(command(study, broken, arguments.workers), check=True, **quiet)
        one, two = (Store.open(out, create=False) for out in (whole, broken))
        ended = [attempt["hash"] for attempt in two.attempts() if attempt["outcome"] == "done"]
        pairs = list(zip(one.results(), two.results(), strict=True))
        different = [a.spec.describe() for a, b in pairs if a.metrics["images"] != b.metrics["images"]]
        outcomes = [attempt["outcome"] for attempt in two.attempts()]
        record = {
            "runs": runs,
            "workers": arguments.workers,
            "kills": kills,
            "attempts": {outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))},
            "runs_that_ended_once": len(ended) == len(set(ended)) == runs,
            "runs_that_differ": different,
            "seconds_left_alone": round(span, 1),
            "versions": versions(),
        }
    stored.save("ablation", "kill", record)
    print(json.dumps({key: value for key, value in record.items() if key != "versions"}))
    all_alive = all(kill["alive"] for kill in kills)
    return 0 if record["runs_that_ended_once"] and not different and all_alive else 1


if __name__ == "__main__":
    sys.exit(main())
