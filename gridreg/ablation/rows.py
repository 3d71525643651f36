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
from typing import Any

from gridreg.ablation.edits import (
    Plain,
    added,
    change_argument,
    known_composition,
    normalised,
    parts_of,
    refuse_unknown,
    removed,
    replaced,
    title_of,
)
from gridreg.compositions.named import composition as named_composition
from gridreg.compositions.plain_data import to_config
from gridreg.errors import InputError

__all__ = ["Row", "expand_rows"]

_COMMON = ("preset", "backbone", "steps", "set")
_EDITS = ("remove", "replace", "add")
_PARTS = ("parts", "by", "label")
_KEYS: dict[str, tuple[str, ...]] = {
    "name": ("name", "label", *_EDITS, *_COMMON),
    "regularizers": ("regularizers", "label", *_COMMON),
    "leave_one_out": ("leave_one_out", *_PARTS, *_COMMON),
    "one_at_a_time": ("one_at_a_time", "on", *_PARTS, *_COMMON),
    "product": ("product", *_PARTS, *_COMMON),
    "sweep": ("sweep", "change", "argument", "key", "values", "label", *_COMMON),
}
_MOST_PARTS = 12


@dataclass(frozen=True)
class Row:
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


def expand_rows(entry: Any) -> list[Row]:
    """The rows of one entry.

    Raises:
        InputError: for unknown names and keys, with the nearest; and for parts that are not there.

    Example:
        >>> [row.label for row in expand_rows({"leave_one_out": "freenerf"})]
        ['freenerf', 'freenerf - FrequencyMask', 'freenerf - OcclusionLoss']
    """
    kind = _kind_of(entry)
    if kind in ("name", "regularizers"):
        rows = [_plain_row(entry)]
    else:
        rows = _GENERATORS[kind](entry)
    common = _common(entry)
    # What a sweep varies stands above what the entry sets.
    return [replace(row, **{**common, "set": {**common.get("set", {}), **row.set}}) for row in rows]


def _kind_of(entry: Any) -> str:
    if isinstance(entry, str):
        return "name"
    if not isinstance(entry, Mapping):
        raise InputError(f"found {entry!r}, expected the name of a composition or a mapping")
    kinds = [kind for kind in _KEYS if kind in entry]
    if not kinds:
        refuse_unknown(entry, sorted({key for keys in _KEYS.values() for key in keys}), "entry")
    if len(kinds) != 1:
        found = " and ".join(kinds) or ", ".join(map(str, entry)) or "nothing"
        raise InputError(f"found {found}, expected exactly one of {', '.join(_KEYS)}")
    refuse_unknown(entry, _KEYS[kinds[0]], kinds[0])
    return kinds[0]


def _plain_row(entry: Any) -> Row:
    if isinstance(entry, str):
        entry = {"name": entry}
    label = entry.get("label")
    if label is not None and (not isinstance(label, str) or not label.strip()):
        raise InputError(f"label: found {label!r}, expected text")
    if "regularizers" in entry:
        if label is None:
            raise InputError("label: missing; a composition written out needs a name for the tables")
        return Row(label, normalised(entry["regularizers"]))
    name = entry["name"]
    if not isinstance(name, str):
        raise InputError(f"name: found {name!r}, expected the name of a composition")
    edits = {key: entry[key] for key in _EDITS if key in entry}
    label = label or name.rpartition(":")[2] + "".join(_edit_titles(edits))
    if name == "preset":
        return Row(label, None, edits)
    return Row(label, _edited(known_composition(name), edits))


def _edited(plain: Plain, edits: Mapping[str, Any]) -> Plain:
    for key, edit in (("remove", removed), ("replace", replaced), ("add", added)):
        if key in edits:
            plain = edit(plain, edits[key])
    return plain


def _edit_titles(edits: Mapping[str, Any]) -> list[str]:
    """`` - X``, `` ~ X`` and `` + X`` for what is removed, replaced and added."""
    titles = []
    for key, sign in (("remove", "-"), ("replace", "~"), ("add", "+")):
        entries = edits.get(key, [])
        for item in entries if isinstance(entries, list) else [entries]:
            title = (
                item
                if isinstance(item, str)
                else " ".join(str(item[k]) for k in ("name", "site") if k in item)
            )
            titles.append(f" {sign} {title}")
    return titles


