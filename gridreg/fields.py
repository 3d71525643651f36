"""Fields by name: installed packages offer them as entry points of the group ``gridreg.fields``."""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_args, get_type_hints

from torch import nn

from gridreg.errors import ConfigError, InputError, near_names

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


def import_modules(
    names: Sequence[str], source: str = "", *, beside: Path | None = None, never: Path | None = None
) -> None:
    """Import the modules that register fields, regularizers and compositions of one's own.

    They are found where Python finds modules, and after that beside a file and in the current folder.

    Args:
        names: of the modules.
        source: names what asks for them, in errors.
        beside: the folder of that file.
        never: a folder that may be of somebody else's, such as a run's: no module in it is imported.

    Raises:
        ConfigError: if one cannot be imported.
    """
    places = [str(place.resolve()) for place in (beside, Path()) if place is not None] if names else []
    sys.path += [place for place in dict.fromkeys(places) if place not in sys.path]
    for name in names:
        try:
            found = None if name in sys.modules else importlib.util.find_spec(name.partition(".")[0])
            origins = [] if found is None else [found.origin or "", *(found.submodule_search_locations or ())]
            if never is not None and any(Path(o).resolve().is_relative_to(never.resolve()) for o in origins):
                raise ImportError(f"it lies in {never}, whose code is not run; expected it elsewhere")
            importlib.import_module(name)
        # A module of somebody's may fail in any way, and so does the search for a strange name.
        except Exception as error:
            raise ConfigError(("modules",), f"cannot import {name!r}: {error}", source) from error


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
