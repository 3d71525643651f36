"""Files of a scene: regular ones alone, of bounded size, and found by the names that exporters write."""

from __future__ import annotations

import json
import os
import posixpath
import stat
from pathlib import Path
from typing import Any

from gridreg.errors import InputError

__all__ = [
    "EXTENSIONS",
    "find_inside",
    "list_images",
    "read_bytes",
    "read_json",
    "read_text",
    "resolve_inside",
]

EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
"""Extensions of images, in the order in which they are tried for a name without one."""

_LARGEST = 2**30


def read_bytes(path: str | os.PathLike[str], kind: str = "file", *, most: int = _LARGEST) -> bytes:
    """Read a regular file: a named pipe would wait for ever, and a device never ends.

    Args:
        path: the file.
        kind: what it is called in messages.
        most: bytes that it may hold.

    Raises:
        InputError: when it is missing, cannot be read, is no regular file, or is larger.
    """
    name = os.fspath(path)
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            found = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
            raise InputError(f"{name}: cannot be read (found {found}, expected a file)")
        if status.st_size > most:
            raise InputError(f"{name}: holds {status.st_size} bytes, expected at most {most}")
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{name}: {kind} not found") from None
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from None


def read_text(path: str | os.PathLike[str], kind: str = "file") -> str:
    """Read UTF-8, with or without a byte order mark.

    Raises:
        InputError: see :func:`read_bytes`; when it is not UTF-8.
    """
    try:
        return read_bytes(path, kind).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{os.fspath(path)}: not UTF-8 text at byte {error.start}") from None


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a JSON object, in any of the encodings of Unicode, with or without a byte order mark.

    Raises:
        InputError: when the file is missing, is not JSON or holds something else.
    """
    data = read_bytes(path)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{os.fspath(path)}: not valid JSON ({error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{os.fspath(path)}: found a {type(content).__name__}, expected a JSON object")
    return content


def list_images(folder: Path) -> list[str]:
    """Return the names of the images in a folder, sorted, without hidden files such as macOS leaves.

    Raises:
        InputError: when the folder cannot be read.
    """
    if not folder.is_dir():
        return []
    try:
        return sorted(
            path.name
            for path in folder.iterdir()
            if path.suffix.lower() in EXTENSIONS and path.name[0] != "." and path.is_file()
        )
    except OSError as error:
        raise InputError(f"{folder}: folder cannot be read ({error.strerror})") from None


def resolve_inside(folder: Path, file_path: str, where: str) -> Path:
    """Return the file that :func:`find_inside` finds.

    Raises:
        InputError: when there is none, or as :func:`find_inside`.
    """
    found = find_inside(folder, file_path, where)
    if found is None:
        raise InputError(f"{where}: image {folder / file_path} not found")
    return found


def find_inside(folder: Path, file_path: str, where: str) -> Path | None:
    """Find the file that a frame names inside ``folder`` and nowhere else, or return None.

    The name may lack its extension, separate folders by backslashes (Windows), or differ in case from the
    file's. A folder of images may be a link; a file that is a link must stay in its folder or in the scene.

    Raises:
        InputError: when the name is no relative path, leads out of the folder, or cannot be followed.
    """
    root = folder.resolve()
    if not file_path or "\0" in file_path or posixpath.isabs(file_path):
        raise InputError(f"{where}: file_path {file_path!r} is not a path relative to the scene folder")
    try:
        for stated in dict.fromkeys((file_path, file_path.replace("\\", "/"))):
            # Containment comes first: a path that climbs out must not even tell whether something is there.
            path = Path(os.path.normpath(root / stated))
            if path == root or not path.is_relative_to(root):
                raise InputError(f"{where}: file_path {file_path!r} leads out of the scene folder {folder}")
            found = _existing(root, path)
            if found is not None:
                resolved = found.resolve()
                if not any(resolved.is_relative_to(place) for place in (root, found.parent.resolve())):
                    raise InputError(
                        f"{where}: file_path {file_path!r} leads out of the scene folder {folder}"
                    )
                return resolved
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where}: file_path {file_path!r} cannot be followed") from None
    return None


def _existing(root: Path, path: Path) -> Path | None:
    for extension in ("", *EXTENSIONS, *(e.upper() for e in EXTENSIONS)):
        candidate = path.with_name(path.name + extension)
        if candidate.is_file():
            return candidate
    place = root
    for part in path.relative_to(root).parts:
        if not place.is_dir():
            return None
        wanted = {part.lower()} | {part.lower() + e for e in EXTENSIONS if place == path.parent}
        same = [part] if (place / part).exists() else [n for n in os.listdir(place) if n.lower() in wanted]
        if len(same) != 1:
            return None
        place = place / same[0]
    return place if place.is_file() else None
