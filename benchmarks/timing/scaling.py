"""`scaling`: how the time of a step grows with rays, grid, channels and threads."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import statistics
import subprocess
import sys
from collections.abc import Iterator

import torch

from . import common
from .ball import BallStep, ball_field, ball_rays, ball_step
from .common import Record
from .situations import threads

HELP = "how a step's time grows with rays, edge of the grid, channels and threads"


def pair(text: str) -> tuple[int, int]:
    """``16x48``: channels of density and of appearance."""
    first, cross, second = text.partition("x")
    if not cross or not first.isdecimal() or not second.isdecimal() or not int(first) or not int(second):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected DENSITYxAPPEARANCE such as 16x48")
    return int(first), int(second)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backbone", default="vm", choices=("vm", "cp"))
    parser.add_argument("--repeats", type=common.count, default=15)
    parser.add_argument(
        "--beside", type=common.at_least(0), default=0, help="busy loops that other processes run meanwhile"
    )
    base = parser.add_argument_group("what does not change within a table")
    base.add_argument("--rays", type=common.count, default=1024)
    base.add_argument("--edge", type=common.at_least(2), default=300)
    base.add_argument("--channels", type=pair, help="such as 16x48; default: the backbone's own")
    lists = parser.add_argument_group("what changes")
    lists.add_argument("--rays-list", type=common.count, nargs="*", default=[256, 512, 1024, 2048, 4096])
    lists.add_argument("--edge-list", type=common.at_least(2), nargs="*", default=[64, 128, 200, 300])
    lists.add_argument(
        "--channels-list", type=pair, nargs="*", help="default: a half, one, one and a half, two times"
    )
    lists.add_argument("--threads-list", type=common.count, nargs="*", help="default: 1, 2, 4, ... cores")
    lists.add_argument(
        "--early-edge",
        type=common.at_least(2),
        default=128,
        help="of the grid without occupancy, for threads",
    )


def _row(step: BallStep, seconds: list[float]) -> Record:
    return {"seconds": common.spread(seconds), **step.samples_per_ray()}


def sweep(steps: dict[str, BallStep], repeats: int) -> dict[str, Record]:
    """Each step in turns with the others."""
    times = common.in_turns(dict(steps), repeats)
    return {name: _row(steps[name], values) for name, values in times.items()}


def by_threads(steps: dict[str, BallStep], counts: list[int], repeats: int) -> dict[str, dict[str, Record]]:
    """Seconds of each step by number of threads.

    The numbers take turns in blocks of steps, because a team of another size must be put together first.
    """
    times: dict[str, dict[int, list[float]]] = {name: {n: [] for n in counts} for name in steps}
    block = 5
    for _ in range(-(-repeats // block)):
        for number in counts:
            with threads(number):
                for name, step in steps.items():
                    step()
                    found = common.in_turns({name: step}, min(block, repeats), warm_up=1)
                    times[name][number] += found[name]
    return {
        name: {str(n): _row(steps[name], values) for n, values in found.items()}
        for name, found in times.items()
    }


def powers_up_to(cores: int) -> list[int]:
    """1, 2, 4, ... and the number itself."""
    found = [1]
    while 2 * found[-1] <= cores:
        found.append(2 * found[-1])
    return found if found[-1] == cores else [*found, cores]


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Other processes that want a processor each; they are one session, as another user's would be."""
    loop = f"import os\nfor _ in range({count - 1}):\n    if not os.fork():\n        break\nwhile True:\n    pass"
    running = subprocess.Popen([sys.executable, "-c", loop], start_new_session=True) if count else None
    try:
        yield
    finally:
        if running is not None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()


def exponent(rows: dict[str, Record]) -> float | None:
    """Return p of the least-squares line ``log seconds = p log size + c``; None for fewer than two sizes."""
    sizes = [math.log(float(name.partition("x")[0])) for name in rows]
    if len(set(sizes)) < 2:
        return None
    seconds = [math.log(row["seconds"]["median"]) for row in rows.values()]
    return statistics.linear_regression(sizes, seconds).slope


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    with busy_loops(arguments.beside):
        record = _measured(arguments)
    return record, arguments.backbone + (f"-beside{arguments.beside}" if arguments.beside else "")


