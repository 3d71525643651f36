"""Nothing that a user could name in 0.1.0 is gone without a word: it is there, or an error names its successor."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import gridreg.errors
from tests.inventory import inventory

BEFORE: dict[str, list[str]] = json.loads(
    (Path(__file__).parent / "data" / "inventory-0.1.0.json").read_text(encoding="utf-8")
)
#: Old name: new name, by kind. Tests beside the code show that the old one is refused and the new one named.
RENAMED: dict[str, dict[str, str]] = {
    "public": gridreg.errors.RENAMED,
    "regularizers": gridreg.errors.RENAMED,
    # Another name of the same regularizers.
    "compositions": {"few_tensorf_finetuned": "few_tensorf"},
    "configuration": {f"train.{old}": f"train.{new}" for old, new in gridreg.errors.RENAMED_KEYS.items()},
    # A positional argument, whose name is only shown.
    "options": {"prepare.pictures": "prepare.images"},
}


@pytest.mark.parametrize("kind", BEFORE)
def test_nothing_is_lost(kind: str) -> None:
    now = inventory()[kind]
    assert len(now) == len(set(now))
    renamed = RENAMED.get(kind, {})
    for name in BEFORE[kind]:
        first, dot, rest = name.partition(".")
        expected = renamed.get(name, renamed.get(first, first) + dot + rest)
        assert expected in now, f"{kind}: {name} is gone"


@pytest.mark.parametrize("kind", RENAMED)
def test_renamed_names_are_of_the_version_before(kind: str) -> None:
    known = {part for name in BEFORE[kind] for part in (name, name.partition(".")[0])}
    assert set(RENAMED[kind]) <= known
