"""Kills at named moments, full disks, signals and two writers: nothing is lost, and the end is the same bit for bit.

    python benchmarks/faults.py --kills 100
    python benchmarks/faults.py --only disks signals writers

A tiny run of the built-in scene (train, mesh, video) and a tiny study are done once without a fault; every moment in
them is written down by name: before and after each rename, folder and file of a save, in the middle of each write, and
each stage (iterations, events, saves, scoring, curves, metrics, mesh, video, the claims and results of the study). Then
the process is killed (SIGKILL, by itself, at one of these moments), what it has left is read, the same command goes on,
and its end is compared with the run that nobody killed: all tensors and generators of the checkpoint, the metrics, the
curves, the renders, mesh and video, byte by byte but for seconds, dates and commands. Half of the moments are in saves
and renames, spread over all names there are. ``disks``: a tmpfs that has so many KB left (it takes root); elsewhere the
largest size of a file is bounded (RLIMIT_FSIZE), which is no full disk, and is stored as such. ``signals``: INT, TERM
and HUP in the middle of training. ``writers``: two processes at a time into one folder. The result goes to
benchmarks/results/faults.jsonl; exit status 1 if anything was lost or differs.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import stored
import torch
from timing.moments import Moments
from timing.trial import (
    Trial,
    end_of_run,
    end_of_study,
    in_child,
    small_disk,
    small_drawings,
    what_stands,
)

from gridreg.cli import main as gridreg_main
from gridreg.scenes import builtin_scene
from gridreg.training.checkpoint import has_checkpoint
from gridreg.training.versions import versions

Keep = Callable[[dict[str, Any]], None]
SIZE = 24
STEPS = 12
SETTINGS = {
    "train.rays": 32,
    "train.voxels_start": 1000,
    "train.voxels_end": 4096,
    "train.resample_at": [4],
    "train.occupancy_at": [3, 6],
    "train.occupancy_every": 0,
    "train.occupancy_resolution": 12,
    "train.shrink_at": [6],
    "train.filter_rays_at": [7],
    "train.evaluate_at": [8],
    # A save at every iteration: the order of moments is the same in every run.
    "train.checkpoint_minutes": 1e-9,
    "field.density_components": 2,
    "field.appearance_components": 3,
}
STUDY = f"""title: Killed and gone on with
size: {SIZE}
test: [0]
set: {json.dumps(SETTINGS | {"train.steps": 3, "train.evaluate_at": []})}
compositions: [none, quick]
"""


def small_scene(folder: Path) -> Path:
    """Make the built-in scene with three of its test views."""
    scene = builtin_scene(folder, size=SIZE).rename(folder / "scene")
    (scene / "builtin.json").unlink()
    listed = json.loads((scene / "transforms_test.json").read_text())
    listed["frames"] = listed["frames"][:3]
    (scene / "transforms_test.json").write_text(json.dumps(listed))
    return scene


def train_command(out: Path, scene: Path) -> list[str]:
    """Return the words of the tiny training."""
    values = [f"{key}={json.dumps(value)}" for key, value in SETTINGS.items()]
    chosen = ["--steps", str(STEPS), "--threads", "1", "--protocol", "first8"]
    resumed = ["--resume"] if has_checkpoint(out / "checkpoint") else []
    return ["train", "--scene", str(scene), "--out", str(out), *chosen, *resumed, "--set", *values]


def study_command(out: Path, study: Path) -> list[str]:
    """Return the words of the tiny study."""
    return ["ablate", str(study), "--out", str(out), "--threads", "1"]


def chosen(moments: list[tuple[str, ...]], kind: str, count: int, rng: random.Random) -> list[int]:
    """Return moments of a kind, spread over their names: the first of each, then others at random."""
    places = [number for number, (of, _) in enumerate(moments) if of == kind]
    rng.shuffle(places)
    seen: Counter[str] = Counter()
    order = []
    for number in places:
        order.append((seen[moments[number][1]], number))
        seen[moments[number][1]] += 1
    return [number for _, number in sorted(order)[:count]]


def kills(trials: list[Trial], count: int, rng: random.Random, keep: Keep) -> dict[str, Any]:
    """Kill runs and studies in turns, half of the times in saves and renames; each kill is kept at once."""
    distinct = {(trial.name, name) for trial in trials for _, name in trial.moments}
    record: dict[str, Any] = {"kills": 0, "of": {}, "named_moments": len(distinct), "faults": []}
    plan: list[tuple[float, Trial, str, int]] = []
    for trial, part in zip(trials, (0.7, 0.3), strict=True):
        for kind in ("save", "stage"):
            numbers = chosen(trial.moments, kind, round(count * part / 2), rng)
            plan += [(place / len(numbers), trial, kind, number) for place, number in enumerate(numbers)]
    for _, trial, kind, number in sorted(plan, key=lambda one: one[0]):
        name = f"{trial.name}: {' '.join(trial.moments[number])}"
        record["kills"] += 1
        record["of"][f"{trial.name} {kind}"] = record["of"].get(f"{trial.name} {kind}", 0) + 1
        record["faults"] += told(f"{record['kills']}/{len(plan)} {name}", trial.kill(number))
        keep(record)
    return record


def told(name: str, fault: str) -> list[str]:
    """Print what became of a trial, and return it if it is a fault."""
    line = f"{name}: {fault or 'the same'}"
    print(line, flush=True)
    return [line] if fault else []


def kilobytes_of(folder: Path) -> int:
    """Return what a folder takes on a disk of pages of 4 KB."""
    return sum(4 * -(-path.stat().st_size // 4096) for path in folder.rglob("*") if path.is_file())


def disks(trial: Trial) -> dict[str, Any]:
    """Let the disk be full at several moments, give it space, and go on."""
    whole = trial.folder / "whole"
    saved, all_of_it = kilobytes_of(whole / "checkpoint"), kilobytes_of(whole)
    # Within the first save, the second, and then in what is written after the training.
    sizes = [saved // 5, saved // 2, saved * 3 // 2, saved * 19 // 10]
    sizes += [saved + all_of_it * part // 10 for part in (2, 4, 6, 7, 8, 9)]
    faults: list[str] = []
    kinds = Counter[str]()
    for kilobytes in sizes:
        disk = trial.folder / "disk"
        with small_disk(disk, 16_000) as kind:
            kinds[kind] += 1
            out, filler = disk / "run", disk / "filler"
            shutil.rmtree(out, ignore_errors=True)
            if kind == "tmpfs":
                filler.write_bytes(bytes(1024 * (16_000 - kilobytes)))

            def act(bound: int = kilobytes, kind: str = kind, out: Path = out) -> int:
                if kind != "tmpfs":
                    import resource

                    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * bound // 16, resource.RLIM_INFINITY))
                small_drawings()
                return gridreg_main(trial.words(out))

            log = trial.folder / f"disk-{kilobytes}.txt"
            status = in_child(act, log)
            text = log.read_text(errors="replace")
            said = [line for line in text.splitlines() if line.startswith("error: ")]
            fault = what_stands(out) if out.is_dir() else ""
            if "Traceback" in text or status not in (0, 2) or (status == 2 and len(said) != 1):
                fault = f"exit status {status}, said {text[-300:]!r}"
            filler.unlink(missing_ok=True)
            faults += told(f"{kilobytes} KB left: {said or status}", fault or trial.go_on(out))
    return {"disks": dict(kinds), "kilobytes_left": sizes, "faults": faults}


def signals(trial: Trial) -> dict[str, Any]:
    """Send each signal at three iterations; the run saves, ends as it should, and goes on."""
    faults: list[str] = []
    tried = 0
    places = [n for n, (_, name) in enumerate(trial.moments) if name == "iteration"]
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        for moment in places[1 : len(places) - 1 : len(places) // 3]:
            out = trial.folder / "signalled"
            shutil.rmtree(out, ignore_errors=True)

            def act(moment: int = moment, name: str = name, out: Path = out) -> int:
                small_drawings()
                Moments(out, None, moment, signal.Signals[name]).install()
                return gridreg_main(trial.words(out))

            status = in_child(act, trial.log)
            fault = "" if status == 130 and has_checkpoint(out / "checkpoint") else f"exit status {status}"
            tried += 1
            faults += told(f"{name} at moment {moment}", fault or trial.go_on(out))
    return {"signals": tried, "faults": faults}


def writers(trial: Trial) -> dict[str, Any]:
    """Start two at a time into one folder: one is refused in a line, the other ends as if it were alone."""
    whole, faults = trial.folder / "whole", list[str]()
    pairs: dict[str, Callable[[Path], list[str]]] = {
        "train": trial.words,
        "eval": lambda out: ["eval", str(whole), "--out", str(out)],
        "ensemble": lambda out: ["ensemble", str(whole), str(whole), "--out", str(out)],
    }
    for name, words in pairs.items():
        out = trial.folder / f"two-{name}"
        gate = trial.folder / f"gate-{name}"

        def first(words: Callable[[Path], list[str]] = words, out: Path = out, gate: Path = gate) -> int:
            small_drawings()
            # It has proved that the folder can be written to, in five moments, and waits until the other one has ended.
            Moments(out, None, 5, wait_for=gate).install()
            return gridreg_main(words(out))

        holder = os.fork()
        if holder == 0:
            os._exit(in_child(first, trial.folder / f"first-{name}.txt"))
        end = time.monotonic() + 120
        while not gate.with_suffix(".reached").exists() and time.monotonic() < end:
            time.sleep(0.05)
        log = trial.folder / f"second-{name}.txt"
        status = in_child(lambda words=words, out=out: gridreg_main(words(out)), log)  # type: ignore[misc]
        gate.touch()
        ended = os.waitstatus_to_exitcode(os.waitpid(holder, 0)[1])
        text = log.read_text(errors="replace")
        fault = ""
        if status != 2 or "another run is writing here" not in text or ended != 0:
            fault = f"exit status {status} and {ended}, said {text[-200:]!r}"
        elif name == "train":
            fault = trial.compare(out)
        faults += told(f"two of {name}", fault)
    return {"pairs": sorted(pairs), "faults": faults}


def main() -> int:
    """Do what was asked for, store the result, and return 1 if there was a fault."""
    parser = stored.parser_of(__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--only", nargs="*", default=["kills", "disks", "signals", "writers"])
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    torch.set_num_threads(1)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # Under nohup it is ignored, and a run rightly leaves it so.
    faults = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chdir(folder)
        scene = small_scene(folder)
        (folder / "study.yaml").write_text(STUDY)
        for place in (places := [folder / "train", folder / "study"]):
            place.mkdir()
        train = Trial("train", places[0], lambda out: train_command(out, scene), end_of_run)
        parts: dict[str, Callable[[Keep], dict[str, Any]]] = {
            "disks": lambda _: disks(train),
            "signals": lambda _: signals(train),
            "writers": lambda _: writers(train),
        }
        if "kills" in options.only:
            study = Trial(
                "study", places[1], lambda out: study_command(out, folder / "study.yaml"), end_of_study
            )
            parts["kills"] = lambda keep: kills(
                [train, study], options.kills, random.Random(options.seed), keep
            )
        for part in options.only:
            began = time.monotonic()

            def keep(record: dict[str, Any], part: str = part, began: float = began) -> None:
                seconds = round(time.monotonic() - began)
                more = {"seed": options.seed, "seconds": seconds, "versions": versions()}
                name = part if not options.seed else f"{part}, seed {options.seed}"
                stored.save("faults", name, record | more, options.results)

            record = parts[part](keep)
            keep(record)
            faults += len(record["faults"])
            print(json.dumps(record), flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
