"""Runs in several processes of this machine, each with its own number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

from gridreg.ablation.database import DiskFullError
from gridreg.ablation.records import Study
from gridreg.ablation.runners import PAUSED, Event, Report
from gridreg.ablation.store import Store
from gridreg.ablation.worker import EXIT_DISK_FULL
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.machine import usable_cores
from gridreg.training.files import output_errors
from gridreg.training.progress import interruptible

LOG_NAME = "workers.log"
"""File in the store with what worker processes print outside of runs."""

# Ctrl-C in the terminal is for this process, which tells the others. A group of their own keeps them in the session,
# whose part of the processor Linux divides; Python 3.10 knows sessions only.
_APART: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"start_new_session": True}
_POLL = 0.2
_MOST_IDLE_DEATHS = 3

_Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class Processes:
    """Runs in ``workers`` processes of ``threads`` threads each.

    A process that dies is replaced, and its run goes to another one. The processes end with this one, however it ends.
    Arguments: as the options of `gridreg ablate`.
    """

    workers: int | None = None
    threads: int = 1
    keep_checkpoints: bool = True
    device: str = "cpu"

    def run(self, store: Store, study: Study, report: Report) -> None:
        """See `gridreg.ablation.runners.Runner.run`."""
        counts = store.counts(study)
        count = self.workers or max(1, usable_cores() // self.threads)
        count = min(count, max(1, counts["waiting"] + counts["running"]))
        follower = _Follower(store, study, report)
        children: dict[_Process, Worker] = {}
        idle_deaths = 0
        with interruptible() as interruption:
            try:
                for _ in range(count):
                    self._start(store, study, children)
                while children and not interruption.requested:
                    time.sleep(_POLL)
                    follower.follow()
                    for process in [process for process in children if process.poll() is not None]:
                        worker = children.pop(process)
                        _close(process)
                        if process.returncode:
                            follower.follow()
                            idle_deaths = 0 if worker.to_text() in follower.workers else idle_deaths + 1
                            _handle_dead_worker(store, process, worker, idle_deaths)
                            self._start(store, study, children)
            finally:
                _end(children)
                follower.follow()
        if interruption.requested:
            raise KeyboardInterrupt

    def _start(self, store: Store, study: Study, children: dict[_Process, Worker]) -> None:
        command = [sys.executable, "-m", "gridreg.ablation.worker", "--end-with-input", "--study", study.name]
        command += ["--store", str(store.folder.resolve()), "--threads", str(self.threads)]
        command += ["--device", self.device]
        command += [] if self.keep_checkpoints else ["--no-checkpoints"]
        variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, **dict.fromkeys(variables, str(self.threads)), "PYTHONPATH": path}
        place = store.folder / LOG_NAME
        with output_errors(place), place.open("ab") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, **_APART
            )
        children[process] = Worker.of(process.pid)


def _handle_dead_worker(store: Store, process: _Process, worker: Worker, idle_deaths: int) -> None:
    """Give the runs of a process that died to others.

    Raises:
        DiskFullError: if it died for want of space.
        InputError: if it is the third in a row that never had a run.
    """
    status = process.returncode
    if status == EXIT_DISK_FULL:
        raise DiskFullError(f"{store.folder}: no space left on the disk; {PAUSED}")
    reason = f"signal {-status}" if status < 0 else f"exit status {status}"
    store.mark_lost(worker, reason)
    if idle_deaths >= _MOST_IDLE_DEATHS:
        raise InputError(
            f"workers: {idle_deaths} processes in a row died before they had done anything ({reason}); "
            f"see {store.folder / LOG_NAME}"
        )


class _Follower:
    """Reports what other processes do, from what the store says; ``workers`` holds those that have had a run."""

    def __init__(self, store: Store, study: Study, report: Report) -> None:
        self._store, self._study, self._report = store, study, report
        past = store.attempts()
        self._first = past[-1]["number"] if past else 0
        self._told: dict[int, str] = {}
        self.workers: set[str] = set()

    def follow(self) -> None:
        """Report what is new."""
        attempts = self._store.attempts(self._first)
        new = [a for a in attempts if self._told.get(a["number"]) != a["outcome"]]
        results = {result.spec.hash: result for result in self._store.results(self._study)} if new else {}
        for attempt in new:
            kind, result = attempt["outcome"], results.get(attempt["hash"])
            before = self._told.get(attempt["number"])
            self._told[attempt["number"]] = kind
            self.workers.add(attempt["worker"])
            if result is None:
                continue
            if before is None:
                self._report(Event("started", result.spec))
            if kind == "done" and result.metrics is not None:
                psnr = float(result.metrics["mean"]["psnr"])
                self._report(Event("done", result.spec, psnr=psnr, seconds=result.seconds))
            elif kind != "running":
                self._report(Event(kind, result.spec, reason=result.reason if kind == "failed" else ""))


def _end(children: dict[_Process, Worker]) -> None:
    """Let the processes save and end; a second Ctrl-C kills them."""
    for process in children:
        if process.poll() is None:
            process.terminate()
    try:
        for process in children:
            process.wait()
    finally:
        for process in children:
            process.kill()
            process.wait()
            _close(process)


def _close(process: _Process) -> None:
    if process.stdin is not None:
        process.stdin.close()
