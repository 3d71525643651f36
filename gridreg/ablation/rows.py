"""The rows of a study: an entry of ``compositions`` is one row, or a generator of several.

====================  =============================================================================================
entry                 rows
====================  =============================================================================================
``NAME``              the composition (or preset) of that name; ``preset``: whatever composition the preset has
``{name: NAME}``      the same, with ``remove``, ``replace`` and ``add`` for single regularizers, and ``label``
``{regularizers:}``   a composition written out; needs a ``label``
``{leave_one_out:}``  the composition, and once without each part
``{one_at_a_time:}``  what is under ``on`` (default ``none``), and once with each part added
``{product:}``        every subset of the parts
``{sweep:}``          one value varied: ``argument`` of what ``change`` selects, or a ``key`` of the configuration
====================  =============================================================================================

Generators take an entry or a name; ``parts: {NAME: [regularizers]}`` or ``by: name|site|each`` says what a part is.
Every entry may hold ``preset``, ``backbone``, ``steps`` and ``set`` for its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Literal

from gridreg.ablation.edits import (
    Plain,
    added,
    change_argument,
    known_composition,
    normalised,
    parts_of,
    removed,
    replaced,
)
from gridreg.compositions.named import composition as named_composition
from gridreg.compositions.plain_data import to_config
from gridreg.errors import ConfigError
from gridreg.training.strict_yaml import Document
from gridreg.training.typed_data import from_data

_COMMON = ("label", "preset", "backbone", "steps", "set")
_EDITS = {"remove": ("-", removed), "replace": ("~", replaced), "add": ("+", added)}
_MOST_PARTS = 12


@dataclass(frozen=True)
class StudyRow:
    """One row of a study before it meets presets, scenes and seeds.

    Args:
        label: its name.
        plain: the composition; None: the preset's own.
        edits: ``remove``, ``replace`` and ``add``, still to be done where the preset's composition is meant.
        preset, backbone, steps: instead of the study's.
        set: values of the configuration by dotted key.
    """

    label: str
    plain: Plain | None
    edits: Mapping[str, Any] = field(default_factory=dict)
    preset: str | None = None
    backbone: str | None = None
    steps: int | None = None
    set: Mapping[str, Any] = field(default_factory=dict)

    def composition(self, own: str | list[dict[str, Any]]) -> Plain:
        """The row's composition.

        Args:
            own: the preset's.

        Raises:
            InputError: if an edit means nothing in it.
        """
        if self.plain is not None:
            return self.plain
        held = to_config(named_composition(own)) if isinstance(own, str) else normalised(own)
        return _edited(held, self.edits)


def expand_rows(entry: Any) -> list[StudyRow]:
    """The rows of one entry.

    Raises:
        ConfigError: for unknown names and keys, with the nearest; and for parts that are not there.

    Example:
        >>> [row.label for row in expand_rows({"leave_one_out": "freenerf"})]
        ['freenerf', 'freenerf - FrequencyMask', 'freenerf - OcclusionLoss']
    """
    read = _read(entry)
    return [
        replace(
            row,
            preset=read.preset or row.preset,
            backbone=read.backbone or row.backbone,
            steps=read.steps or row.steps,
            # What a sweep varies stands above what the entry sets.
            set={**read.set, **row.set},
        )
        for row in KEYS[read.kind][0](read)
    ]


_Selectors = str | dict[str, Any] | list[str | dict[str, Any]] | None


@dataclass(frozen=True)
class _Entry:
    """Every key of an entry; which of them go together, `KEYS` says."""

    name: str | None = None
    regularizers: list[Any] | None = None
    leave_one_out: Any = None
    one_at_a_time: Any = None
    product: Any = None
    sweep: Any = None
    label: str | None = None
    preset: str | None = None
    backbone: str | None = None
    steps: int | None = None
    set: dict[str, Any] = field(default_factory=dict)
    remove: _Selectors = None
    replace: _Selectors = None
    add: _Selectors = None
    on: Any = "none"
    parts: dict[str, Any] | None = None
    by: Literal["name", "site", "each"] | None = None
    values: list[Any] = field(default_factory=list)
    change: str | dict[str, Any] | None = None
    argument: str | None = None
    key: str | None = None

    def __post_init__(self) -> None:
        if self.label is not None and not self.label.strip():
            raise ConfigError(("label",), f"found {self.label!r}, expected text")
        if self.steps is not None and self.steps < 1:
            raise ConfigError(("steps",), f"found {self.steps}, expected an integer of at least 1")

    @property
    def kind(self) -> str:
        return next(kind for kind in KEYS if getattr(self, kind) is not None)


def _read(entry: Any) -> _Entry:
    if isinstance(entry, str):
        entry = {"name": entry}
    if not isinstance(entry, Mapping):
        raise ConfigError((), f"found {entry!r}, expected the name of a composition or a mapping")
    read = from_data(_Entry, entry, source="")
    kinds = [kind for kind in KEYS if entry.get(kind) is not None]
    if len(kinds) != 1:
        found = " and ".join(kinds) or ", ".join(map(str, entry)) or "nothing"
        raise ConfigError((), f"found {found}, expected exactly one of {', '.join(KEYS)}")
    valid = (kinds[0], *KEYS[kinds[0]][1], *_COMMON)
    for key in entry:
        if key not in valid:
            raise ConfigError((key,), f"found beside {kinds[0]}, expected none but {', '.join(valid)}")
    return read


def _named(entry: _Entry) -> list[StudyRow]:
    name, edits = str(entry.name), {k: getattr(entry, k) for k in _EDITS if getattr(entry, k) is not None}
    plain = None if name == "preset" else _edited(known_composition(name), edits)
    return [StudyRow(entry.label or name.rpartition(":")[2] + _edit_titles(edits), plain, edits)]


def _written(entry: _Entry) -> list[StudyRow]:
    if entry.label is None:
        raise ConfigError(("label",), "missing; a composition written out needs a name for the tables")
    return [StudyRow(entry.label, normalised(entry.regularizers))]


def _base(entry: _Entry, key: str, label: str | None) -> tuple[StudyRow, Plain]:
    """The row that a generator starts from, and its composition."""
    value = getattr(entry, key)
    with Document(value, "").locating(key):
        if _read(value).kind not in ("name", "regularizers"):
            raise ConfigError((), "found a generator, expected one composition")
        (row,) = expand_rows(value)
        if row.plain is None:
            raise ConfigError((), "found 'preset', expected a composition or preset by its name")
    return replace(row, label=label or row.label), row.plain


def _parts(entry: _Entry, plain: Plain) -> dict[str, Plain]:
    if not plain:
        raise ConfigError((), "found a composition without regularizers, expected one with parts to vary")
    if entry.parts is not None and entry.by is not None:
        raise ConfigError(("by",), "found beside parts, expected one of the two")
    return parts_of(plain, entry.parts, entry.by or "name")


def _leave_one_out(entry: _Entry) -> list[StudyRow]:
    base, plain = _base(entry, "leave_one_out", entry.label)
    parts = _parts(entry, plain).items()
    return [base, *(replace(base, label=f"{base.label} - {n}", plain=_without(plain, p)) for n, p in parts)]


def _one_at_a_time(entry: _Entry) -> list[StudyRow]:
    _, whole = _base(entry, "one_at_a_time", None)
    on, plain = _base(entry, "on", entry.label)
    parts = _parts(entry, whole).items()
    return [on, *(replace(on, label=f"{on.label} + {n}", plain=[*plain, *part]) for n, part in parts)]


def _product(entry: _Entry) -> list[StudyRow]:
    base, plain = _base(entry, "product", entry.label)
    parts = _parts(entry, plain)
    if len(parts) > _MOST_PARTS:
        most = f"expected at most {_MOST_PARTS} (2^{_MOST_PARTS} rows)"
        raise ConfigError(("product",), f"found {len(parts)} parts, {most}")
    rows = []
    for left_out in (names for count in range(len(parts) + 1) for names in combinations(parts, count)):
        rest = _without(plain, [regularizer for name in left_out for regularizer in parts[name]])
        rows.append(replace(base, label=base.label + "".join(f" - {n}" for n in left_out), plain=rest))
    return rows


def _sweep(entry: _Entry) -> list[StudyRow]:
    base, plain = _base(entry, "sweep", entry.label)
    values, key, argument = entry.values, entry.key, entry.argument
    if not values:
        raise ConfigError(("values",), "found [], expected a list of values to try")
    if (key is None) == (argument is None):
        either = "expected either argument (with change) or key, a dotted key of the configuration"
        raise ConfigError(("sweep",), either)
    if key is not None:
        return [replace(base, label=f"{base.label}, {key}={v}", set={**base.set, key: v}) for v in values]
    if entry.change is None:
        missing = "missing; expected the regularizers whose argument is varied, such as FrequencyMask"
        raise ConfigError(("change",), missing)
    changed = [(v, change_argument(plain, entry.change, str(argument), v)) for v in values]
    return [replace(base, label=f"{base.label}, {argument}={v}", plain=own) for v, own in changed]


KEYS: dict[str, tuple[Callable[[_Entry], list[StudyRow]], tuple[str, ...]]] = {
    "name": (_named, ("remove", "replace", "add")),
    "regularizers": (_written, ()),
    "leave_one_out": (_leave_one_out, ("parts", "by")),
    "one_at_a_time": (_one_at_a_time, ("on", "parts", "by")),
    "product": (_product, ("parts", "by")),
    "sweep": (_sweep, ("change", "argument", "key", "values")),
}
"""Rows of each kind of entry, and the keys beside the one that tells the kind; some are common to all."""


def _edited(plain: Plain, edits: Mapping[str, Any]) -> Plain:
    for key, (_, edit) in _EDITS.items():
        if key in edits:
            plain = edit(plain, edits[key])
    return plain


def _edit_titles(edits: Mapping[str, Any]) -> str:
    """`` - X``, `` ~ X`` and `` + X`` for what is removed, replaced and added."""
    titles = ""
    for key, (sign, _) in _EDITS.items():
        entries = edits.get(key, [])
        for item in entries if isinstance(entries, list) else [entries]:
            words = (
                item
                if isinstance(item, str)
                else " ".join(str(item[k]) for k in ("name", "site") if k in item)
            )
            titles += f" {sign} {words}"
    return titles


def _without(plain: Plain, part: Plain) -> Plain:
    return [regularizer for regularizer in plain if regularizer not in part]
