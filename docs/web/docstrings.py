"""Docstrings as the code writes them, brought into the form that the reference's parser reads.

In the code, a doctest may follow the text directly, an entry of Args may name several arguments, and formula, unit
and source of a regularizer stand on a line each.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe
import yaml

_FORMULAS: dict[str, str] = yaml.safe_load(
    Path(__file__).parents[1].joinpath("formulas.yaml").read_text(encoding="utf-8")
)
_ROLE = re.compile(r":(?:py:)?(?:func|class|meth|data|attr|mod):`~?([^`]+)`")
_SECTIONS = ("Args:", "Attributes:", "Raises:")
_ENTRY = re.compile(r" {4}(\*{0,2}[\w.]+(?:, \*{0,2}[\w.]+)*)((?: \([^)]*\))?:(?: .*|$))")
_FACT = re.compile(r"(Formula|Unit|Source): ")


class Docstrings(griffe.Extension):
    """Rewrites the docstring of every object that is loaded."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite one."""
        if obj.docstring is not None:
            obj.docstring.value = readable(obj.docstring.value, _FORMULAS.get(obj.name, ""))


def readable(text: str, formula: str = "") -> str:
    """A docstring, dedented, in the parser's form; with a formula in TeX before the one in plain text."""
    if formula:
        text = re.sub(r"^Formula: ", lambda _: f"Formula: ${formula}$; ", text, flags=re.M)
    text = _ROLE.sub(r"`\1`", text)
    paragraphs = re.split(r"\n(?:[ \t]*\n)+", text)
    return "\n\n".join(_paragraph(paragraph) for paragraph in paragraphs)


def _paragraph(text: str) -> str:
    lines = text.split("\n")
    if lines[0].startswith(">>>"):
        return "\n".join(["Examples:", *(f"    {line}" for line in lines)])
    if lines[0] == "Example:":
        return "\n".join(["Examples:", *lines[1:]])
    if lines[0] in _SECTIONS:
        return "\n".join([lines[0], *_entries(lines[1:])])
    if len(lines) > 1 and _FACT.match(lines[0]):
        return "\n".join(_FACT.sub(r"* **\1** ", line) for line in lines)
    return text


def _entries(lines: list[str]) -> list[str]:
    """One entry for each argument; what is no entry goes on with the one before."""
    entries: list[tuple[list[str], str, list[str]]] = []
    for line in lines:
        found = _ENTRY.fullmatch(line)
        if found:
            entries.append((found[1].split(", "), found[2], []))
        elif entries:
            entries[-1][2].append(f"        {line.strip()}")
    return [line for names, rest, more in entries for name in names for line in (f"    {name}{rest}", *more)]
