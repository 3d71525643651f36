"""Checkpoints that survive a kill at any moment, and say so when they are damaged.

A checkpoint is a folder: ``tensors.safetensors`` with every tensor, and ``state.json`` with the rest, its
format version, the scene's fingerprint, the configuration and the checksums of both. No pickle is written
or read.

A folder cannot be replaced in one step, so the new one is completed as ``.NAME.new``, then ``NAME`` becomes
``.NAME.old``, ``.NAME.new`` becomes ``NAME``, and ``.NAME.old`` goes. Whatever moment the process dies in,
one complete checkpoint stands under one of the three names, and reading finds it:

========================  ================  ==========================
died while                left on the disk  read
========================  ================  ==========================
writing the new one       NAME, part .new   NAME
between the two renames   .old, .new        .new, complete by then
removing the old one      NAME, part .old   NAME
========================  ================  ==========================
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from gridreg.errors import InputError
from gridreg.machine import check_memory
from gridreg.training.files import flush, output_errors, remove_folder, write_json
from gridreg.training.state_tree import flatten_state, unflatten_state

FORMAT_VERSION = 1
"""Raised by one whenever an older gridreg could not read what is written."""

_FORMAT = "gridreg checkpoint"
_TENSORS = "tensors.safetensors"
_STATE = "state.json"


@dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint, as ``load_checkpoint`` read it.

    Args:
        state: the nested state as it was saved, tensors on the CPU.
        config: the configuration of the run, plain data.
        fingerprint: of the scene it was trained on.
    """

    state: Any
    config: Any
    fingerprint: str


def save_checkpoint(
    folder: str | os.PathLike[str],
    state: Any,
    *,
    config: Mapping[str, Any] | None = None,
    fingerprint: str = "",
) -> None:
    """Replace the checkpoint in ``folder``; at any moment either the old or the new one is there, whole.

    Args:
        folder: the checkpoint's own folder; its parent must exist.
        state: nested dicts, lists and tuples of tensors, numbers, text and ``None`` (see ``flatten_state``).
        config: the configuration of the run, plain data.
        fingerprint: of the scene, compared when the run is resumed.

    Raises:
        InputError: if the place is not writable or the disk is full; the old checkpoint stays.
        TypeError: if the state holds something that cannot be saved; the old checkpoint stays.
    """
    folder, new, old = _names(folder)
    tensors, tree = flatten_state(state)
    plain = flatten_state(config)[1]
    with output_errors(folder):
        _refuse_foreign(folder)
        _settle(folder, new, old)
        try:
            new.mkdir()
            content = {
                "format": _FORMAT,
                "version": FORMAT_VERSION,
                "fingerprint": fingerprint,
                "config": plain,
                "state": tree,
                "tensors": _write_tensors(new / _TENSORS, tensors),
            }
            write_json(new / _STATE, {**content, "sha256": _digest(content)}, sort_keys=False)
        except BaseException:
            remove_folder(new)
            raise
        if folder.exists():
            os.rename(folder, old)
        os.rename(new, folder)
        remove_folder(old)


def _write_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Write a file of tensors from where they lie; returns its size and checksum."""
    # The library makes files that nobody else may read; this one is to have the usual permissions.
    path.touch()
    mode = path.stat().st_mode
    try:
        safetensors.torch.save_file(tensors, path)
    except SafetensorError as error:
        number = re.search(r"os error (\d+)", str(error))
        raise OSError(int(number[1]) if number else 0, str(error)) from error
    path.chmod(mode)
    flush(path)
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
        return {"bytes": file.tell(), "sha256": digest.hexdigest()}


def load_checkpoint(folder: str | os.PathLike[str], *, fingerprint: str | None = None) -> Checkpoint:
    """Read the checkpoint in ``folder``, also one whose replacement was interrupted; nothing is changed.

    Args:
        folder: as given to ``save_checkpoint``.
        fingerprint: the scene's, to refuse a checkpoint of another one; ``None`` accepts any.

    Raises:
        InputError: one line, if there is none, it is damaged, it is of another scene, or a newer gridreg
            wrote it.
    """
    found = _current(*_names(folder))
    if found is None:
        raise InputError(
            f"{os.fspath(folder)}: no checkpoint here, expected a folder with {_STATE} and {_TENSORS}"
        )
    with sound(found):
        content, data = _read(found)
        theirs = content["fingerprint"]
    if fingerprint is not None and theirs != fingerprint:
        raise InputError(
            f"{found}: a checkpoint of another scene (fingerprint {str(theirs)[:12]!r}, expected "
            f"{fingerprint[:12]!r}); choose another output folder, or the scene that it was trained on"
        )
    with sound(found):
        state = unflatten_state(safetensors.torch.load(data), content["state"])
        return Checkpoint(state, unflatten_state({}, content["config"]), str(theirs))


@contextmanager
def sound(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what the content of a checkpoint makes its readers raise into one line: it may be anybody's.

    Raises:
        InputError: if the block raised what values of another kind, shape or size than a run's lead to.
    """
    try:
        yield
    except InputError:
        raise
    except (
        *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError),
        *(AssertionError, MemoryError, SafetensorError),
    ) as error:
        lines = str(error).split("\n")
        raise _damaged(Path(folder), f"{type(error).__name__}: {lines[0]}") from error


