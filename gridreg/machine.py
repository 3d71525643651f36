"""The machine: cores that this process may use, and whether what is asked for fits into memory."""

from __future__ import annotations

import os
from pathlib import Path

from gridreg.errors import InputError

__all__ = ["available_memory", "check_memory", "usable_cores"]

_CGROUP = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def available_memory() -> int | None:
    """Return the bytes that may still be taken: of the machine, of its container and of this process.

    None where the system does not say (it is not Linux).
    """
    left = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                left.append(1024 * int(line.split()[1]))
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            left.append(limit - pages * os.sysconf("SC_PAGE_SIZE"))
    except (OSError, ValueError, ImportError):
        return None
    for most, now in _CGROUP:
        try:
            left.append(int(Path(most).read_text()) - int(Path(now).read_text()))
        except (OSError, ValueError):
            continue
    return max(0, min(left)) if left else None


def check_memory(needed: float, what: str) -> None:
    """Refuse what the memory cannot hold, before it is begun.

    Args:
        needed: bytes, at the least.
        what: names what needs them, and opens the message.

    Raises:
        InputError: if the machine has not got that much.

    Example:
        >>> check_memory(1e18, "--resolution 100000")
        Traceback (most recent call last):
        gridreg.errors.InputError: --resolution 100000: needs 1000000000.0 GB of memory, found ... GB
    """
    left = available_memory()
    if left is not None and needed > left:
        raise InputError(f"{what}: needs {needed / 1e9:.1f} GB of memory, found {left / 1e9:.1f} GB")


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
