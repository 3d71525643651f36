"""The machine: its cores, its memory, its devices, and what dead processes have left."""

from __future__ import annotations

import os
import platform
import re
import secrets
import shutil
import zlib
from pathlib import Path
from typing import Literal

import torch

from gridreg.errors import InputError

DeviceName = Literal["cpu", "cuda", "mps", "auto"]

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


def choose_device(name: str, option: str = "--device") -> torch.device:
    """Return the device of a name; "auto" is CUDA where there is one, else MPS, else the CPU.

    Args:
        name: one of `DeviceName`.
        option: what the name was given to, for the message.

    Raises:
        InputError: it is not there.

    Example:
        >>> choose_device("cpu")
        device(type='cpu')
    """
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        name = next(known for known, found in there.items() if found)
    if not there.get(name):
        found = ", ".join(known for known in there if there[known])
        raise InputError(f"{option}: found {name!r}, expected a device that is here: {found}, auto")
    return torch.device(name)


def temporary_beside(path: Path) -> Path:
    """A hidden name beside ``path`` that nobody else uses, and that tells later runs whose it is.

    A process that is killed leaves its file; `remove_left_behind` takes it away once that process is gone.
    """
    # A token, not a fixed name: workers of one experiment may write the same file at the same time.
    token = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.stem}.{token}.tmp{path.suffix}")


_TEMPORARY = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.tmp(\..*)?", re.DOTALL)


def _machine() -> str:
    """Eight characters that differ between machines that share a disk: processes of others cannot be looked up."""
    return f"{zlib.crc32(platform.node().encode('utf-8', 'surrogateescape')):08x}"


def remove_left_behind(folder: Path) -> None:
    """Remove temporary files and folders of processes of this machine that have died."""
    for entry in list(folder.iterdir()):
        found = _TEMPORARY.fullmatch(entry.name)
        if found is not None and found[1] == _machine() and not is_process(int(found[2])):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


def is_process(process: int) -> bool:
    """Whether there is a process of this number; True where the system does not tell."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        # Somebody else's.
        return True
    return True
