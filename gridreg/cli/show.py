"""``gridreg show``: what there is to choose, by name."""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal

import tyro

from gridreg.errors import InputError, near_names


@dataclass
class ShowOptions:
    """List what there is to choose, or show one of it: a preset's file, a protocol's views, a regularizer's formula."""

    kind: Annotated[
        Literal["presets", "compositions", "protocols", "regularizers", "config"],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="KIND"),
    ]
    """What to list: presets, compositions, protocols, regularizers, or config, the keys of a configuration with their
    defaults."""
    name: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME", help_behavior_hint="")
    ] = None
    """Show this one; of `config` a key, or a preset, whose whole configuration is printed as YAML."""


def run(options: ShowOptions) -> int:
    """Print it.

    Raises:
        InputError: for a name that is none of the kind.
    """
    all_of, one = _KINDS[options.kind]
    known = all_of()
    if options.name is None:
        width = max(map(len, known))
        print("\n".join(f"{name:<{width}}  {about}".rstrip() for name, about in known.items()))
        return 0
    shown = one(options.name) if options.name in known else _beyond(options)
    if shown is None:
        near = near_names(options.name, known)
        raise InputError(f"{options.kind}: found {options.name!r}, expected one of {', '.join(known)}{near}")
    print(shown.rstrip("\n"))
    return 0


def _beyond(options: ShowOptions) -> str | None:
    """Text of what is not listed by its name: a counted protocol, a preset's whole configuration."""
    from gridreg.training.config import to_yaml
    from gridreg.training.presets import load_preset, preset_names

    if options.kind == "protocols":
        return _protocol(str(options.name))
    if options.kind == "config" and options.name in preset_names():
        return to_yaml(load_preset(str(options.name)))
    return None


def _presets() -> dict[str, str]:
    from gridreg.training.presets import preset_names, preset_text

    found = {}
    for name in preset_names():
        comment = re.match(r"(?:#.*\n)*", preset_text(name))
        found[name] = _sentence("" if comment is None else comment[0].replace("# ", ""))
    return found


def _compositions() -> dict[str, str]:
    from gridreg.compositions.named import composition_about, composition_names

    return {name: _sentence(composition_about(name)) for name in composition_names()}


def _composition(name: str) -> str:
    import gridreg
    from gridreg.compositions.named import composition_about
    from gridreg.training.strict_yaml import dump_yaml

    head = "".join(f"# {line}\n" for line in composition_about(name).splitlines() if line)
    return head + dump_yaml(gridreg.to_config(gridreg.composition(name)))


def _protocols() -> dict[str, str]:
    from gridreg.scenes.protocols import COUNTED, PROTOCOLS

    found = {name: protocol.source for name, protocol in PROTOCOLS.items()}
    return {**found, **COUNTED}


def _protocol(name: str) -> str:
    from gridreg.scenes.protocols import COUNTED, get_protocol

    if name in COUNTED:
        return f"{name}: {COUNTED[name]}"
    protocol = get_protocol(name)
    size = "as stored" if protocol.halve_at is None else f"halved if {protocol.halve_at} pixels wide"
    tested = "training frames that are not trained on" if protocol.validates else str(protocol.test)
    lines = {"used by": protocol.source, "trained on": protocol.train, "tested on": tested}
    lines |= {"size": size, "background": protocol.background}
    return "\n".join([name, *(f"  {key:<10}  {value}" for key, value in lines.items())])


def _regularizers() -> dict[str, str]:
    from gridreg.base import REGISTRY

    return {name: _sentence(inspect.getdoc(REGISTRY[name]) or "") for name in sorted(REGISTRY)}


def _regularizer(name: str) -> str:
    from gridreg.base import REGISTRY

    cls = REGISTRY[name]
    bare = [p.replace(annotation=p.empty) for p in inspect.signature(cls).parameters.values()]
    return f"{name}{inspect.Signature(bare)}\n\n{inspect.getdoc(cls)}".replace("``", "`")


def _keys(cls: Any = None, prefix: str = "") -> dict[str, tuple[str, str]]:
    """Default and meaning of each key, the latter from the docstring of its dataclass."""
    from gridreg.training.settings import RunConfig
    from gridreg.training.typed_data import to_data

    cls = RunConfig if cls is None else cls
    found: dict[str, tuple[str, str]] = {}
    text = inspect.getdoc(cls) or ""
    entries = re.findall(r"(?m)^    ([a-z_, ]+): ((?:.*\n?)(?:^     +.*\n?)*)", text)
    meanings = {name: " ".join(about.split()) for names, about in entries for name in names.split(", ")}
    for field in fields(cls):
        value = getattr(cls(), field.name)
        if is_dataclass(value):
            found |= _keys(type(value), f"{prefix}{field.name}.")
        else:
            found[prefix + field.name] = (json.dumps(to_data(value)), meanings[field.name])
    return found


def _config() -> dict[str, str]:
    return {key: default for key, (default, _) in _keys().items()}


def _key(name: str) -> str:
    default, meaning = _keys()[name]
    return f"{name}: {default}\n  {meaning}"


def _preset(name: str) -> str:
    from gridreg.training.presets import preset_text

    return preset_text(name)


def _sentence(text: str) -> str:
    """The first sentence, on one line, cut where it is long."""
    first = " ".join(text.partition("\n\n")[0].split())
    found = re.match(r".+?\.(?= [A-Z]|$)", first)
    return textwrap.shorten(re.sub(r": see `.*$", "", found[0] if found else first).rstrip("."), 110)


# For each kind, what lists all of it with a line about each, and what shows one.
_KINDS: dict[str, tuple[Callable[[], dict[str, str]], Callable[[str], str]]] = {
    "presets": (_presets, _preset),
    "compositions": (_compositions, _composition),
    "protocols": (_protocols, _protocol),
    "regularizers": (_regularizers, _regularizer),
    "config": (_config, _key),
}
