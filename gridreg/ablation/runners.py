"""Runners do the runs of a study: the interface, and the one that works in this process, run by run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import torch

from gridreg.ablation.claims import Claim, ClaimLostError, heartbeat
from gridreg.ablation.database import DiskFullError
from gridreg.ablation.perform import Scenes, TaskResult, is_disk_full, perform
from gridreg.ablation.records import RunSpec, Study
from gridreg.ablation.store import Store
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.training.files import remove_folder

Kind = Literal["started", "done", "failed", "interrupted", "lost"]

PAUSED = "the study is paused, and the same command goes on from here when there is space"
"""Said of a full disk."""

_POLL = 0.5


@dataclass(frozen=True)
class Event:
    """Something happened to a run.

    Args:
        kind: ``started``, ``done``, ``failed``, ``interrupted`` (by the user) or ``lost`` (with its worker).
        spec: the run.
        psnr: mean over the test views in dB, of a run that is done.
        seconds: it took.
        reason: of a failure.
    """

    kind: Kind
    spec: RunSpec
    psnr: float | None = None
    seconds: float = 0.0
    reason: str = ""


Report = Callable[[Event], None]


class Runner(Protocol):
    """Does the runs of a study that are not done; results go to the store."""

    def run(self, store: Store, study: Study, report: Report) -> None:
        """Work until no run of the study waits or is under way, here or elsewhere.

        Args:
            store: holds the study.
            study: its runs.
            report: told what happens.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; what was under way is saved and waits.
            DiskFullError: if there is no space for results; what was under way waits.
            InputError: if the runner itself cannot work; the store stays as it is.
        """
        ...


@dataclass(frozen=True)
class InProcess:
    """Runs one after another in this process.

    Args:
        threads: of torch; default: as they are.
        keep_checkpoints: leave those of finished runs in their folders.
        device: where to compute.
        log: what a run prints goes to its folder instead of the terminal.
    """

    threads: int | None = None
    keep_checkpoints: bool = True
    device: str = "cpu"
    log: bool = False

    def run(self, store: Store, study: Study, report: Report) -> None:
        """See `Runner.run`."""
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        worker, scenes = Worker.current(), Scenes(store.folder / "scenes", self.device)
        while True:
            claim = store.claim(worker, study)
            if claim is None:
                if store.counts(study)["running"] == 0:
                    return
                # Somebody else has the last runs; if that worker dies, they come here.
                time.sleep(_POLL)
                continue
            report(Event("started", claim.spec))
            try:
                with heartbeat(store.beat, [claim]):
                    result = perform(claim.spec, claim.folder, scenes, watch=claim.check, log=self.log)
            except ClaimLostError:
                report(Event("lost", claim.spec))
                continue
            except BaseException:
                store.release(claim)
                raise
            settle(store, claim, result, report)
            if result.metrics is not None and not self.keep_checkpoints:
                remove_folder(claim.folder / "checkpoint")
            if result.metrics is None and not result.reason:
                raise KeyboardInterrupt


def settle(store: Store, claim: Claim, result: TaskResult, report: Report) -> None:
    """Keep what came of a claimed run, and report it.

    Raises:
        DiskFullError: if there is no space for it; the run waits.
    """
    spec, reason = claim.spec, result.reason
    try:
        if result.disk_full:
            raise DiskFullError(reason)
        if result.metrics is not None:
            try:
                machine, fingerprint = result.machine, result.fingerprint
                store.finish(claim, result.metrics, machine=machine, fingerprint=fingerprint)
            except InputError as error:
                if is_disk_full(error):
                    raise
                reason = str(error)
            else:
                mean, seconds = result.metrics["mean"], result.metrics["seconds"]
                report(Event("done", spec, psnr=float(mean["psnr"]), seconds=sum(seconds.values())))
                return
        if reason:
            store.fail(claim, reason)
        else:
            store.release(claim)
        report(Event("failed" if reason else "interrupted", spec, reason=reason))
    except ClaimLostError:
        report(Event("lost", spec))
    except InputError as error:
        if not is_disk_full(error):
            raise
        # Where not even that can be written, the run waits when this process is gone.
        with contextlib.suppress(InputError):
            store.release(claim)
        raise DiskFullError(f"{error}; {PAUSED}") from error
