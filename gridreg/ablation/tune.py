"""``gridreg tune``: choose strengths of regularizers for a scene by its training views alone.

Every training view is left out in turn, and predicted from the others. Variations of the preset race: all are tried
on the first views, and whoever is behind is dropped before the next. One is taken only if its gain exceeds its
standard error, else the preset stays. The test views are never read.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gridreg.ablation.command import AblationOptions, make_runner
from gridreg.ablation.comparison import figure_of
from gridreg.ablation.edits import Plain
from gridreg.ablation.progress import StudyProgress
from gridreg.ablation.racing import FEWEST, race, table
from gridreg.ablation.records import Study
from gridreg.ablation.store import Store
from gridreg.ablation.study import check_fits, run_of
from gridreg.compositions.plain_data import to_config
from gridreg.errors import ConfigError, InputError
from gridreg.machine import usable_cores
from gridreg.scenes import builtin_scene, default_protocol
from gridreg.scenes.load import training_views
from gridreg.training.config import save_yaml
from gridreg.training.options import TrainOptions, configure
from gridreg.training.run import regularizers_of
from gridreg.training.settings import RunConfig


@dataclass
class TuneOptions:
    """Choose strengths of regularizers for a scene by leaving out its training views one by one."""

    out: Path
    """Folder for the trials and tuned.yaml; the same command goes on from what is there."""
    scene: Path | None = None
    """Scene folder (Blender, transforms.json, COLMAP, LLFF); without one, the built-in scene."""
    preset: str = "quick"
    """Field, schedule and regularizers to start from, by name."""
    protocol: str | None = None
    """Views by name; default: by the scene's format, as in `gridreg train`."""
    size: int | None = None
    """Width of the images in pixels; default: the protocol's."""
    opaque: bool = False
    """Take images without alpha as opaque."""
    set: tuple[str, ...] = ()
    """Any other value of the configuration, such as train.rays=2048."""
    minutes: float = 10.0
    """Budget; what has begun by then is finished."""
    views: int = 8
    """Left out at most."""
    steps: int | None = None
    """Iterations of a trial; default: two fifths of the preset's."""
    seed: int = 0
    """Of every random number."""
    runner: Literal["local", "processes", "ray"] = "processes"
    """Where the trials run."""
    workers: int | None = None
    """Trials at a time; default: as many as the cores hold."""
    threads: int | None = None
    """Processor threads of each trial; default: all with `local`, 1 otherwise."""


def run(options: TuneOptions) -> int:
    """Race, and write ``tuned.yaml``; 130 after Ctrl-C.

    Raises:
        InputError: for anything that a user can mend.
    """
    if not 0 < options.minutes < math.inf:
        raise InputError(f"--minutes: found {options.minutes}, expected a positive number")
    if options.views < FEWEST:
        raise InputError(f"--views: found {options.views}, expected at least {FEWEST}")
    folder = options.scene or builtin_scene(Path("outputs"))
    whole = configure(
        TrainOptions(
            scene=folder,
            protocol=options.protocol or default_protocol(folder),
            size=options.size,
            opaque=options.opaque,
            preset=options.preset,
            seed=options.seed,
            set=options.set,
        )
    )
    plain = to_config(regularizers_of(whole))
    views = training_views(folder, str(whole.protocol))
    if views <= FEWEST:
        raise InputError(
            f"{folder}: {whole.protocol} has {views} training views, expected more than {FEWEST}"
        )
    runner = make_runner(
        AblationOptions(
            runner=options.runner, workers=options.workers, threads=options.threads, keep_checkpoints=False
        )
    )
    store = Store.open(options.out)
    steps = options.steps or max(1, whole.train.steps * 2 // 5)
    short = dataclasses.replace(whole, train=whole.train.scaled(steps))
    beside = 1 if options.runner == "local" else options.workers or usable_cores() // (options.threads or 1)
    began, each = time.monotonic(), 0.0
    print(
        f"{folder.name}, {whole.protocol}: {views} training views, left out one at a time; trials of "
        f"{steps} iterations, {options.minutes:g} minutes; the store is {options.out}",
        file=sys.stderr,
        flush=True,
    )

    def trial(rows: Mapping[str, Plain], left_out: Sequence[int]) -> dict[tuple[str, int], float]:
        nonlocal each
        study = _study(short, rows, left_out)
        store.add(study)
        before = time.monotonic()
        runner.run(store, study, StudyProgress(store.results(study)))
        results = store.results(study)
        each = (time.monotonic() - before) * beside / max(beside, len(results))
        for result in results:
            if result.status == "failed":
                raise InputError(f"{result.spec.describe()}: {result.reason}")
        return {
            (r.spec.label, int(r.spec.protocol.rpartition("-leave")[2])): psnr
            for r in results
            if (psnr := figure_of(r, "psnr")) is not None
        }

    def affordable(trials: int) -> int:
        left = began + 60 * options.minutes - time.monotonic()
        return min(trials, int(max(0.0, left) * beside / max(each, 1e-9)))

    try:
        outcome = race(plain, min(views, options.views), trial, affordable)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return 130
    gains, winner = outcome.gains, outcome.winner
    print(table(gains))
    if winner is not None:
        said = f"chosen: {winner.label}, {winner.mean:+.2f} dB (standard error {winner.error:.2f})"
    elif max((len(gain.values) for gain in gains), default=0) < FEWEST:
        said = f"the preset stays: --minutes {options.minutes:g} did not reach {FEWEST} views; expected more"
    else:
        said = "the preset stays: no variation gains more than its standard error"
    file = options.out / "tuned.yaml"
    save_yaml(
        file, dataclasses.replace(whole, composition=outcome.composition), comment=f"gridreg tune: {said}."
    )
    print(f"{said}\ntrain with it: gridreg train --config {file}")
    return 0


def _study(config: RunConfig, rows: Mapping[str, Plain], views: Sequence[int]) -> Study:
    """The trials as a study: a row for each composition that can be attached, a protocol for each view."""
    runs = []
    for label, plain in rows.items():
        for view in views:
            protocol = f"{config.protocol}-leave{view}"
            own = dataclasses.replace(config, protocol=protocol, composition=plain)
            with contextlib.suppress(ConfigError):
                check_fits(label, own)
                runs.append(run_of(label, own, size=config.size))
    name = f"tune-{views[0]}" if len(rows) > 1 else "tune-together"
    title = f"{len(rows)} variations with views {', '.join(map(str, views))} left out"
    return Study(name, title, next(iter(rows)), tuple(runs), "")
