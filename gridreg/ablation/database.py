"""The SQLite file of a store: opened with care, never overwritten, and its errors in one line.

It is the one truth about runs. A rollback journal instead of a write-ahead log, because that needs nothing of the file
system but locks, and so works on a network file system as well.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

from gridreg.errors import InputError

SCHEMA_VERSION = 1
"""Raised by one whenever an older gridreg could not read what is written."""

APPLICATION_ID = 0x67726567
"""Marks the SQLite file as a store of ours ("greg")."""

_CORRUPT = (
    "the database is corrupt and was left as it is; move it away, and the same command takes the finished "
    "runs in runs/ over into a new one"
)
_REASONS = (
    (("locked", "busy"), "locked by another process for more than {wait:.0f} s; wait for it, or end it"),
    (("readonly", "read-only"), "the store is read-only; expected one that you may write to"),
    (("not a database", "malformed", "corrupt", "could not decode"), _CORRUPT),
    (("unable to open",), "cannot open the database; expected a folder that you may write to"),
    (("full",), "no space left on the disk; free some"),
)


class DiskFullError(InputError):
    """There is no space for results: no fault of a run, and the same for all that would come after it."""


class Database:
    """A file that holds the tables; every operation opens it, works in one transaction, and closes it.

    Args:
        path: of the file.
        wait: seconds to wait for other writers.

    Raises:
        InputError: if it is corrupt, locked, read-only, written by a newer gridreg, or no store.
    """

    def __init__(self, path: Path, *, wait: float = 20.0) -> None:
        self.path = path
        self.wait = wait
        with self.reading() as connection:
            # Before anything is written: what is not ours is left as it is.
            self._is_ours(connection)
        with self.writing() as connection:
            if not self._is_ours(connection):
                for statement in (
                    files("gridreg.ablation").joinpath("schema.sql").read_text("utf-8").split(";")
                ):
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            if connection.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
                raise InputError(f"{self.path}: {_CORRUPT}")

    def reading(self) -> contextlib.AbstractContextManager[sqlite3.Connection]:
        """A connection for queries that see one moment."""
        return self._transaction("BEGIN")

    def writing(self) -> contextlib.AbstractContextManager[sqlite3.Connection]:
        """A connection that no other writer interferes with; what an exception leaves behind is undone."""
        return self._transaction("BEGIN IMMEDIATE")

    @contextmanager
    def decoding(self) -> Iterator[None]:
        """A block that makes records of rows: what does not fit was damaged, below what SQLite itself checks."""
        try:
            yield
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f"{self.path}: {_CORRUPT}") from error

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(
                sqlite3.connect(self.path, timeout=self.wait, isolation_level=None)
            ) as connection:
                connection.row_factory = sqlite3.Row
                # A finished run is on the disk, also after a power failure.
                connection.execute("PRAGMA synchronous=FULL")
                connection.execute(begin)
                try:
                    yield connection
                except BaseException:
                    # SQLite itself has rolled back already after some errors, such as a full disk.
                    if connection.in_transaction:
                        connection.execute("ROLLBACK")
                    raise
                connection.execute("COMMIT")
        except UnicodeDecodeError as error:
            # Of the names in the schema, which SQLite's own messages repeat.
            raise InputError(f"{self.path}: {_CORRUPT}") from error
        except sqlite3.Error as error:
            text = str(error).lower()
            reason = next((reason for words, reason in _REASONS if any(word in text for word in words)), None)
            told = reason.format(wait=self.wait) if reason else f"the database cannot be used: {error}"
            kind = DiskFullError if "full" in text else InputError
            raise kind(f"{self.path}: {' '.join(told.split())}") from error

    def _is_ours(self, connection: sqlite3.Connection) -> bool:
        """Whether the tables are there; refuses what is not ours to write to."""
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        tables = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if application == 0 and version == 0 and tables == 0:
            return False
        if application != APPLICATION_ID:
            raise InputError(f"{self.path}: an SQLite database of another program; choose another folder")
        if version > SCHEMA_VERSION:
            raise InputError(
                f"{self.path}: a store of version {version}, written by a newer gridreg; expected at most "
                f"{SCHEMA_VERSION}; upgrade gridreg to use it"
            )
        return True
