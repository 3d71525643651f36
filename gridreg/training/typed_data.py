"""Nested frozen dataclasses to and from plain data, strictly: every key known, every value of its type.

The dataclass is the schema; nothing about it is repeated here. Errors name where the value stands, its key,
what was found and what is expected; unknown keys come with the valid ones and the near ones.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

from gridreg.errors import RENAMED_KEYS, KeyPath
from gridreg.training.strict_yaml import Document

T = TypeVar("T")
# A thousand runs of a store are a thousand times the same class.
_type_hints = functools.cache(typing.get_type_hints)

# Of integers: what NumPy, torch and SQLite can hold.
_LARGEST = 2**63 - 1
_SCALARS = {int: "an integer", float: "a number", bool: "true or false", str: "text", Path: "a path"}


def from_data(
    cls: type[T],
    data: Any,
    *,
    source: str = "config",
    base: T | None = None,
) -> T:
    """Build an instance of the dataclass ``cls`` from plain data.

    Fields may be dataclasses, ``int``, ``float`` (which takes integers too), ``bool``, ``str``, ``Path``,
    ``Literal``, unions, ``list``, ``tuple``, ``dict[str, ...]`` and ``Any``.

    Args:
        cls: the dataclass.
        data: a mapping of its keys to plain data, or a `Document` of one, whose lines errors then name; what it leaves
            out has the default, or the value in ``base``.
        source: names data that are no `Document` in errors.
        base: what holds where the data are silent, instead of the defaults. Nested dataclasses are merged
            key by key; lists and dicts are replaced as a whole.

    Raises:
        ConfigError: names source, line and key of what is wrong. A check of the dataclass itself raises it with a path
            inside the dataclass.
        TypeError: if ``cls`` declares a field of a type not listed above.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Settings:
        ...     steps: int = 100
        >>> from_data(Settings, {"steps": 5})
        Settings(steps=5)
        >>> from_data(Settings, {"step": 5})
        Traceback (most recent call last):
        gridreg.errors.ConfigError: config: step: unknown key, did you mean steps? valid: steps
    """
    if isinstance(data, Document):
        # An empty file says nothing, and all of it has defaults.
        return _Reader(data).build(cls, {} if data.data is None else data.data, (), base)
    return _Reader(Document(data, source)).build(cls, data, (), base)


def to_data(value: Any) -> Any:
    """Plain data (dict, list, text, numbers, ``None``) of a dataclass instance, or of anything inside one.

    Raises:
        TypeError: if it holds anything else.

    Example:
        >>> to_data((1, Path("out"), {"weight": 8e-5}))
        [1, 'out', {'weight': 8e-05}]
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: to_data(getattr(value, f.name))
            for f in dataclasses.fields(value)
            # What came later and is not used leaves no trace: records of before stay equal.
            if f.init and not (f.metadata.get("unset") and getattr(value, f.name) == f.default)
        }
    if isinstance(value, Mapping):
        return {str(key): to_data(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_data(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise TypeError(f"config holds {value!r} of type {type(value).__name__}, which is not plain data")


def field_types(cls: type[Any]) -> dict[str, Any]:
    """The declared type of every field that a dataclass takes when it is built."""
    hints = _type_hints(cls)  # type: ignore[arg-type]
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The members of a union, or the type alone."""
    return typing.get_args(hint) if typing.get_origin(hint) in (Union, types.UnionType) else (hint,)


class _Reader:
    """Builds dataclasses from plain data and knows where each piece of it stands."""

    def __init__(self, document: Document) -> None:
        self.error = document.error
        self.locating = document.locating

    def build(self, cls: type[T], data: Any, path: KeyPath, base: T | None) -> T:
        """An instance of ``cls``, or an error that names the key below ``path``."""
        if not isinstance(data, Mapping):
            raise self.error(path, f"found {_shown(data)}, expected a mapping of keys to values")
        hints = field_types(cls)
        for key in data:
            if key not in hints:
                raise self.error((*path, key), _unknown(str(key), cls))
        values: dict[str, Any] = {}
        for field in dataclasses.fields(cls):  # type: ignore[arg-type]
            name = field.name
            if name in data:
                below = getattr(base, name) if base is not None else None
                values[name] = self.convert(data[name], hints[name], (*path, name), below)
            elif name in hints and base is not None:
                values[name] = getattr(base, name)
            elif (
                name in hints
                and field.default is dataclasses.MISSING
                and field.default_factory is dataclasses.MISSING
            ):
                raise self.error((*path, name), f"missing, expected {_expected(hints[name])}")
        with self.locating(*path):
            return cls(**values)

    def convert(self, value: Any, hint: Any, path: KeyPath, base: Any = None) -> Any:
        """The value as the declared type ``hint``, or an error that names ``path``."""
        members = alternatives(hint)
        for member in members:
            if member is int and type(value) is int and abs(value) > _LARGEST:
                raise self.error(path, f"found {_shown(value)}, expected an integer of at most 64 bits")
            if member is Any:
                return self.plain(value, path)
            if member in (int, bool, str, type(None)) and type(value) is member:
                return value
            if member is float and type(value) is float and not math.isnan(value):
                return value
            if typing.get_origin(member) is Literal and _is_one_of(value, typing.get_args(member)):
                return value
        for member in members:
            origin, arguments = typing.get_origin(member), typing.get_args(member)
            if member is float and type(value) is int and abs(value) <= _LARGEST:
                return float(value)
            if member is Path and type(value) is str:
                return Path(value)
            if dataclasses.is_dataclass(member) and isinstance(value, Mapping):
                below = base if isinstance(base, typing.cast(type, member)) else None
                return self.build(typing.cast("type[Any]", member), value, path, below)
            if (origin or member) in (dict, Mapping) and isinstance(value, Mapping):
                inner = arguments[1] if arguments else Any
                return {key: self.convert(item, inner, (*path, key)) for key, item in value.items()}
            if (origin or member) is list and isinstance(value, (list, tuple)):
                inner = arguments[0] if arguments else Any
                return [self.convert(item, inner, (*path, i)) for i, item in enumerate(value)]
            if (origin or member) is tuple and isinstance(value, (list, tuple)):
                return self.convert_tuple(value, arguments, path)
        raise self.error(path, f"found {_shown(value)}, expected {_expected(hint)}")

    def plain(self, value: Any, path: KeyPath) -> Any:
        """Any plain value, without NaN, which passes every check of a range, and integers that nothing can hold."""
        if isinstance(value, float) and math.isnan(value):
            raise self.error(path, "found nan, expected a number")
        if isinstance(value, int) and abs(value) > _LARGEST:
            raise self.error(path, f"found {_shown(value)}, expected at most 64 bits")
        items = value.items() if isinstance(value, Mapping) else ()
        for key, inner in enumerate(value) if isinstance(value, (list, tuple)) else items:
            self.plain(inner, (*path, key))
        return value

    def convert_tuple(self, value: Any, arguments: tuple[Any, ...], path: KeyPath) -> tuple[Any, ...]:
        """The items as the declared types of a tuple."""
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            arguments = (arguments[0],) * len(value)
        elif len(arguments) != len(value):
            raise self.error(path, f"found {len(value)} items, expected {len(arguments)}")
        pairs = zip(value, arguments, strict=True)
        return tuple(self.convert(item, inner, (*path, i)) for i, (item, inner) in enumerate(pairs))


def _is_one_of(value: Any, choices: tuple[Any, ...]) -> bool:
    # True equals 1 in Python, but not in a configuration.
    return any(type(value) is type(choice) and value == choice for choice in choices)


def _expected(hint: Any) -> str:
    """A type in words."""
    members = alternatives(hint)
    if len(members) > 1:
        return " or ".join(_expected(member) for member in members)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in _SCALARS:
        return _SCALARS[hint]
    if hint is type(None):
        return "null"
    if hint is Any:
        return "any value"
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if dataclasses.is_dataclass(hint) or (origin or hint) in (dict, Mapping):
        return "a mapping of keys to values"
    if (origin or hint) is list or (origin is tuple and arguments[1:] == (Ellipsis,)):
        return f"a list (each item {_expected(arguments[0])})" if arguments else "a list"
    if origin is tuple:
        return "a list of " + ", ".join(_expected(argument) for argument in arguments)
    raise TypeError(f"{hint} is not supported in a configuration")


def _shown(value: Any) -> str:
    """A value as its YAML, shortened to fit into a line."""
    if isinstance(value, Mapping):
        return "a mapping" if value else "an empty mapping"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    words = {None: "null", True: "true", False: "false"}
    if isinstance(value, int) and abs(value) > _LARGEST:
        # Python refuses to write out very long ones.
        return f"an integer of {value.bit_length()} bits"
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _unknown(key: str, cls: type[Any]) -> str:
    valid = list(field_types(cls))
    if RENAMED_KEYS.get(key) in valid:
        return f"unknown key; it is called {RENAMED_KEYS[key]} now. valid: {', '.join(valid)}"
    names = _dotted_names(cls, "")
    near = difflib.get_close_matches(key, valid, n=3) + [n for n in names if n.endswith(f".{key}")]
    hint = f", did you mean {' or '.join(near)}?" if near else ";"
    return f"unknown key{hint} valid: {', '.join(valid)}"


def _dotted_names(cls: type[Any], prefix: str) -> list[str]:
    names = []
    for name, hint in field_types(cls).items():
        names.append(prefix + name)
        for member in alternatives(hint):
            if dataclasses.is_dataclass(member):
                names += _dotted_names(typing.cast("type[Any]", member), f"{prefix}{name}.")
    return names
