"""Common parts of all commands: scenes, turns, figures, tables and stored files."""

from __future__ import annotations

import argparse
import hashlib
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import stored
import torch
from stored import Record

from gridreg.errors import InputError
from gridreg.scenes import Scene
from gridreg.training import RunConfig, TrainOptions, configure, open_scene
from gridreg.training.versions import versions

STUDY = "speed"


def at_least(least: int) -> Callable[[str], int]:
    """A type of argument: an integer that is not below ``least``."""

    def integer(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"found {value}, expected at least {least}")
        return value

    return integer


count = at_least(1)


def add_scene_arguments(parser: argparse.ArgumentParser, preset: str) -> None:
    group = parser.add_argument_group("scene and configuration")
    group.add_argument(
        "--scene", type=Path, metavar="DIR", help="scene folder; without one, the built-in scene"
    )
    group.add_argument("--protocol", metavar="NAME", help="views by name; default: by the scene's format")
    group.add_argument("--preset", default=preset, metavar="NAME", help="default: %(default)s")
    group.add_argument("--seed", type=int, default=0)
    group.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="such as train.rays=2048")


def configuration(arguments: argparse.Namespace, steps: int | None = None) -> RunConfig:
    """The preset with what the command line changes.

    Raises:
        InputError: for unknown names and values out of range.
    """
    return configure(
        TrainOptions(
            scene=arguments.scene,
            protocol=arguments.protocol,
            preset=arguments.preset,
            seed=arguments.seed,
            steps=steps,
            set=tuple(arguments.set),
        )
    )


def scene_of(config: RunConfig, *, test: Sequence[int] | None = None) -> Scene:
    """The scene of a configuration; the built-in one is drawn once for all benchmarks."""
    return open_scene(config, cache=stored.SCENES, test=test)


def in_turns(
    contestants: dict[str, Callable[[int], object]], repeats: int, warm_up: int = 2
) -> dict[str, list[float]]:
    """Seconds of each contestant in each turn; who begins changes from turn to turn.

    Args:
        contestants: functions of the number of the turn.
        repeats: turns that are measured.
        warm_up: turns before them, with the numbers from 0 on as well.
    """
    times: dict[str, list[float]] = {name: [] for name in contestants}
    names = list(contestants)
    for turn in range(warm_up):
        for run in contestants.values():
            run(turn)
    for turn in range(repeats):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            began = time.perf_counter()
            contestants[name](turn)
            times[name].append(time.perf_counter() - began)
    return times


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median and quartiles."""
    low, high = min(values), max(values)
    if len(values) > 1:
        low, _, high = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": statistics.median(values), "quarter": low, "three_quarters": high}


def ratios(times: dict[str, list[float]], base: str) -> dict[str, dict[str, float]]:
    """Return the ratios of every other contestant to ``base``, turn by turn."""
    return {
        name: spread([a / b for a, b in zip(values, times[base], strict=True)])
        for name, values in times.items()
        if name != base
    }


def medians(times: dict[str, list[float]]) -> dict[str, float]:
    return {name: statistics.median(values) for name, values in times.items()}


def plain_arguments(arguments: argparse.Namespace) -> Record:
    """The arguments without places on this machine: of folders, the name alone."""
    kept = {}
    for name, value in vars(arguments).items():
        if name in ("command", "results", "measure", "show", "name"):
            continue
        kept[name] = value.resolve().name if isinstance(value, Path) else value
    return kept


def record_of(arguments: argparse.Namespace, figures: Record) -> Record:
    """Return what is stored: figures, arguments, versions and machine."""
    return {
        "benchmark": f"speed {arguments.command}",
        "command": arguments.command,
        "arguments": plain_arguments(arguments),
        "threads": torch.get_num_threads(),
        "versions": versions(),
        **figures,
    }


def scene_name(arguments: argparse.Namespace) -> str:
    return "builtin" if arguments.scene is None else Path(arguments.scene).resolve().name


def setting(arguments: argparse.Namespace) -> str:
    """Scene, preset and changes, for names of files and titles."""
    changes = "".join(f"-{change}" for change in sorted(arguments.set)).replace("/", "_")
    if len(changes) > 80:
        # Names of files end at 255 bytes; the changes themselves are stored among the arguments.
        changes = f"-{len(arguments.set)}changes-{hashlib.sha256(changes.encode()).hexdigest()[:8]}"
    return f"{scene_name(arguments)}-{arguments.preset}{changes}"


def store(arguments: argparse.Namespace, record: Record, label: str) -> None:
    """Store a record under its command, what was measured, and the number of threads.

    Raises:
        InputError: if the place is not writable.
    """
    parts = [arguments.command, *([label] if label else []), f"{record['threads']}threads"]
    stored.save(STUDY, "-".join(parts), record, arguments.results)


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; the first column is aligned left, numbers to the right."""
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join(lines)


def ms(seconds: float) -> str:
    """Milliseconds with three digits that count."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def percent(fraction: float) -> str:
    return f"{100 * fraction:.0f} %"


def title(record: Record) -> str:
    """One line on where a record is from."""
    machine = record["versions"]
    return (
        f"{machine['cpu']}, {record['threads']} of {machine['cores']} cores, {machine['instructions']}, "
        f"torch {machine['torch']}"
    )


def situation_line(record: Record, one: Record) -> str:
    """Return a line on what was measured in a situation."""
    return (
        f"**{one['situation']}**: {record['scene']}, {record['preset']}, {one['rays']} rays with "
        f"{one['density_samples_per_ray']:.1f} density and {one['colour_samples_per_ray']:.1f} colour samples each."
    )


def existing_folder(path: Path, option: str) -> Path:
    """Raise a readable error unless ``path`` is a folder."""
    if not path.is_dir():
        raise InputError(f"{option} {path}: no such folder; expected an existing one")
    return path