def has_checkpoint(folder: str | os.PathLike[str]) -> bool:
    """Whether ``load_checkpoint`` would find a checkpoint, also after an interrupted replacement."""
    return _current(*_names(folder)) is not None


def _names(folder: str | os.PathLike[str]) -> tuple[Path, Path, Path]:
    folder = Path(folder)
    # Of a link to a larger disk, what it leads to is replaced, on that disk, and the link stays.
    if not folder.name or folder.is_symlink():
        folder = Path(os.path.realpath(folder))
    # Hidden, because somebody may well keep a copy under a name like checkpoint.old.
    return folder, folder.with_name(f".{folder.name}.new"), folder.with_name(f".{folder.name}.old")


def _current(folder: Path, new: Path, old: Path) -> Path | None:
    """The folder to read: see the table above."""
    if folder.exists():
        return folder
    if new.exists():
        try:
            with sound(new):
                _read(new)
        except InputError:
            # Died during the very first save, or the disk lost what it had confirmed.
            return old if old.exists() else None
        return new
    return old if old.exists() else None


def _refuse_foreign(folder: Path) -> None:
    """Keep a folder of somebody's from being taken for an old checkpoint and removed."""
    names = {entry.name for entry in folder.iterdir()} if folder.exists() else set()
    if names and names.isdisjoint({_STATE, _TENSORS}):
        raise InputError(
            f"{folder}: stands already and is no checkpoint; choose another name, it is not replaced"
        )


def _settle(folder: Path, new: Path, old: Path) -> None:
    """Finish what an interrupted save left, so that the current checkpoint stands under its own name."""
    current = _current(folder, new, old)
    if current is not None and current != folder:
        os.rename(current, folder)
    remove_folder(new)
    remove_folder(old)


def _read(folder: Path) -> tuple[dict[str, Any], bytes]:
    """The content of ``state.json`` and the bytes of the tensors, both verified."""
    for path in (folder / _STATE, folder / _TENSORS):
        # A pipe would wait for ever, and a device never ends.
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: found no regular file, expected one")
    try:
        # Bytes, and the tensors made of them.
        check_memory(2 * (folder / _TENSORS).stat().st_size, f"{folder / _TENSORS}")
        check_memory(20 * (folder / _STATE).stat().st_size, f"{folder / _STATE}")
        content = json.loads((folder / _STATE).read_bytes())
        data = (folder / _TENSORS).read_bytes()
    except FileNotFoundError as error:
        raise _damaged(folder, f"{Path(error.filename).name} is missing") from error
    except OSError as error:
        raise InputError(f"{folder}: cannot read the checkpoint: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise _damaged(folder, f"{_STATE} is cut off or not JSON") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise InputError(f"{folder}: {_STATE} is not that of a {_FORMAT}")
    version = content.get("version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise InputError(
            f"{folder}: checkpoint format {version}, written by a newer gridreg; "
            f"expected at most {FORMAT_VERSION}; upgrade gridreg to read it"
        )
    if content.pop("sha256", None) != _digest(content):
        raise _damaged(folder, f"the checksum of {_STATE} does not fit")
    expected = content["tensors"]
    if len(data) != expected["bytes"]:
        raise _damaged(folder, f"{_TENSORS} has {len(data)} bytes, expected {expected['bytes']}")
    if hashlib.sha256(data).hexdigest() != expected["sha256"]:
        raise _damaged(folder, f"the checksum of {_TENSORS} does not fit")
    return content, data


def _damaged(folder: Path, why: str) -> InputError:
    return InputError(
        f"{folder}: damaged checkpoint: {why}; restore a copy, or start again in another folder"
    )


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()
