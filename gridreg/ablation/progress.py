"""Progress of a study, an estimate of the time left, and the lines of a dry run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import TextIO

from gridreg.ablation.records import RunResult, RunSpec
from gridreg.ablation.runners import Event
from gridreg.training.progress import clock_time


def seconds_left(results: Sequence[RunResult]) -> float | None:
    """Estimate the time of the runs that are left, one after another; None if no run is finished yet.

    A run is likened to finished ones of the same preset, field and number of steps; failing that, the seconds of one
    step of all finished ones count.
    """
    runs = {result.spec.hash: result for result in results}.values()
    done = [run for run in runs if run.status == "done" and run.seconds > 0]
    alike: dict[tuple[str, str, int], list[float]] = {}
    for run in done:
        alike.setdefault(_kind(run.spec), []).append(run.seconds)
    per_step = sum(run.seconds for run in done) / max(1, sum(_kind(run.spec)[-1] for run in done))
    left = (_kind(run.spec) for run in runs if run.status in ("waiting", "running"))
    total = sum(fmean(alike[kind]) if kind in alike else per_step * kind[-1] for kind in left)
    return total if done else None


def _kind(spec: RunSpec) -> tuple[str, str, int]:
    return spec.preset, spec.backbone, int(spec.config.get("train", {}).get("steps", 1))


def left_in_words(results: Sequence[RunResult], workers: int = 1) -> str:
    """The number of runs that are left, and the time they take with some number of them at a time."""
    statuses = list({result.spec.hash: result.status for result in results}.values())
    left, done = len(statuses) - statuses.count("done") - statuses.count("failed"), statuses.count("done")
    seconds = seconds_left(results)
    if left == 0:
        return "no run is left"
    runs = f"{left} run{'s' * (left > 1)} left"
    if seconds is None:
        return f"{runs}; no run is finished yet, so there is no estimate of their time"
    beside = f" with {workers} at a time" if workers > 1 else ""
    wait = clock_time(seconds / max(1, min(workers, left)))
    return f"{runs}, about {wait}{beside} (from {done} finished run{'s' * (done > 1)})"


def dry_run_lines(results: Sequence[RunResult], workers: int = 1) -> list[str]:
    """Every run with its status, and what the rest takes."""
    lines = [f"{r.spec.hash}  {r.status:<8}{r.spec.describe()}" for r in results]
    unique = len({r.spec.hash for r in results})
    shared = f" ({len(results) - unique} rows share a run with another)" if unique < len(results) else ""
    return [*lines, f"{unique} runs{shared}; {left_in_words(results, workers)}"]


class StudyProgress:
    """Prints a line for every run that ends, with the rate and the time left.

    Args:
        results: where the study stands.
        stream: to print to; default: standard error.
        clock: seconds, ever increasing.
    """

    def __init__(
        self,
        results: Sequence[RunResult],
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        by_hash = {result.spec.hash: result.status for result in results}
        self.total = len(by_hash)
        self.done = sum(status == "done" for status in by_hash.values())
        self.failed = sum(status == "failed" for status in by_hash.values())
        self._stream = stream
        self._clock = clock
        self._began = clock()
        self._ended = 0

    def __call__(self, event: Event) -> None:
        """Take an event in."""
        if event.kind == "started":
            return
        self.done += event.kind == "done"
        self.failed += event.kind == "failed"
        self._ended += event.kind in ("done", "failed")
        what = {
            "done": "done" if event.psnr is None else f"PSNR {event.psnr:.2f} dB in {event.seconds:.1f} s",
            "failed": f"FAILED: {event.reason}",
            "interrupted": "stopped, its checkpoint is kept",
            "lost": "lost with its worker, waits again",
        }[event.kind]
        stream = self._stream or sys.stderr
        print(f"[{self.describe()}] {event.spec.describe()}: {what}", file=stream, flush=True)

    def describe(self) -> str:
        """Runs done, rate and time left."""
        ended = self.done + self.failed
        head = f"{ended}/{self.total}" + (f", {self.failed} failed" if self.failed else "")
        seconds = self._clock() - self._began
        if not self._ended or seconds <= 0:
            return head
        rate = self._ended / seconds
        left = (self.total - ended) / rate
        return f"{head}, {60 * rate:.1f} runs/min, left {clock_time(left)}"
