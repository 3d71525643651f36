"""The page "where is what" names places that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROWS = [
    line.strip("| ").split(" | ")
    for line in (ROOT / "docs" / "where.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and "/" in line
]


def test_there_is_a_row_for_many_questions() -> None:
    assert len(ROWS) >= 40


@pytest.mark.parametrize(("question", "place"), ROWS, ids=[question for question, _ in ROWS])
def test_the_place_is_there(question: str, place: str) -> None:
    found = re.findall(r"`([\w/]+\.py)`(?:: `(\w+)`)?", place)
    assert found, f"{question}: no place"
    for path, name in found:
        text = (ROOT / path).read_text(encoding="utf-8")
        assert not name or re.search(rf"(def|class) {name}\b|^{name}\b", text, flags=re.M), (
            f"{path}: no {name}"
        )
    for term in re.findall(r"`(\w+)`", question):
        assert any(term in (ROOT / path).read_text(encoding="utf-8") for path, _ in found), (
            f"{term} not in {place}"
        )
