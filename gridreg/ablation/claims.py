"""A claim on a run: one worker at a time, kept alive by its heartbeat, lost when it is not."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from gridreg.ablation.records import RunSpec
from gridreg.errors import InputError

__all__ = ["HEARTBEAT_SECONDS", "LEASE_SECONDS", "Claim", "ClaimLostError", "Heartbeat"]

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


class Heartbeat:
    """Signs of life for some claims from a thread of its own, while the block runs.

    Args:
        beat: tells the store; returns whether the claim still holds.
        every: seconds between two signs.
    """

    def __init__(self, beat: Callable[[Claim], bool], every: float = HEARTBEAT_SECONDS) -> None:
        self._beat = beat
        self._every = every
        self._claims: list[Claim] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def add(self, claim: Claim) -> None:
        """Keep a claim alive."""
        self._claims.append(claim)

    def drop(self, claim: Claim) -> None:
        """Keep it alive no longer."""
        with contextlib.suppress(ValueError):
            self._claims.remove(claim)

    def _work(self) -> None:
        while not self._over.wait(self._every):
            for claim in list(self._claims):
                # A store that is locked for a moment is asked again with the next beat.
                with contextlib.suppress(InputError):
                    if not self._beat(claim):
                        claim.lost.set()
