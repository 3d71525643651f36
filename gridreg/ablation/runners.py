"""Who does the runs of a study: the interface, and the runner that does them in this process, one after another."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import torch

from gridreg.ablation.claims import Claim, ClaimLostError, Heartbeat
from gridreg.ablation.perform import LOG_NAME, Scenes, perform, reason_of
from gridreg.ablation.records import RunSpec, Study
from gridreg.ablation.store import Store
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.training.files import output_errors

__all__ = ["Event", "InProcess", "Report", "Runner", "finish_or_fail", "serve", "work_on"]

Kind = Literal["started", "done", "failed", "interrupted", "lost"]
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
            InputError: if the runner itself cannot work; the store stays as it is.
        """
        ...


@dataclass(frozen=True)
class InProcess:
    """Runs one after another in this process.

    Args:
        threads: of torch; default: as they are.
        keep_checkpoints: leave those of finished runs in their folders.
    """

    threads: int | None = None
    keep_checkpoints: bool = True

    def run(self, store: Store, study: Study, report: Report) -> None:
        """See `Runner.run`."""
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        serve(store, study, report, keep_checkpoints=self.keep_checkpoints)


def serve(
    store: Store, study: Study, report: Report, *, keep_checkpoints: bool = True, log: bool = False
) -> None:
    """Claim and do one run after another until none of the study waits or is under way.

    Args:
        store: holds the study.
        study: its runs.
        report: told what happens.
        keep_checkpoints: leave those of finished runs in their folders.
        log: what a run prints goes to its folder instead of the terminal.

    Raises:
        KeyboardInterrupt: if it was interrupted; the run under way is saved and waits.
    """
    worker, scenes = Worker.current(), Scenes(store.folder / "scenes")
    while True:
        claim = store.claim(worker, study)
        if claim is not None:
            work_on(store, claim, scenes, report, keep_checkpoint=keep_checkpoints, log=log)
        elif store.counts(study)["running"] == 0:
            return
        else:
            # Somebody else has the last runs; if that worker dies, they come here.
            time.sleep(_POLL)


def work_on(
    store: Store,
    claim: Claim,
    scenes: Scenes,
    report: Report,
    *,
    keep_checkpoint: bool = True,
    log: bool = False,
) -> None:
    """Do a claimed run and tell the store how it ended.

    Raises:
        KeyboardInterrupt: if it was interrupted; it is saved and waits.
    """
    report(Event("started", claim.spec))
    try:
        with Heartbeat(store.beat) as heartbeat, _printing_to(claim.folder if log else None):
            heartbeat.add(claim)
            outcome = perform(
                claim.spec, claim.folder, scenes, keep_checkpoint=keep_checkpoint, watch=claim.check
            )
    except ClaimLostError:
        report(Event("lost", claim.spec))
        return
    except Exception as error:
        finish_or_fail(store, claim, report, reason=_reason(error, claim))
        return
    except BaseException:
        store.release(claim)
        raise
    if outcome.metrics is None:
        store.release(claim)
        report(Event("interrupted", claim.spec))
        raise KeyboardInterrupt
    finish_or_fail(
        store,
        claim,
        report,
        metrics=outcome.metrics,
        machine=outcome.machine,
        fingerprint=outcome.fingerprint,
    )


def finish_or_fail(
    store: Store,
    claim: Claim,
    report: Report,
    *,
    reason: str = "",
    metrics: dict[str, object] | None = None,
    machine: str = "",
    fingerprint: str = "",
) -> None:
    """Keep the metrics of a run, or the reason why there are none, and report it."""
    spec = claim.spec
    try:
        if metrics is not None:
            try:
                store.finish(claim, metrics, machine=machine, fingerprint=fingerprint)
            except InputError as error:
                reason = str(error)
            else:
                report(_done(spec, metrics))
                return
        store.fail(claim, reason)
        report(Event("failed", spec, reason=reason))
    except ClaimLostError:
        report(Event("lost", spec))


def _done(spec: RunSpec, metrics: dict[str, object]) -> Event:
    mean, seconds = metrics["mean"], metrics["seconds"]
    assert isinstance(mean, dict)
    assert isinstance(seconds, dict)
    return Event("done", spec, psnr=float(mean["psnr"]), seconds=sum(seconds.values()))


def _reason(error: Exception, claim: Claim) -> str:
    try:
        return reason_of(error, claim.folder)
    except InputError as unwritable:
        return f"{type(error).__name__}: {error}; {unwritable}"


@contextmanager
def _printing_to(folder: Path | None) -> Iterator[None]:
    """What is printed inside goes to the log of the run in ``folder``; to the terminal without one."""
    if folder is None:
        yield
        return
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stream = (folder / LOG_NAME).open("a", encoding="utf-8")
    with stream, contextlib.redirect_stderr(stream), contextlib.redirect_stdout(stream):
        yield
        sys.stderr.flush()
