"""The folder in which compiled kernels are cached: who may write, and what is out of date."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gridreg.ops.cpu.mlp.gemm_amx import allowed

try:
    import fcntl
except ImportError:  # Windows has no such lock.
    fcntl = None  # type: ignore[assignment]


def can_lock() -> bool:
    """Whether this system locks files, so that processes can wait for each other."""
    return fcntl is not None


@contextmanager
def one_process(folder: str, name: str) -> Iterator[None]:
    """While one process compiles a kernel, others wait, and then read what it has left in the cache.

    That spares the work; and code that two processes generate may differ in the order of its sums, so that their
    numbers would differ in the last digits. Where files cannot be locked, each process goes on alone.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    with (Path(folder) / f"{name}.lock").open("a") as lock:
        if fcntl is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX)
        # Closing the file unlocks it.
        yield


@functools.cache
def _sources() -> tuple[tuple[str, ...], str]:
    """Names of the modules of `gridreg.ops` and the digest of what they say, and of what they ask the system."""
    files = sorted(Path(__file__).parents[2].rglob("*.py"))
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    digest.update(bytes([allowed()]))
    return tuple(file.stem for file in files), digest.hexdigest()


@functools.cache
def forget_outdated(folder: str) -> bool:
    """Drop cached kernels of other versions of this package; returns whether none are left.

    numba drops a kernel when the kernel's own file changes, not when a function that it calls does in another file.
    """
    names, digest = _sources()
    stamp = Path(folder) / "gridreg-kernels.sha256"
    if stamp.exists() and stamp.read_text() == digest:
        return False
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name in names:
        for kind in ("nbi", "lock"):
            for file in Path(folder).glob(f"{name}.*.{kind}"):
                file.unlink(missing_ok=True)
    stamp.write_text(digest)
    return True


def discard_damaged(folder: str, name: str) -> bool:
    """Drop what is cached of one kernel, which could not be read; returns whether there was anything.

    numba does not wait until its files are on the disk: a power failure leaves empty ones.
    """
    files = list(Path(folder).glob(f"{name}-*.nb?"))
    for file in files:
        file.unlink(missing_ok=True)
    if files:
        _say_damaged(folder)
    return bool(files)


@functools.cache
def _say_damaged(folder: str) -> None:
    print(f"{folder}: damaged cache of compiled kernels; they are compiled anew", file=sys.stderr)