def _base(entry: Mapping[str, Any], key: str) -> Row:
    """The row that a generator starts from."""
    value = entry[key]
    if _kind_of(value) not in ("name", "regularizers"):
        raise InputError(f"{key}: found a generator, expected one composition")
    row = _plain_row(value)
    if row.plain is None:
        raise InputError(f"{key}: found 'preset', expected a composition or preset by its name")
    if key in ("leave_one_out", "one_at_a_time", "product", "sweep") and "label" in entry:
        row = replace(row, label=str(entry["label"]))
    return replace(row, **_common(value))


def _leave_one_out(entry: Mapping[str, Any]) -> list[Row]:
    base = _base(entry, "leave_one_out")
    plain = base.plain or []
    parts = _parts(entry, plain)
    rows = [
        replace(base, label=f"{base.label} - {name}", plain=_without(plain, part))
        for name, part in parts.items()
    ]
    return [base, *rows]


def _one_at_a_time(entry: Mapping[str, Any]) -> list[Row]:
    whole = _base(entry, "one_at_a_time")
    on = _base({"on": "none", **entry}, "on")
    parts = _parts(entry, whole.plain or [])
    rows = [
        replace(on, label=f"{on.label} + {name}", plain=[*(on.plain or []), *part])
        for name, part in parts.items()
    ]
    return [on, *rows]


def _product(entry: Mapping[str, Any]) -> list[Row]:
    base = _base(entry, "product")
    plain = base.plain or []
    parts = _parts(entry, plain)
    if len(parts) > _MOST_PARTS:
        raise InputError(
            f"product: found {len(parts)} parts, expected at most {_MOST_PARTS} (2^{_MOST_PARTS} rows)"
        )
    rows = []
    for count in range(len(parts) + 1):
        for left_out in combinations(parts, count):
            without = [regularizer for name in left_out for regularizer in parts[name]]
            label = base.label + "".join(f" - {name}" for name in left_out)
            rows.append(replace(base, label=label, plain=_without(plain, without)))
    return rows


def _sweep(entry: Mapping[str, Any]) -> list[Row]:
    base = _base(entry, "sweep")
    values = entry.get("values")
    if not isinstance(values, list) or not values:
        raise InputError(f"values: found {values!r}, expected a list of values to try")
    if ("key" in entry) == ("argument" in entry):
        raise InputError(
            "sweep: expected either argument (with change) or key, a dotted key of the configuration"
        )
    if "key" in entry:
        key = str(entry["key"])
        return [replace(base, label=f"{base.label}, {key}={v}", set={**base.set, key: v}) for v in values]
    if "change" not in entry:
        raise InputError(
            "change: missing; expected the regularizers whose argument is varied, such as FrequencyMask"
        )
    argument = str(entry["argument"])
    return [
        replace(
            base,
            label=f"{base.label}, {argument}={value if not isinstance(value, Mapping) else dict(value)}",
            plain=change_argument(base.plain or [], entry["change"], argument, value),
        )
        for value in values
    ]


_GENERATORS: dict[str, Callable[[Mapping[str, Any]], list[Row]]] = {
    "leave_one_out": _leave_one_out,
    "one_at_a_time": _one_at_a_time,
    "product": _product,
    "sweep": _sweep,
}


def _parts(entry: Mapping[str, Any], plain: Plain) -> dict[str, Plain]:
    if not plain:
        raise InputError("found a composition without regularizers, expected one with parts to vary")
    if "parts" in entry and "by" in entry:
        raise InputError("by: found beside parts, expected one of the two")
    return parts_of(plain, entry.get("parts"), str(entry.get("by", "name")))


def _without(plain: Plain, part: Plain) -> Plain:
    titles = [title_of(regularizer) for regularizer in part]
    return [r for r in plain if not (title_of(r) in titles and r in part)]


def _common(entry: Any) -> dict[str, Any]:
    """The entry's own preset, backbone, steps and values; they must be of their types."""
    found = {key: entry[key] for key in _COMMON if isinstance(entry, Mapping) and key in entry}
    for key, kind, expected in (
        ("preset", str, "a name"),
        ("backbone", str, "a name"),
        ("steps", int, "an integer of at least 1"),
        ("set", Mapping, "values by dotted key"),
    ):
        wrong = key in found and (not isinstance(found[key], kind) or found[key] is True)
        if wrong or (key == "steps" and key in found and found[key] < 1):
            raise InputError(f"{key}: found {found[key]!r}, expected {expected}")
    return found
