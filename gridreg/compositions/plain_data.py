"""Compositions to plain data and back, for YAML files and checkpoints."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any

from gridreg.attach.handle import Handle
from gridreg.attach.selectors import Selector, inputs, outputs, parameters
from gridreg.attach.sites import Site
from gridreg.base import REGISTRY, Regularizer
from gridreg.errors import InputError, near_names
from gridreg.schedules import SCHEDULES, Schedule

_SELECTORS: dict[str, Callable[..., Selector]] = {
    "parameters": parameters,
    "outputs": outputs,
    "inputs": inputs,
}
_SELECTOR_KEYS = ("dim", "channels", "octaves", "spatial", "item", "stack")
# YAML 1.1 reads 1e-4, without a point, as text.
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def to_config(composition: Handle | Iterable[Regularizer]) -> list[dict[str, Any]]:
    """A composition as plain data: dicts, lists, text and numbers.

    Args:
        composition: regularizers in order, or the handle that they were applied with.

    Raises:
        InputError: an argument has no plain form, such as a callable, or a class is not registered.

    >>> import gridreg
    >>> to_config([gridreg.FixedMask("appearance", visible_ratio=0.8)])
    [{'name': 'FixedMask', 'site': 'appearance', 'detach': False, 'visible_ratio': 0.8}]
    """
    regularizers = composition.regularizers if isinstance(composition, Handle) else composition
    return [_regularizer_to_plain(regularizer) for regularizer in regularizers]


def from_config(config: Sequence[Mapping[str, Any]]) -> list[Regularizer]:
    """The composition that `to_config` described; arguments that are left out keep their defaults.

    Raises:
        InputError: an unknown name or argument, listing the valid ones, or a value that the regularizer
            refuses.

    >>> from_config([{"name": "FixedMask", "site": "appearance"}])
    [FixedMask(site='appearance', detach=False, visible_ratio=0.8)]
    """
    if isinstance(config, (str, Mapping)) or not isinstance(config, Sequence):
        raise InputError(f"composition={config!r}: expected a list of mappings with a name each")
    return [_regularizer_from_plain(entry) for entry in config]


def _regularizer_to_plain(regularizer: Regularizer) -> dict[str, Any]:
    name = type(regularizer).__name__
    if REGISTRY.get(name) is not type(regularizer):
        raise InputError(f"{name}: not registered; put @gridreg.register above the class")
    arguments = {
        item.name: _to_plain(getattr(regularizer, item.name), f"{name}.{item.name}")
        for item in fields(regularizer)
    }
    return {"name": name, **arguments}


def _to_plain(value: Any, where: str) -> Any:
    """Plain form of one argument."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, Selector):
        extras = {key: _to_plain(getattr(value, key), where) for key in _SELECTOR_KEYS}
        return {
            value.kind: value.pattern,
            **{key: plain for key, plain in extras.items() if plain is not None},
        }
    if isinstance(value, Site):
        return {
            "mask": [_to_plain(selector, where) for selector in value.selectors("mask")],
            "grids": [_to_plain(selector, where) for selector in value.selectors("grids")],
        }
    if isinstance(value, Schedule):
        name = type(value).__name__
        if SCHEDULES.get(name) is not type(value):
            raise InputError(
                f"{where}={value!r}: not registered; put @gridreg.register_schedule above {name}"
            )
        return {"schedule": name, **{f.name: _to_plain(getattr(value, f.name), where) for f in fields(value)}}
    if isinstance(value, (tuple, list)):
        return [_to_plain(item, where) for item in value]
    hint = (
        "use a schedule, such as gridreg.Linear, or a function at the top of a module"
        if callable(value)
        else "use plain values"
    )
    raise InputError(f"{where}={value!r}: has no plain form; {hint}")


def _regularizer_from_plain(entry: Any) -> Regularizer:
    if not isinstance(entry, Mapping) or "name" not in entry:
        raise InputError(f"composition: found {entry!r}, expected a mapping with the regularizer's name")
    cls = _lookup("regularizer", entry["name"], REGISTRY)
    made: Regularizer = _made(cls, {key: value for key, value in entry.items() if key != "name"})
    return made


def _made(cls: type[Any], arguments: Mapping[str, Any]) -> Any:
    """An instance of a dataclass, with unknown and missing arguments refused by name."""
    valid = {item.name: item for item in fields(cls) if item.init}
    for key in arguments:
        if key not in valid:
            raise InputError(f"{cls.__name__}: " + _unknown("argument", str(key), list(valid)))
    for name, item in valid.items():
        if name not in arguments and item.default is MISSING and item.default_factory is MISSING:
            raise InputError(f"{cls.__name__}: argument {name!r} is missing")
    values = {key: _from_plain(value, f"{cls.__name__}.{key}") for key, value in arguments.items()}
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(f"{cls.__name__}: {error}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{cls.__name__}: {error} (arguments {dict(arguments)!r})") from error


def _from_plain(value: Any, where: str) -> Any:
    """Undo `_to_plain`."""
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)
    if isinstance(value, Mapping):
        if "schedule" in value:
            cls = _lookup("schedule", value["schedule"], SCHEDULES)
            return _made(cls, {key: item for key, item in value.items() if key != "schedule"})
        if "mask" in value or "grids" in value:
            return _site(value, where)
        return _selector(value, where)
    if isinstance(value, (list, tuple)):
        return tuple(_from_plain(item, where) for item in value)
    return value


def _site(value: Mapping[str, Any], where: str) -> Site:
    """A site written out."""
    for key in value:
        if key not in ("mask", "grids"):
            raise InputError(f"{where}: " + _unknown("key", str(key), ["mask", "grids"]))
    parts = {}
    for key, selectors in value.items():
        listed = [selectors] if isinstance(selectors, Mapping) else selectors
        parts[key] = tuple(_selector(selector, where) for selector in listed or ())
    return Site(**parts)


def _selector(value: Any, where: str) -> Selector:
    """A selector: its kind with the pattern, and its arguments."""
    kinds = [kind for kind in _SELECTORS if isinstance(value, Mapping) and kind in value]
    if len(kinds) != 1:
        raise InputError(
            f"{where}: found {value!r}, expected a name, a number, or a mapping with one of "
            "schedule, parameters, outputs, inputs, mask"
        )
    kind = kinds[0]
    for key in value:
        if key != kind and key not in _SELECTOR_KEYS:
            raise InputError(f"{where}: " + _unknown("key", str(key), [kind, *_SELECTOR_KEYS]))
    arguments = {key: item for key, item in value.items() if key != kind}
    try:
        return _SELECTORS[kind](value[kind], **arguments)
    except TypeError as error:
        raise InputError(f"{where}: {error} (found {dict(value)!r})") from None


def _lookup(kind: str, name: Any, known: Mapping[str, Any]) -> Any:
    """A class by its name."""
    if not isinstance(name, str) or name not in known:
        raise InputError(_unknown(kind, str(name), sorted(known)))
    return known[name]


def _unknown(kind: str, name: str, valid: Sequence[str]) -> str:
    """One line: what was found, the nearest, all valid ones."""
    return f"unknown {kind} {name!r}{near_names(name, valid) or ';'} valid: {', '.join(valid)}"
