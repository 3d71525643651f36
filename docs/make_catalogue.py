"""Write docs/catalogue.md, the table of all regularizers, from the registry and the docstrings.

python docs/make_catalogue.py            write the page
python docs/make_catalogue.py --check    exit with status 1 if the page is stale
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import yaml
from generated import rendered, write_or_check

import gridreg
from gridreg.base import REGISTRY, Regularizer, overrides
from gridreg.schedules import Schedule

PAGE = Path(__file__).with_name("catalogue.md")

# Letters of the kinds, in the page's order; the page says what they mean.
KINDS = "FPLSDO"
FAMILIES = sorted((PAGE.parent / "families").glob("*.md"))
FORMULAS: dict[str, str] = yaml.safe_load(PAGE.with_name("formulas.yaml").read_text(encoding="utf-8"))


def kind_of(cls: type[Regularizer]) -> str:
    """Letter of `KINDS`, from the parts that a class plays."""
    if overrides(cls, "transform"):
        return "F" if cls.acts_on == "mask" else "P"
    parts = {
        "L": ("penalty", "grid_penalty"),
        "S": ("near_far",),
        "D": ("background",),
        "O": ("parameter_groups", "update_groups"),
        "F": ("on_samples",),
    }
    return next(kind for kind, methods in parts.items() if any(overrides(cls, m) for m in methods))


def entry_of(cls: type[Regularizer], name: str) -> str:
    """The paragraph "Name: ..." of a class's docstring.

    Raises:
        SystemExit: the docstring has none.
    """
    found = re.search(rf"^{name}: (.+?)(?=\n\n|\n[A-Z]\w+: |\Z)", inspect.getdoc(cls) or "", re.S | re.M)
    if found is None:
        raise SystemExit(f"{cls.__name__}: its docstring has no line '{name}: ...'")
    return " ".join(found[1].split()).rstrip(".")


def summary_of(cls: type[Regularizer]) -> str:
    """First sentence of the docstring, without the pointer to a function."""
    first = (inspect.getdoc(cls) or "").split("\n\n")[0]
    return re.sub(r": see `\w+`(?: and `\w+`)?\.$", ".", " ".join(first.split()))


def short(value: Any) -> str:
    """A default as text; of a schedule the arguments that differ from its own defaults."""
    if not isinstance(value, Schedule):
        return repr(value)
    shown = [
        f"{f.name}={short(getattr(value, f.name))}"
        for f in fields(value)
        if f.default is MISSING or getattr(value, f.name) != f.default
    ]
    return f"{type(value).__name__}({', '.join(shown)})"


def defaults_of(cls: type[Regularizer]) -> str:
    """Arguments with their defaults."""
    shown = [f"{f.name}={short(f.default)}" for f in fields(cls) if f.default is not MISSING]
    return ", ".join(f"`{argument}`" for argument in shown) or "none"


def row_of(cls: type[Regularizer]) -> str:
    """Row of the table.

    Raises:
        SystemExit: if its docstring, the pages or the formulas lack something.
    """
    name = cls.__name__
    places = [path.name for path in FAMILIES if f"\n## {name}\n" in path.read_text(encoding="utf-8")]
    entry_of(cls, "Formula")
    if not places or name not in FORMULAS:
        raise SystemExit(
            f"{name}: no section in docs/families/" if not places else f"{name}: not in formulas.yaml"
        )
    facts = f"{defaults_of(cls)}<br>unit: {entry_of(cls, 'Unit')}<br>*{entry_of(cls, 'Source')}*"
    link = f"[`{name}`](families/{places[0]}#{name.lower()})"
    cells = [link, kind_of(cls), f"{summary_of(cls)}<br>${FORMULAS[name]}$", facts]
    return "| " + " | ".join(cell.replace("|", "\\|").replace("``", "`") for cell in cells) + " |"


def page() -> str:
    """The whole page."""
    package = f"{gridreg.__name__}."
    classes = [cls for cls in REGISTRY.values() if cls.__module__.startswith(package)]
    classes.sort(key=lambda cls: (KINDS.index(kind_of(cls)), cls.__name__))
    return rendered("catalogue.md", rows=map(row_of, classes))


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page; return the exit status."""
    return write_or_check(words, "make_catalogue.py", lambda: {PAGE: page()})


if __name__ == "__main__":
    sys.exit(main())
