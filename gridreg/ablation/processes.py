"""Runs in several processes of this machine, each with its own number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

from gridreg.ablation.records import Study
from gridreg.ablation.runners import Event, Report
from gridreg.ablation.store import Store
from gridreg.ablation.workers import Worker
from gridreg.cores import usable_cores
from gridreg.errors import InputError
from gridreg.training.files import output_errors
from gridreg.training.progress import Interruption, interruptible

__all__ = ["LOG_NAME", "Processes"]

LOG_NAME = "workers.log"
"""File in the store with what worker processes print outside of runs."""

# Ctrl-C in the terminal is for this process, which tells the others. A group of their own keeps them in the session,
# whose share of the processor Linux divides; Python 3.10 knows sessions only.
_APART: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"start_new_session": True}
_POLL = 0.2
_MOST_IDLE_DEATHS = 3


@dataclass
class _Child:
    process: subprocess.Popen[bytes]
    worker: Worker


@dataclass(frozen=True)
class Processes:
    """Runs in ``workers`` processes of ``threads`` threads each.

    A process that dies is replaced, and its run goes to another one. The processes end with this one, however it ends.

    Args:
        workers: processes; default: as many as the cores hold.
        threads: of each.
        keep_checkpoints: leave those of finished runs in their folders.
    """

    workers: int | None = None
    threads: int = 1
    keep_checkpoints: bool = True

    def run(self, store: Store, study: Study, report: Report) -> None:
        """See `Runner.run`."""
        count = self.workers or max(1, usable_cores() // self.threads)
        counts = store.counts(study)
        count = min(count, max(1, counts["waiting"] + counts["running"]))
        follower = _Follower(store, study, report)
        children: list[_Child] = []
        idle_deaths = 0
        with interruptible() as interruption:
            try:
                children += [self._start(store, study) for _ in range(count)]
                while children and not interruption.requested:
                    time.sleep(_POLL)
                    follower.follow()
                    for child in [c for c in children if c.process.poll() is not None]:
                        children.remove(child)
                        _close(child)
                        if child.process.returncode == 0:
                            continue
                        worked = follower.has_worked(child.worker)
                        idle_deaths = 0 if worked else idle_deaths + 1
                        self._bury(store, child, idle_deaths)
                        children.append(self._start(store, study))
            finally:
                _end(children, interruption)
                follower.follow()
        if interruption.requested:
            raise KeyboardInterrupt

    def _start(self, store: Store, study: Study) -> _Child:
        command = [sys.executable, "-m", "gridreg.ablation.worker", "--end-with-input"]
        command += [
            "--store",
            str(store.folder.resolve()),
            "--study",
            study.name,
            "--threads",
            str(self.threads),
        ]
        command += [] if self.keep_checkpoints else ["--no-checkpoints"]
        threads = dict.fromkeys(
            ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), str(self.threads)
        )
        path = store.folder / LOG_NAME
        with output_errors(path), path.open("ab") as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={**os.environ, **threads, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                **_APART,
            )
        return _Child(process, Worker.of(process.pid))

    def _bury(self, store: Store, child: _Child, idle_deaths: int) -> None:
        status = child.process.returncode
        reason = f"signal {-status}" if status < 0 else f"exit status {status}"
        store.lose(child.worker, reason)
        if idle_deaths >= _MOST_IDLE_DEATHS:
            raise InputError(
                f"workers: {idle_deaths} processes in a row died before they had done anything ({reason}); "
                f"see {store.folder / LOG_NAME}"
            )


class _Follower:
    """Reports what other processes do, from what the store says."""

    def __init__(self, store: Store, study: Study, report: Report) -> None:
        self._store, self._study, self._report = store, study, report
        past = store.attempts()
        self._first = past[-1]["number"] if past else 0
        self._told: dict[int, str] = {}
        self._workers: set[str] = set()

    def has_worked(self, worker: Worker) -> bool:
        """Whether a process has ever had a run."""
        self.follow()
        return worker.to_text() in self._workers

    def follow(self) -> None:
        """Report what is new."""
        attempts = self._store.attempts(self._first)
        new = [a for a in attempts if self._told.get(a["number"]) != a["outcome"]]
        if not new:
            return
        results = {result.spec.hash: result for result in self._store.results(self._study)}
        for attempt in new:
            began = attempt["number"] not in self._told
            self._told[attempt["number"]] = attempt["outcome"]
            self._workers.add(attempt["worker"])
            result = results.get(attempt["hash"])
            if result is None:
                continue
            if began:
                self._report(Event("started", result.spec))
            kind = attempt["outcome"]
            if kind == "running":
                continue
            event = Event(kind, result.spec)
            if kind == "done" and result.metrics is not None:
                event = replace(event, psnr=float(result.metrics["mean"]["psnr"]), seconds=result.seconds)
            self._report(replace(event, reason=result.reason) if kind == "failed" else event)


def _end(children: list[_Child], interruption: Interruption) -> None:
    """Let the processes save and end; a second Ctrl-C kills them."""
    for child in children:
        if child.process.poll() is None:
            child.process.terminate()
    try:
        for child in children:
            child.process.wait()
    finally:
        for child in children:
            child.process.kill()
            child.process.wait()
            _close(child)


def _close(child: _Child) -> None:
    if child.process.stdin is not None:
        child.process.stdin.close()
