"""A claim on a run: one worker at a time, kept alive by its heartbeat, lost when it is not."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gridreg.ablation.records import RunSpec
from gridreg.errors import InputError

HEARTBEAT_SECONDS = 10.0
"""Between two signs of life of a worker."""

LEASE_SECONDS = 120.0
"""Silence of a worker on another machine after which its run goes to somebody else."""


class ClaimLostError(Exception):
    """The run was given to another worker in the meantime; what this one computes is not wanted any more."""


@dataclass(eq=False)
class Claim:
    """The right to work on a run.

    Args:
        spec: what to run.
        folder: where.
        token: proves the claim.
        lost: set when the run was given to somebody else.
    """

    spec: RunSpec
    folder: Path
    token: str
    lost: threading.Event = field(default_factory=threading.Event)

    def check(self) -> None:
        """Called now and then by whoever works.

        Raises:
            ClaimLostError: if somebody else has the run.
        """
        if self.lost.is_set():
            raise ClaimLostError(f"{self.spec.describe()}: given to another worker")


@contextmanager
def heartbeat(
    beat: Callable[[Claim], bool], claims: Collection[Claim], every: float = HEARTBEAT_SECONDS
) -> Iterator[None]:
    """Signs of life for claims, from a thread of its own, while the block runs.

    Args:
        beat: tells the store; returns whether the claim still holds.
        claims: kept alive; the block may add to them and take away.
        every: seconds between two signs.
    """
    over = threading.Event()

    def work() -> None:
        while not over.wait(every):
            for claim in tuple(claims):
                # A store that is locked for a moment is asked again with the next beat.
                with contextlib.suppress(InputError):
                    if not beat(claim):
                        claim.lost.set()

    thread = threading.Thread(target=work, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
