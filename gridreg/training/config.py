"""Configuration files and what the command line changes in them.

A frozen dataclass of the caller's is the schema (`gridreg.training.typed_data`), YAML the format
(`gridreg.training.strict_yaml`). A file may leave out whatever has a default; a preset can stand below a file
(``base``), and the command line above both (``override``).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_origin

from gridreg.errors import InputError
from gridreg.training.files import write_text
from gridreg.training.strict_yaml import Document, dump_yaml, parse_yaml, read_yaml
from gridreg.training.typed_data import alternatives, field_types
from gridreg.training.typed_data import from_data as from_data
from gridreg.training.typed_data import to_data as to_data

T = TypeVar("T")


def from_yaml(path: str | os.PathLike[str], cls: type[T], *, base: T | None = None) -> T:
    """Read an instance of the dataclass ``cls`` from a YAML file.

    Args:
        path: the file; an empty one gives ``base``, or the defaults.
        cls: a dataclass with fields as ``from_data`` knows them.
        base: what holds where the file is silent. Nested dataclasses are merged key by key; lists and dicts
            are replaced as a whole.

    Raises:
        ConfigError: one line that names file, line and key of what is wrong.
    """
    return from_data(cls, read_yaml(path), base=base)


def to_yaml(config: Any) -> str:
    """The YAML text of a dataclass instance; ``from_yaml`` reads an equal instance back.

    Raises:
        TypeError: if it holds anything but plain data.
    """
    return dump_yaml(to_data(config))


def save_yaml(path: str | os.PathLike[str], config: Any, *, comment: str = "") -> None:
    """Write ``to_yaml(config)`` to a file, whole or not at all; ``comment`` becomes its first lines.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    write_text(path, head + to_yaml(config))


def override(config: T, changes: Mapping[str, Any], *, source: str = "command line") -> T:
    """A copy of ``config`` with some values replaced; keys are dotted paths such as ``"train.steps"``.

    A path may lead into a dict, whose other keys stay, or to an item of a list by its number. Text is read
    as YAML where the field takes no text: ``{"train.steps": "100"}`` works, and a text field keeps
    ``"0525"`` as it is. All changes take effect together, so values that must agree can change together.

    Raises:
        ConfigError: names ``source`` and the key that is unknown or has a value of the wrong type.
    """
    data = to_data(config)
    for dotted, value in changes.items():
        keys = dotted.split(".")
        with Document(data, source).locating(*keys):
            _change(data, type(config), keys, value)
    return from_data(type(config), data, source=source)


def assignments(texts: Sequence[str]) -> dict[str, str]:
    """Split ``["train.steps=100", ...]``, as given on a command line, into what ``override`` takes.

    Raises:
        InputError: for a text without ``=``, or a key given twice.

    Example:
        >>> assignments(["train.steps=100", "scene=a=b"])
        {'train.steps': '100', 'scene': 'a=b'}
    """
    changes: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise InputError(f"command line: found {text!r}, expected KEY=VALUE such as train.steps=100")
        if key in changes:
            raise InputError(f"command line: {key}: given twice")
        changes[key] = value
    return changes


def _change(data: Any, hint: Any, keys: list[str], value: Any) -> None:
    """Set the value at ``keys`` inside plain ``data``, whose declared type is ``hint``."""
    key, rest = keys[0], keys[1:]
    place: Any
    if isinstance(data, dict):
        place, inner = key, _inner_type(hint, key)
    elif isinstance(data, list) and key.isdecimal() and int(key) < len(data):
        place, inner = int(key), _inner_type(hint, None)
    elif isinstance(data, list):
        raise InputError(f"found {key!r}, expected the number of an item below {len(data)}")
    else:
        raise InputError(f"there is nothing named {key!r} inside {data!r}")
    if not rest:
        data[place] = _value(value, inner)
        return
    if isinstance(data, dict) and data.get(key) is None:
        data[key] = {}
    _change(data[place], inner, rest, value)


def _inner_type(hint: Any, key: str | None) -> Any:
    """The declared type of what stands under ``key`` (``None``: of an item of a list); ``Any`` if unknown."""
    for member in alternatives(hint):
        if dataclasses.is_dataclass(member):
            return field_types(member).get(key or "", Any)  # type: ignore[arg-type]
        arguments: tuple[Any, ...] = getattr(member, "__args__", ())
        if arguments and get_origin(member) is not Literal:
            return arguments[0] if key is None else arguments[-1]
    return Any


def _value(value: Any, hint: Any) -> Any:
    if not isinstance(value, str):
        return to_data(value)
    members = alternatives(hint)
    if bool in members and value in ("true", "false"):
        return value == "true"
    if any(m in (str, Path) or get_origin(m) is Literal for m in members):
        # "null" on the command line means null wherever null is allowed.
        return None if value in ("null", "~") and type(None) in members else value
    return parse_yaml(value).data if value.strip() else value