def _measured(arguments: argparse.Namespace) -> Record:
    kind, repeats = arguments.backbone, arguments.repeats
    own = {"vm": (16, 48), "cp": (96, 288)}[kind]
    base = arguments.channels or own
    rays, edge = arguments.rays, arguments.edge
    tables: dict[str, dict[str, Record]] = {}
    if arguments.rays_list:
        field = ball_field(kind, edge, base)
        steps = {str(n): BallStep(field, ball_rays(n)) for n in arguments.rays_list}
        tables["rays"] = sweep(steps, repeats)
    if arguments.edge_list:
        tables["edge"] = sweep({str(n): ball_step(kind, n, rays, base) for n in arguments.edge_list}, repeats)
    several = [(c * base[0] // 2, c * base[1] // 2) for c in (1, 2, 3, 4)]
    wanted = several if arguments.channels_list is None else arguments.channels_list
    if wanted:
        steps = {f"{a}x{b}": ball_step(kind, edge, rays, (a, b)) for a, b in wanted}
        tables["channels"] = sweep(steps, repeats)
    numbers = arguments.threads_list
    if numbers is None:
        numbers = powers_up_to(torch.get_num_threads())
    threaded: dict[str, dict[str, Record]] = {}
    if numbers:
        steps = {
            f"{arguments.early_edge}³ without occupancy": ball_step(
                kind, arguments.early_edge, rays, base, everywhere=True
            ),
            f"{edge}³ with occupancy": ball_step(kind, edge, rays, base),
        }
        threaded = by_threads(steps, numbers, repeats)
    return {"tables": tables, "threads_tables": threaded, "speedup": speedups(threaded)}


def speedups(threaded: dict[str, dict[str, Record]]) -> dict[str, dict[str, float]]:
    """Return how many times as fast as one thread each number is, where one was measured."""
    found = {}
    for name, rows in threaded.items():
        if "1" in rows:
            one = rows["1"]["seconds"]["median"]
            found[name] = {n: one / row["seconds"]["median"] for n, row in rows.items() if n != "1"}
    return found


_LABELS = {"rays": "rays", "edge": "edge of the grid", "channels": "channels (density x appearance)"}


def show(record: Record) -> str:
    arguments = record["arguments"]
    parts = [
        f"Backbone {arguments['backbone']}; where it does not change: {arguments['rays']} rays, "
        f"edge {arguments['edge']}; busy loops beside: {arguments.get('beside', 0)}."
    ]
    for name, rows in record["tables"].items():
        first = next(iter(rows.values()))["seconds"]["median"]
        body = [
            [
                value,
                common.ms(row["seconds"]["median"]),
                f"{row['seconds']['median'] / first:.2f}",
                f"{row['density_samples_per_ray']:.1f}",
                f"{row['colour_samples_per_ray']:.1f}",
            ]
            for value, row in rows.items()
        ]
        head = [
            _LABELS[name],
            "step (ms)",
            "to the first",
            "density samples per ray",
            "colour samples per ray",
        ]
        parts.append(common.markdown(head, body))
        power = exponent(rows)
        if power is not None:
            parts.append(f"Time grows as {_LABELS[name]} to the power {power:.2f}.")
    for name, rows in record["threads_tables"].items():
        gains = record["speedup"].get(name, {})
        body = [
            [
                n,
                common.ms(row["seconds"]["median"]),
                f"{gains[n]:.2f}" if n in gains else "1" if n == "1" else "",
            ]
            for n, row in rows.items()
        ]
        parts.append(common.markdown([f"threads, {name}", "step (ms)", "times as fast as one"], body))
        if "2" in gains:
            parts.append(f"Two threads against one, {name}: {gains['2']:.2f} times as fast.")
    return "\n\n".join(parts)
