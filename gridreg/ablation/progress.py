"""Progress of a study, an estimate of the time left, and the lines of a dry run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TextIO

from gridreg.ablation.records import RunResult, RunSpec
from gridreg.ablation.runners import Event
from gridreg.training.progress import clock_time

__all__ = ["Estimate", "StudyProgress", "dry_run_lines", "estimate"]


@dataclass(frozen=True)
class Estimate:
    """Time that the runs that are left will take.

    Args:
        runs: that are left.
        seconds: of all of them, one after another; None if no run is finished yet.
        based_on: number of finished runs.
    """

    runs: int
    seconds: float | None
    based_on: int

    def describe(self, workers: int = 1) -> str:
        """In words, for some number of runs at a time.

        Example:
            >>> Estimate(4, 120.0, 2).describe(workers=2)
            '4 runs left, about 1:00 with 2 at a time (from 2 finished runs)'
        """
        if self.runs == 0:
            return "no run is left"
        plural = "s" if self.runs > 1 else ""
        if self.seconds is None:
            return (
                f"{self.runs} run{plural} left; no run is finished yet, so there is no estimate of their time"
            )
        beside = f" with {workers} at a time" if workers > 1 else ""
        finished = f"{self.based_on} finished run{'s' if self.based_on > 1 else ''}"
        left = clock_time(self.seconds / max(1, min(workers, self.runs)))
        return f"{self.runs} run{plural} left, about {left}{beside} (from {finished})"


def estimate(results: Sequence[RunResult]) -> Estimate:
    """Estimate the time of the runs that are left from the seconds of those that are done.

    A run is likened to finished ones of the same preset, field and number of steps; failing that, the seconds of one
    step of all finished ones count.
    """
    by_hash = {result.spec.hash: result for result in results}
    done = [r for r in by_hash.values() if r.status == "done" and r.seconds > 0]
    left = [r for r in by_hash.values() if r.status in ("waiting", "running")]
    if not done:
        return Estimate(len(left), None, 0)
    like: dict[tuple[str, str, int], list[float]] = {}
    for result in done:
        like.setdefault(_kind(result.spec), []).append(result.seconds)
    per_step = sum(r.seconds for r in done) / max(1, sum(_steps(r.spec) for r in done))
    total = 0.0
    for result in left:
        known = like.get(_kind(result.spec))
        total += sum(known) / len(known) if known else per_step * _steps(result.spec)
    return Estimate(len(left), total, len(done))


def dry_run_lines(results: Sequence[RunResult], workers: int = 1) -> list[str]:
    """Every run with its status, and what the rest takes."""
    lines = [f"{r.spec.hash}  {r.status:<8}{r.spec.describe()}" for r in results]
    unique = len({r.spec.hash for r in results})
    shared = f" ({len(results) - unique} rows share a run with another)" if unique < len(results) else ""
    return [*lines, f"{unique} runs{shared}; {estimate(results).describe(workers)}"]


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
        if event.kind == "done":
            self.done += 1
            what = f"PSNR {event.psnr:.2f} dB in {event.seconds:.1f} s" if event.psnr is not None else "done"
        elif event.kind == "failed":
            self.failed += 1
            what = f"FAILED: {event.reason}"
        else:
            what = {
                "interrupted": "stopped, its checkpoint is kept",
                "lost": "lost with its worker, waits again",
            }[event.kind]
        self._ended += event.kind in ("done", "failed")
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


def _kind(spec: RunSpec) -> tuple[str, str, int]:
    return spec.preset, spec.backbone, _steps(spec)


def _steps(spec: RunSpec) -> int:
    return int(spec.config.get("train", {}).get("steps", 1))
