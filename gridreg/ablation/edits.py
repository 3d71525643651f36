"""Compositions as plain data, taken apart and put together: find, remove, replace and add single regularizers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from gridreg.base import REGISTRY
from gridreg.compositions.named import RETIRED, composition, composition_names
from gridreg.compositions.plain_data import from_config, to_config
from gridreg.errors import ConfigError, InputError, near_names
from gridreg.training.presets import load_preset, preset_names
from gridreg.training.typed_data import from_data

Plain = list[dict[str, Any]]
"""A composition as `gridreg.to_config` writes it."""


def normalised(entries: Any) -> Plain:
    """The composition with every argument written out, so that equal compositions are equal data.

    Entries may be bare names: ``[RandomBackground]`` is ``[{name: RandomBackground}]``.

    Raises:
        InputError: for unknown regularizers and arguments.

    Example:
        >>> normalised([{"name": "L1", "site": "density"}])
        [{'name': 'L1', 'site': 'density', 'weight': 8e-05}]
    """
    if not isinstance(entries, (list, tuple)):
        raise InputError(f"found {entries!r}, expected a list of regularizers")
    return to_config(from_config([{"name": e} if isinstance(e, str) else e for e in entries]))


def known_composition(name: str) -> Plain:
    """A composition by its name, or by the name of the preset that holds it.

    Args:
        name: ``NAME``, or where a composition and a preset of one name differ, ``composition:NAME`` or ``preset:NAME``.

    Raises:
        InputError: if there is neither, with the names there are, or if both are there and differ.
    """
    kind, _, bare = name.rpartition(":")
    found: list[Plain] = []
    if kind == "composition" or (not kind and bare in (*composition_names(), *RETIRED)):
        found.append(to_config(composition(bare)))
    if kind == "preset" or (not kind and bare in preset_names()):
        held = load_preset(bare).composition
        found.append(to_config(composition(held)) if isinstance(held, str) else normalised(held))
    if len(found) == 2 and found[0] != found[1]:
        raise InputError(
            f"composition {name!r}: a composition and a preset have this name and differ; "
            f"write composition:{bare} or preset:{bare}"
        )
    if not found:
        valid = sorted({*composition_names(), *preset_names()})
        raise InputError(
            f"unknown composition {name!r}, expected one of {', '.join(valid)}{near_names(name, valid)}"
        )
    return found[0]


def title_of(regularizer: Mapping[str, Any]) -> str:
    """Name and site of a regularizer, for labels.

    Example:
        >>> title_of({"name": "L1", "site": "density"}), title_of({"name": "RandomBackground"})
        ('L1 density', 'RandomBackground')
    """
    site = _site(regularizer)
    return f"{regularizer['name']} {site}" if site else str(regularizer["name"])


def matches(regularizer: Mapping[str, Any], selector: Any) -> bool:
    """Whether a selector means this regularizer.

    Args:
        regularizer: as plain data.
        selector: ``"NAME"``, ``"NAME SITE"`` or ``{name: NAME, site: SITE}`` with either key; the site may hold ``*``.

    Raises:
        InputError: if it is none of these.
    """
    wanted = _selector(selector)
    if wanted.name is not None and regularizer["name"] != wanted.name:
        return False
    return wanted.site is None or fnmatchcase(_site(regularizer), wanted.site)


def removed(plain: Plain, selectors: Any) -> Plain:
    """The composition without the regularizers that any of the selectors means.

    Raises:
        InputError: if a selector means none of them.
    """
    for selector in _listed(selectors, "remove"):
        _check_match(plain, selector, "remove")
        plain = [regularizer for regularizer in plain if not matches(regularizer, selector)]
    return plain


def replaced(plain: Plain, entries: Any) -> Plain:
    """The composition with single regularizers changed or swapped.

    Args:
        plain: the composition.
        entries: each ``{name:, site:, with: {...}}``: what it means gets the arguments of ``with``; where
            ``with`` holds a name, it takes the place of the whole regularizer (the site stays, unless given).

    Raises:
        InputError: if an entry means none of them, or a regularizer has no such argument.
    """
    for entry in _listed(entries, "replace"):
        if not isinstance(entry, Mapping) or not isinstance(entry.get("with"), Mapping):
            raise ConfigError(
                ("replace",), f"found {entry!r}, expected {{name: NAME, site: SITE, with: {{...}}}}"
            )
        selector = {key: value for key, value in entry.items() if key != "with"}
        _check_match(plain, selector, "replace")
        plain = [_changed(r, entry["with"]) if matches(r, selector) else r for r in plain]
    return normalised(plain)


def added(plain: Plain, entries: Any) -> Plain:
    """The composition with further regularizers at its end."""
    return [*plain, *normalised(_listed(entries, "add"))]


def change_argument(plain: Plain, selector: Any, argument: str, value: Any) -> Plain:
    """The composition with one argument of the selected regularizers set.

    Raises:
        InputError: if the selector means none, or they have no such argument.
    """
    _check_match(plain, selector, "change")
    return normalised([{**r, argument: value} if matches(r, selector) else r for r in plain])


def parts_of(plain: Plain, parts: Any, by: str) -> dict[str, Plain]:
    """The composition in named parts.

    Args:
        plain: the composition.
        parts: selectors (one or a list) by the name of the part; None: made from ``by``.
        by: ``name`` (all regularizers of a class are one part), ``site``, or ``each``.

    Raises:
        InputError: for parts that hold nothing, or share a regularizer.
    """
    keys = {"name": lambda r: str(r["name"]), "site": lambda r: _site(r) or str(r["name"]), "each": title_of}
    found: dict[str, Plain] = {}
    if parts is None:
        if by not in keys:
            raise ConfigError(("by",), f"found {by!r}, expected one of {', '.join(keys)}")
        for regularizer in plain:
            found.setdefault(keys[by](regularizer), []).append(regularizer)
        return found
    if not isinstance(parts, Mapping) or not parts:
        raise ConfigError(("parts",), f"found {parts!r}, expected names of parts, each with its regularizers")
    taken: dict[int, str] = {}
    for name, selectors in parts.items():
        for selector in selectors if isinstance(selectors, list) else [selectors]:
            _check_match(plain, selector, f"parts: {name}")
            for index, regularizer in enumerate(plain):
                if matches(regularizer, selector) and taken.setdefault(index, name) != name:
                    twice = f"{title_of(regularizer)} is in {taken[index]!r} and in {name!r}; expected once"
                    raise ConfigError(("parts",), twice)
        found[name] = [regularizer for index, regularizer in enumerate(plain) if taken.get(index) == name]
    return found


def _changed(regularizer: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    if "name" not in changes:
        return {**regularizer, **changes}
    kept = {"site": regularizer["site"]} if "site" in regularizer and "site" not in changes else {}
    return {**kept, **changes}


def _site(regularizer: Mapping[str, Any]) -> str:
    """The site as text: its name, or the pattern of a selector."""
    site = regularizer.get("site")
    if isinstance(site, Mapping):
        return (
            " ".join(str(site[kind]) for kind in ("parameters", "outputs", "inputs") if kind in site)
            or "site"
        )
    return "" if site is None else str(site)


@dataclass(frozen=True)
class _Selector:
    name: str | None = None
    site: str | None = None


def _selector(selector: Any) -> _Selector:
    if isinstance(selector, str) and selector.strip():
        name, _, site = selector.strip().partition(" ")
        found = _Selector(name, site.strip() or None)
    elif isinstance(selector, Mapping) and selector:
        found = from_data(_Selector, selector, source="")
    else:
        raise InputError(f"found {selector!r}, expected NAME, NAME SITE or {{name: NAME, site: SITE}}")
    if found.name is not None and found.name not in REGISTRY:
        raise InputError(f"unknown regularizer {found.name!r}{near_names(found.name, sorted(REGISTRY))}")
    return found


def _check_match(plain: Plain, selector: Any, key: str) -> None:
    if not [regularizer for regularizer in plain if matches(regularizer, selector)]:
        there = ", ".join(title_of(r) for r in plain) or "no regularizer at all"
        shown = selector if isinstance(selector, str) else " ".join(str(v) for v in dict(selector).values())
        problem = f"found {shown!r}, which the composition does not have; it has {there}"
        raise ConfigError((key,), problem)


def _listed(value: Any, key: str) -> list[Any]:
    if isinstance(value, (str, Mapping)):
        return [value]
    if not isinstance(value, list) or not value:
        raise ConfigError((key,), f"found {value!r}, expected a list of regularizers")
    return value
