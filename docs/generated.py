"""Files of the documentation that a program writes, and ``--check`` that holds them against it."""

from __future__ import annotations

import argparse
import operator
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2

from gridreg.training.files import write_text

DOCS = Path(__file__).parent


def rendered(page: str, **values: Any) -> str:
    """Return a page from its template, such as ``results.md`` from ``results.md.jinja``; all it names must be there."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    return environment.from_string((DOCS / f"{page}.jinja").read_text(encoding="utf-8")).render(values)


def write_or_check(
    words: Sequence[str] | None,
    program: str,
    texts: Callable[[], dict[Path, str]],
    same: Callable[[str, str], bool] = operator.eq,
    folder: Path | None = None,
) -> int:
    """Write files that are stale, or with ``--check`` name them; return the exit status.

    Args:
        words: of the command line; None: those of the process.
        program: name under ``docs/``.
        texts: what the files should be.
        same: whether a file's text is as good as what is wanted.
        folder: holds nothing but these files; others are stale as well, and removed.
    """
    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument(
        "--check", action="store_true", help="only name the stale files; status 1 if there are any"
    )
    check = parser.parse_args(words).check
    wanted = texts()
    stale = [
        p for p, text in wanted.items() if not p.is_file() or not same(p.read_text(encoding="utf-8"), text)
    ]
    left_over = [] if folder is None else [p for p in sorted(folder.glob("*")) if p not in wanted]
    if check:
        names = ", ".join(path.name for path in stale + left_over)
        print(f"stale: {names}; run python docs/{program}" if names else "up to date")
        return int(bool(names))
    for path in left_over:
        path.unlink()
    for path in stale:
        path.parent.mkdir(exist_ok=True)
        write_text(path, wanted[path])
    return 0
