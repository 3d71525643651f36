"""Files that are whole or not there: written beside their name, then renamed over it.

A run may be killed at any moment and a disk may fill up at any byte. Every function here leaves what stood
under the name untouched until the new content is complete (POSIX ``rename`` replaces a file in one step),
takes its temporary file away when something fails, and turns the ``OSError`` of an unwritable place into a
one-line ``InputError``.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gridreg.errors import InputError
from gridreg.machine import remove_left_behind, temporary_beside

try:
    import fcntl
except ImportError:  # Windows has no such lock.
    fcntl = None  # type: ignore[assignment]

_REASONS = {
    errno.ENOSPC: "no space left on the disk; free some or choose another place",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another place",
    errno.EFBIG: "the file would exceed the largest size allowed here; choose another place",
    errno.EACCES: "permission denied; choose a place that you may write to",
    errno.EPERM: "not permitted; choose a place that you may write to",
    errno.EROFS: "the file system is read-only; choose another place",
    errno.EEXIST: "a file stands where a folder is expected; choose another name",
    errno.ENOTDIR: "a file stands where a folder is expected; choose another name",
    errno.EISDIR: "a folder stands where a file is expected; choose another name",
    errno.ENAMETOOLONG: "the name is too long",
}


@contextmanager
def output_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn an ``OSError`` raised inside into one readable line that names ``path``.

    Raises:
        InputError: for any ``OSError`` (full disk, no permission, read-only, a file in the way, ...).
    """
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0, error.strerror or str(error))
        raise InputError(f"{os.fspath(path)}: cannot write here: {reason}") from error


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; on leaving it takes the place of ``path``.

    The temporary name keeps the suffix, because image and video writers choose the format by it. The content
    is flushed to the disk before the rename, so a power failure leaves the old file or the new one. When the
    block raises, the temporary file is removed and ``path`` stays as it was.

    Raises:
        InputError: if the place is not writable or the disk is full.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with writing(Path(folder) / "a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     (Path(folder) / "a.txt").read_text()
        'whole'
    """
    path = Path(path)
    temporary = temporary_beside(path)
    with output_errors(path):
        try:
            yield temporary
            flush(temporary)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A new folder to fill; on leaving it takes the place of the folder ``path``, which stays if the block raises.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    scratch = temporary_beside(path)
    with output_errors(path):
        try:
            (scratch / "new").mkdir(parents=True)
            yield scratch / "new"
            if path.is_dir():
                os.replace(path, scratch / "old")
            os.replace(scratch / "new", path)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def one_writer(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Hold a folder for one process; the hold dies with the process, whatever ends it.

    Where files cannot be locked (Windows, some network disks), nobody is kept out.

    Raises:
        InputError: if another process holds it, or the place is not writable.
    """
    if fcntl is None:
        yield
        return
    place = Path(folder) / ".writer"
    with output_errors(folder):
        while True:
            lock = place.open("a+")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                raise InputError(
                    f"{os.fspath(folder)}: another run is writing here; wait for it, or choose another output folder"
                ) from None
            except OSError:
                break
            try:
                if place.stat().st_ino == os.fstat(lock.fileno()).st_ino:
                    break
            except FileNotFoundError:
                pass
            # Whoever held it has taken the file away since it was opened here.
            lock.close()
    try:
        yield
    finally:
        place.unlink(missing_ok=True)
        lock.close()


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write ``data`` to ``path``, whole or not at all.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` to ``path`` in UTF-8, whole or not at all.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | os.PathLike[str], value: Any, *, sort_keys: bool = True) -> None:
    """Write ``value`` as indented JSON, keys sorted, whole or not at all.

    Floats are written so that they read back bit for bit. JSON knows no infinity and no NaN; a caller that
    has them turns them into text first (``gridreg.training.metrics.json_ready``).

    Raises:
        InputError: if the place is not writable or the disk is full.
        ValueError: if ``value`` holds an infinity or a NaN.
        TypeError: if ``value`` holds something that JSON does not know.
    """
    text = json.dumps(value, indent=2, sort_keys=sort_keys, allow_nan=False, ensure_ascii=False)
    # Of a file name that is not UTF-8 Python keeps lone surrogates; escaped, they are JSON again.
    write_bytes(path, (text + "\n").encode("utf-8", "backslashreplace"))


def check_output_folder(path: str | os.PathLike[str]) -> Path:
    """Create the folder if need be and prove that it can be written to, before hours of work depend on it.

    Temporary files that a killed process left in it are removed.

    Returns:
        The folder as a ``Path``.

    Raises:
        InputError: if it is a file, cannot be created, or cannot be written to.
    """
    folder = Path(path)
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_left_behind(folder)
        probe = temporary_beside(folder / "probe")
        try:
            # Some bytes, because an empty file still fits on a full disk.
            probe.write_bytes(b"\0" * 4096)
        finally:
            probe.unlink(missing_ok=True)
    return folder


def remove_folder(path: str | os.PathLike[str]) -> None:
    """Remove a folder and what is in it; nothing happens if there is none.

    Raises:
        InputError: if it cannot be removed.
    """
    with output_errors(path):
        try:
            shutil.rmtree(path)
        except FileNotFoundError:
            return


def flush(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
