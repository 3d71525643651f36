"""Fields by name: installed packages offer them as entry points of the group ``gridreg.fields``."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, get_args, get_type_hints

from torch import nn

from gridreg.errors import ConfigError, InputError, near_names

__all__ = ["field_names", "make_field", "register_field"]

_registered: dict[str, Callable[..., nn.Module]] = {}


def register_field(name: str, constructor: Callable[..., nn.Module]) -> None:
    """Make a field's constructor known by a name, for configurations and checkpoints.

    Args:
        name: as in ``backbone: name``.
        constructor: called as ``constructor(bounds, resolution, generator=..., **options)``.
    """
    _registered[name] = constructor


def field_names() -> list[str]:
    """Names that `make_field` accepts."""
    return sorted({*_registered, *(entry.name for entry in entry_points(group="gridreg.fields"))})


def make_field(name: str, *arguments: Any, **options: Any) -> nn.Module:
    """Construct a field by name.

    Args:
        name: registered with `register_field`, or an entry point of an installed package.
        arguments, options: for its constructor.

    Raises:
        InputError: if there is no field of this name, or its constructor refuses an option.
    """
    constructor = _registered.get(name)
    if constructor is None:
        found = [entry for entry in entry_points(group="gridreg.fields") if entry.name == name]
        if not found:
            known = field_names()
            hint = near_names(name, known)
            raise ConfigError(("backbone",), f"found {name!r}, expected one of {', '.join(known)}{hint}")
        constructor = found[0].load()
    _check_options(constructor, options)
    try:
        return constructor(*arguments, **options)
    except (TypeError, ValueError, RuntimeError, ArithmeticError, MemoryError) as error:
        raise InputError(f"backbone {name!r}: {error}") from error


_KINDS = {int: "an integer", float: "a finite number", bool: "true or false", str: "text"}


def _check_options(constructor: Callable[..., nn.Module], options: dict[str, Any]) -> None:
    """Refuse options of another type than the constructor, or those that it hands the rest to, declare.

    Raises:
        ConfigError: names the option.
    """
    declared: dict[str, Any] = {}
    for cls in getattr(constructor, "__mro__", ()):
        if "__init__" in vars(cls):
            declared = {**get_type_hints(cls.__init__), **declared}
    for key, value in options.items():
        hint = declared.get(key)
        members = get_args(hint) or (hint,)
        if hint is None or not all(member in (*_KINDS, type(None)) for member in members):
            continue
        if not any(_fits(value, member) for member in members):
            expected = " or ".join(_KINDS.get(member, "null") for member in members)
            raise ConfigError(("field", key), f"found {value!r}, expected {expected}")


def _fits(value: Any, kind: type) -> bool:
    if kind is float:
        return type(value) in (int, float) and math.isfinite(value)
    return type(value) is kind
