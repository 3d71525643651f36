"""The process that works on a run, and whether it still lives."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path

from gridreg.machine import is_process
from gridreg.training.typed_data import from_data


@dataclass(frozen=True)
class Worker:
    """A process, told apart from a later one with the same number.

    Args:
        machine: the host's name.
        place: of the system that numbers processes: boot and process namespace; empty if the system does not tell.
        process: its number.
        started: when it started, in the system's own unit; empty if the system does not tell.
    """

    machine: str
    place: str
    process: int
    started: str

    @staticmethod
    def current() -> Worker:
        """This process.

        Example:
            >>> Worker.current().is_alive()
            True
        """
        return Worker.of(os.getpid())

    @staticmethod
    def of(process: int) -> Worker:
        """A process of this machine by its number."""
        return Worker(platform.node(), _place(), process, _started(process) or "")

    def is_alive(self) -> bool | None:
        """Whether the process lives; None if it runs elsewhere, so that only its silence can tell."""
        if self.machine != platform.node() or self.place != _place():
            return None
        if self.place:
            return _started(self.process) == self.started
        return is_process(self.process)

    def to_text(self) -> str:
        """As one line of text, see `from_text`."""
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def from_text(text: str) -> Worker:
        """Undo `to_text`.

        Raises:
            ValueError: if it is no such text.
        """
        return from_data(Worker, json.loads(text), source="worker")


def _place() -> str:
    """Boot and process namespace: process numbers mean the same only within both."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _started(process: int) -> str | None:
    """Clock ticks from boot to the start of a process; None if there is no such process, or it is a zombie."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The second field is the program's name in parentheses, which may hold anything.
    fields = text.rpartition(")")[2].split()
    return None if fields[0] in ("Z", "X") else fields[19]
