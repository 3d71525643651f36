"""A folder of files as bytes, for workers that share no disk with the store."""

from __future__ import annotations

import io
import secrets
import tarfile
from pathlib import Path, PurePosixPath

from gridreg.errors import InputError
from gridreg.training.files import output_errors, remove_folder

__all__ = ["pack_folder", "unpack_folder"]


def pack_folder(folder: Path) -> bytes:
    """Every file below a folder; nothing if there is no folder.

    Raises:
        InputError: if a file cannot be read.
    """
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.is_symlink():
                try:
                    archive.add(path, arcname=path.relative_to(folder).as_posix(), recursive=False)
                except OSError as error:
                    raise InputError(f"{path}: cannot read: {error.strerror}") from error
    return buffer.getvalue()


def unpack_folder(data: bytes, folder: Path) -> None:
    """Make ``folder`` what `pack_folder` saw; what stood there goes when the new content is complete.

    Raises:
        InputError: if the bytes are no such archive, or the place is not writable.
    """
    fresh = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.new")
    with output_errors(folder):
        fresh.mkdir(parents=True)
        try:
            _extract(data, fresh, folder)
            remove_folder(folder)
            fresh.rename(folder)
        except BaseException:
            remove_folder(fresh)
            raise


def _extract(data: bytes, fresh: Path, folder: Path) -> None:
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r") as archive:
            for member in archive:
                name = PurePosixPath(member.name)
                # What a worker sends is written below this folder and nowhere else.
                if not member.isfile() or name.is_absolute() or ".." in name.parts:
                    raise InputError(
                        f"{folder}: found {member.name!r} in what a worker sent, expected plain files"
                    )
                content = archive.extractfile(member)
                target = fresh / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(b"" if content is None else content.read())
    except tarfile.TarError as error:
        raise InputError(f"{folder}: what a worker sent is damaged: {error}") from error
