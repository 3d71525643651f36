"""A whole run in a process of its own, whose memory is then the run's."""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch

from gridreg.errors import InputError
from gridreg.ops import use_backend
from gridreg.ops.cpu.jit.compiler import Kernel
from gridreg.training import Execution, StepReport, TrainSettings, execute

from . import common
from .common import Record
from .stopwatch import replaced


def peak_bytes(status: Path = Path("/proc/self/status")) -> int:
    """The most memory that this process has held.

    ``ru_maxrss`` of a process also counts what its parent held when it was started, so Linux's own count for the
    program comes first.
    """
    try:
        lines = status.read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


class Stolen:
    """The fraction of all processors' time that the host of a virtual machine gives to others, from now on.

    Seconds of a program that ran meanwhile are too long by that fraction or more, as threads wait for each other.
    """

    def __init__(self, stat: Path = Path("/proc/stat")) -> None:
        self.stat = stat
        self.began = self._ticks()

    def _ticks(self) -> tuple[int, int] | None:
        """Ticks in all, and those stolen; None where the system does not count them."""
        try:
            words = self.stat.read_text().split("\n", 1)[0].split()
            # user, nice, system, idle, iowait, irq, softirq, steal; guests' are within user's.
            ticks = [int(word) for word in words[1:9]]
        except (OSError, ValueError):
            return None
        return (sum(ticks), ticks[7]) if words[:1] == ["cpu"] and len(ticks) == 8 else None

    def fraction(self) -> float | None:
        """In [0, 1]; None where it is not known."""
        ended = self._ticks()
        if self.began is None or ended is None or ended[0] <= self.began[0]:
            return None
        return (ended[1] - self.began[1]) / (ended[0] - self.began[0])


def boundaries(settings: TrainSettings) -> list[int]:
    """Iterations at which the schedule changes the grid, its cells or its rays, and both ends."""
    inside = {*settings.resample_at, *settings.occupancy_at, *settings.shrink_at, *settings.filter_rays_at}
    return sorted({0, settings.steps, *(step for step in inside if 0 < step < settings.steps)})


class Spans:
    """Notes time, grid and memory at the boundaries of a schedule, while `gridreg.training.execute` trains."""

    def __init__(self, settings: TrainSettings) -> None:
        self.ends = boundaries(settings)[1:]
        self.rows: list[Record] = []
        self.stolen_fraction: float | None = None

    def start(self, run: Execution) -> None:
        self.run, self.began, self.first = run, time.perf_counter(), run.trainer.step
        self.stolen = Stolen()
        self.resolution = list(getattr(run.trainer.field, "resolution", ()))

    def step(self, report: StepReport) -> None:
        step = self.run.trainer.step
        if step not in self.ends:
            return
        now = time.perf_counter()
        self.rows.append(
            {
                "from": self.first,
                "to": step,
                "resolution": self.resolution,
                "seconds": now - self.began,
                "peak_bytes": peak_bytes(),
            }
        )
        self.first, self.began = step, now
        self.stolen_fraction = self.stolen.fraction()
        # The events of this iteration have been, so this is the grid of the next span.
        self.resolution = list(getattr(self.run.trainer.field, "resolution", ()))


def add_arguments(parser: argparse.ArgumentParser, preset: str) -> None:
    common.add_scene_arguments(parser, preset=preset)
    parser.add_argument("--backend", choices=("auto", "torch"), default="auto", help="torch: the plain path")


def add_shortened_arguments(parser: argparse.ArgumentParser, steps: int) -> None:
    """Add the options of commands that need no more of a run than all of its events."""
    add_arguments(parser, preset="quick")
    parser.add_argument(
        "--steps",
        type=common.count,
        default=steps,
        help="iterations of the shortened schedule; default: %(default)s",
    )


def run_here(arguments: argparse.Namespace) -> Record:
    """Train and score in this process; figures by span of the schedule, scores and memory."""
    peaks = {"imports": peak_bytes()}
    config = common.configuration(arguments, arguments.steps)
    scene = common.scene_of(config)
    peaks["scene"] = peak_bytes()
    spans, kernels = Spans(config.train), {"count": 0, "seconds": 0.0}
    with (
        tempfile.TemporaryDirectory() as out,
        use_backend(arguments.backend),
        replaced(Kernel, "_compile", _counted(Kernel._compile, kernels)),
    ):
        _, metrics = execute(config, scene, out, watch=spans)
    if metrics is None:
        raise KeyboardInterrupt
    peaks["training"] = spans.rows[-1]["peak_bytes"]
    peaks["scoring"] = peak_bytes()
    return {
        "scene": metrics["scene"],
        "protocol": metrics["protocol"],
        "preset": arguments.preset,
        "steps": metrics["steps"],
        "seed": metrics["seed"],
        "mean": metrics["mean"],
        "seconds": metrics["seconds"],
        "stolen": spans.stolen_fraction,
        "test_views": len(metrics["images"]),
        "spans": spans.rows,
        "peak_bytes": peaks,
        "kernels": kernels,
    }


def _counted(function: Callable[[Kernel], Any], kernels: dict[str, Any]) -> Callable[[Kernel], Any]:
    """The same, noting how often it was called and how long it took."""

    def run(kernel: Kernel) -> Any:
        began = time.perf_counter()
        try:
            return function(kernel)
        finally:
            kernels["count"] += 1
            kernels["seconds"] += time.perf_counter() - began

    return run


def run_apart(arguments: argparse.Namespace) -> Record:
    """Return the figures of `run_here` in a fresh process.

    Raises:
        InputError: of the run; or if its process was killed.
    """
    # What is wrong with the command line shows here, at once.
    common.configuration(arguments, arguments.steps)
    threads = torch.get_num_threads()
    with ProcessPoolExecutor(
        1, multiprocessing.get_context("spawn"), torch.set_num_threads, (threads,)
    ) as pool:
        try:
            return pool.submit(run_here, arguments).result()
        except BrokenProcessPool:
            raise InputError("the run in a process of its own was killed; was the memory enough?") from None
