"""The same study by local processes and by Ray with two nodes on this machine: equal numbers, and what Ray costs.

    python benchmarks/ablation_ray.py --steps 300 --repeat 2

Both do two runs of one thread at a time. The overhead compares the time from the second to the last end of a run: both
workers are warm: neither imports nor compiling count. The result goes to
benchmarks/results/ablation.jsonl. Exit status 1 if any number differs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

import stored

from gridreg.ablation import Processes, RayRunner, Store
from gridreg.ablation.ray_cluster import import_ray
from gridreg.ablation.records import Study
from gridreg.ablation.runners import Event, Runner
from gridreg.ablation.study import study_from_text
from gridreg.training.versions import versions

ROOT = Path(__file__).parents[1]
STUDY = "size: 100\nsteps: {steps}\nseeds: {seeds}\ncompositions: [tensorf, quick]\n"
WARM = 2


def timed(runner: Runner, study: Study, folder: Path) -> dict:
    """Do the study; seconds of all of it, and of what comes after the first runs of both workers."""
    store = Store.open(folder)
    store.add(study)
    ends: list[float] = []

    def report(event: Event) -> None:
        if event.kind == "done":
            ends.append(time.monotonic())

    began = time.monotonic()
    runner.run(store, study, report)
    total = time.monotonic() - began
    # The store has the moments themselves; reports may come late.
    attempts = sorted(a["ended"] for a in store.attempts() if a["outcome"] == "done")
    return {
        "seconds": total,
        "seconds_warm": attempts[-1] - attempts[WARM - 1],
        "run_seconds": sum(r.seconds for r in store.results(study)),
        "images": {r.spec.hash: r.metrics["images"] for r in store.results(study) if r.metrics},
        "ends": len(ends),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=4, help="runs are twice as many")
    parser.add_argument("--repeat", type=int, default=2)
    arguments = parser.parse_args()
    import_ray()
    from ray.cluster_utils import Cluster

    study = study_from_text(
        STUDY.format(steps=arguments.steps, seeds=list(range(arguments.seeds))), name="ray"
    )
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    rounds: dict[str, list[dict]] = {"processes": [], "ray": []}
    try:
        with tempfile.TemporaryDirectory() as folder:
            for number in range(arguments.repeat):
                # In turns, because a busy machine changes over minutes.
                for name, runner in (
                    ("processes", Processes(workers=2, threads=1)),
                    ("ray", RayRunner(address=cluster.address, workers=2, threads=1)),
                ):
                    rounds[name].append(timed(runner, study, Path(folder) / f"{name}{number}"))
                    print(name, {k: v for k, v in rounds[name][-1].items() if k != "images"}, flush=True)
    finally:
        cluster.shutdown()
    images = [entry.pop("images") for entries in rounds.values() for entry in entries]
    median = {name: statistics.median(e["seconds_warm"] for e in entries) for name, entries in rounds.items()}
    record = {
        "runs": len(study.hashes),
        "steps": arguments.steps,
        "equal_numbers": all(other == images[0] for other in images),
        "overhead_percent": 100 * (median["ray"] / median["processes"] - 1),
        "rounds": rounds,
        "versions": versions(),
    }
    stored.save("ablation", "ray", record)
    print(json.dumps({key: record[key] for key in ("runs", "steps", "equal_numbers", "overhead_percent")}))
    return 0 if record["equal_numbers"] else 1


if __name__ == "__main__":
    sys.exit(main())
