"""Score the mean of the fields of several seeds beside the seeds themselves, one JSON file for each number of seeds.

    python benchmarks/quality.py --data DIR --scenes lego chair --runs best --seeds 0 1 2 --keep RUNS
    python benchmarks/ensembles.py --data DIR --scenes lego chair --runs best --seeds 0 1 2 --kept RUNS

Writes the first two seeds joined, then three, and so on, to benchmarks/results/ensembles. What is stored already is not
computed again. `docs/make_results.py` makes a table of it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parent))
from error_pictures import kept

from gridreg.cli import run_cli
from gridreg.errors import InputError
from gridreg.scenes import Scene, load_scene
from gridreg.training import LoadedRun, load_run
from gridreg.training.config import to_data
from gridreg.training.evaluate import score_views
from gridreg.training.files import write_json
from gridreg.training.loading import ensemble_of
from gridreg.training.record import metrics_record

RESULTS = Path(__file__).parent / "results" / "ensembles"


def score(folder: Path, run: str, seeds: Sequence[int], protocol: str, runs: Path, results: Path) -> None:
    """Join the first two kept runs, then three, and so on; score each on the protocol's test views, and store it.

    Raises:
        InputError: if a run is not kept, or was trained on other pictures.
    """
    counts = [
        n
        for n in range(2, len(seeds) + 1)
        if not place_of(folder.name, run, seeds[:n], protocol, results).exists()
    ]
    if not counts:
        return
    places = [kept(runs, folder.name, run, seed, protocol) for seed in seeds]
    scene = load_scene(folder, protocol)
    members = [load_run(place) for place in places]
    for place, member in zip(places, members, strict=True):
        if member.fingerprint != scene.fingerprint:
            raise InputError(f"{place}: trained on other pictures than those of {folder} under {protocol}")
    told = [json.loads((place / "metrics.json").read_text()) for place in places]
    results.mkdir(parents=True, exist_ok=True)
    for count in counts:
        record = joined_record(scene, run, seeds[:count], members[:count], told[:count])
        write_json(place_of(folder.name, run, seeds[:count], protocol, results), record)
        alone = " ".join(f"{one['mean']['psnr']:.2f}" for one in told[:count])
        print(
            f"{folder.name} {run}: seeds {','.join(map(str, seeds[:count]))} alone {alone} dB, "
            f"joined {record['mean']['psnr']:.2f} dB",
            flush=True,
        )


def place_of(scene: str, run: str, seeds: Sequence[int], protocol: str, results: Path) -> Path:
    """The file of some seeds joined."""
    return results / f"{scene}-{protocol}-{run.replace(':', '+')}-seeds{','.join(map(str, seeds))}.json"


def joined_record(
    scene: Scene, run: str, seeds: Sequence[int], members: Sequence[LoadedRun], told: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """The score of loaded runs joined, beside what each of them was ``told`` to have alone."""
    both = ensemble_of(members)
    began = time.perf_counter()
    scored = score_views(both.field, scene.test, both.occupancy, both.march, both.background)
    return metrics_record(
        {view.name: view.metrics for view in scored},
        scene=scene.name,
        protocol=scene.protocol,
        builtin=scene.builtin,
        seed=seeds[0],
        steps=both.step,
        seconds={"test": time.perf_counter() - began, "train": sum(one["seconds"]["train"] for one in told)},
        config={**to_data(both.config), "scene": scene.name},
        command=[
            "benchmarks/ensembles.py",
            "--scenes",
            scene.name,
            "--runs",
            run,
            "--seeds",
            *map(str, seeds),
        ],
        train_views=scene.train.names,
        run=run,
        members=[
            {"seed": seed, "mean": one["mean"], "seconds": one["seconds"]}
            for seed, one in zip(seeds, told, strict=True)
        ],
    )


def main(words: Sequence[str] | None = None) -> int:
    """Parse the command line and score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the scenes")
    parser.add_argument(
        "--kept", type=Path, required=True, help="folder that benchmarks/quality.py --keep has filled"
    )
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--runs", nargs="+", default=["best"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--protocol", default="dietnerf8")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    if len(arguments.seeds) < 2:
        raise InputError(f"--seeds: found {len(arguments.seeds)}, expected at least two")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for scene in arguments.scenes:
        for run in arguments.runs:
            folder = arguments.data / scene
            score(folder, run, arguments.seeds, arguments.protocol, arguments.kept, arguments.results)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
