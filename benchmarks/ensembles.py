"""Score the mean of the fields of several seeds beside the seeds themselves, one record for each number of seeds.

    python benchmarks/quality.py --data DIR --scenes lego chair --runs best --seeds 0 1 2 --keep RUNS
    python benchmarks/ensembles.py --data DIR --scenes lego chair --runs best --seeds 0 1 2 --kept RUNS

Joins the first two seeds, then three, and so on, and stores them in benchmarks/results/ensembles.jsonl. What is stored
already is not computed again. `docs/make_results.py` makes a table of it.

With `--deviation`, whether the deviation of all seeds' renders tells where they are wrong, on the test views: the rank
correlation (Spearman) of deviation and true error over the pixels of each view's object (chance: 0), over all pixels,
and over whole views; stored in benchmarks/results/deviations.jsonl.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import stored
import torch
from quality import kept_run
from scipy.stats import spearmanr
from stored import Record

from gridreg.cli import run_cli
from gridreg.errors import InputError
from gridreg.scenes import Scene, load_scene
from gridreg.training import LoadedRun, load_run
from gridreg.training.evaluate import score_views
from gridreg.training.loading import ensemble_of
from gridreg.training.record import metrics_record
from gridreg.training.typed_data import to_data
from gridreg.training.versions import versions

STUDY, DEVIATIONS = "ensembles", "deviations"


def name_of(folder: Path, run: str, seeds: Sequence[int], protocol: str) -> str:
    """Return the name of a record."""
    return f"{folder.name}-{protocol}-{run.replace(':', '+')}-seeds{','.join(map(str, seeds))}"


def opened(
    folder: Path, run: str, arguments: argparse.Namespace
) -> tuple[Scene, list[LoadedRun], list[Record]]:
    """Return a scene under the protocol, the kept runs of every seed, and their metrics.

    Raises:
        InputError: if a run is not kept, or was trained on other images.
    """
    places = [kept_run(arguments.kept, folder.name, run, s, arguments.protocol) for s in arguments.seeds]
    scene, members = load_scene(folder, arguments.protocol), [load_run(place) for place in places]
    for place, member in zip(places, members, strict=True):
        if member.fingerprint != scene.fingerprint:
            raise InputError(
                f"{place}: trained on other images than those of {folder} under {scene.protocol}"
            )
    return scene, members, [json.loads((place / "metrics.json").read_text()) for place in places]


def score(folder: Path, run: str, arguments: argparse.Namespace) -> None:
    """Join the first two kept runs, then three, and so on; score each on the protocol's test views, and store it."""
    seeds, results = arguments.seeds, arguments.results
    names = {n: name_of(folder, run, seeds[:n], arguments.protocol) for n in range(2, len(seeds) + 1)}
    missing = {n: name for n, name in names.items() if not stored.find(STUDY, name, results)}
    if not missing:
        return
    scene, members, alone = opened(folder, run, arguments)
    for n, name in missing.items():
        record = joined_record(scene, run, seeds[:n], members[:n], alone[:n])
        stored.save(STUDY, name, record, results)
        print(
            f"{folder.name} {run}: seeds {','.join(map(str, seeds[:n]))} alone "
            f"{' '.join(format(one['mean']['psnr'], '.2f') for one in alone[:n])} dB, "
            f"joined {record['mean']['psnr']:.2f} dB",
            flush=True,
        )


def joined_record(
    scene: Scene, run: str, seeds: Sequence[int], members: Sequence[LoadedRun], alone: Sequence[Record]
) -> Record:
    """Return the score of loaded runs joined, beside the metrics that each of them has ``alone``."""
    joined = ensemble_of(members)
    began = time.perf_counter()
    scored = score_views(joined, scene.test)
    return metrics_record(
        {view.name: view.metrics for view in scored},
        scene=scene.name,
        protocol=scene.protocol,
        builtin=scene.builtin,
        seed=seeds[0],
        steps=joined.step,
        seconds={"test": time.perf_counter() - began, "train": sum(one["seconds"]["train"] for one in alone)},
        config={**to_data(joined.config), "scene": scene.name},
        command=f"benchmarks/ensembles.py --scenes {scene.name} --runs {run} --seeds".split()
        + [str(seed) for seed in seeds],
        train_views=scene.train.names,
        run=run,
        members=[
            {"seed": seed, "mean": one["mean"], "seconds": one["seconds"]}
            for seed, one in zip(seeds, alone, strict=True)
        ],
    )


def deviation_record(joined: LoadedRun, scene: Scene) -> Record:
    """Return the rank correlations of the members' deviation with the true error of their mean."""
    views, pixels, everywhere, means = scene.test, {}, {}, []
    targets = views.composited(joined.background)
    for i, (camera, name) in enumerate(zip(views.cameras, views.names, strict=True)):
        rendered = joined.render(camera, deviation=True)
        assert rendered is not None
        assert rendered.deviation is not None
        error, deviation = (rendered.colour - targets[i]).square().mean(-1).sqrt(), rendered.deviation
        seen = (rendered.opacity > 0.5) | (views.image(i)[..., 3] > 0.5)
        pixels[name] = float(spearmanr(deviation[seen], error[seen])[0])
        everywhere[name] = float(spearmanr(deviation.flatten(), error.flatten())[0])
        means.append([float(value.square().mean()) for value in (deviation, error)])
    return {
        "members": len(joined.members),
        "object_pixels": pixels,
        "all_pixels": everywhere,
        "views": float(spearmanr(*zip(*means, strict=True))[0]),
    }


def store_deviation(folder: Path, run: str, arguments: argparse.Namespace) -> None:
    """Store whether the deviation of all seeds together tells where they are wrong."""
    seeds = arguments.seeds
    name = name_of(folder, run, seeds, arguments.protocol)
    if stored.find(DEVIATIONS, name, arguments.results):
        return
    scene, members, _ = opened(folder, run, arguments)
    record = {
        "scene": scene.name,
        "builtin": scene.builtin,
        "protocol": scene.protocol,
        "run": run,
        "seeds": list(seeds),
        **deviation_record(ensemble_of(members), scene),
        "command": stored.command_line("benchmarks/ensembles.py"),
        "versions": versions(),
    }
    stored.save(DEVIATIONS, name, record, arguments.results)
    found = list(record["object_pixels"].values())
    print(
        f"{folder.name} {run}: rank correlation of deviation and error {sum(found) / len(found):.2f} over pixels "
        f"of the object (least {min(found):.2f} of {len(found)} views), {record['views']:.2f} over views",
        flush=True,
    )


def main(words: Sequence[str] | None = None) -> int:
    """Parse the command line and score."""
    parser = stored.parser_of(__doc__, threads=True)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the scenes")
    parser.add_argument("--kept", type=Path, required=True, help="as given to benchmarks/quality.py --keep")
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--runs", nargs="+", default=["best"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--protocol", default="dietnerf8")
    parser.add_argument(
        "--deviation", action="store_true", help="whether deviation tells where they are wrong"
    )
    arguments = parser.parse_args(words)
    if len(arguments.seeds) < 2:
        raise InputError(f"--seeds: found {len(arguments.seeds)}, expected at least two")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for scene in arguments.scenes:
        for run in arguments.runs:
            if arguments.deviation:
                store_deviation(arguments.data / scene, run, arguments)
            else:
                score(arguments.data / scene, run, arguments)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
