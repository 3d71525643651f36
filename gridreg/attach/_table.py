"""Tables as plain text and as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

__all__ = ["html_table", "table"]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns as wide as their cells, the head underlined.

    >>> print(table(("site", "value"), [("density", "0.5")]))
    site     value
    -------  -----
    density  0.5
    """
    lines = [list(head), *map(list, rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    lines.insert(1, ["-" * width for width in widths])
    texts = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
    return "\n".join(text.rstrip() for text in texts)


def html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same as a small HTML table with a caption, for notebooks.

    >>> html_table("t", ("a",), [("<1>",)])
    '<table><caption>t</caption><tr><th>a</th></tr><tr><td>&lt;1&gt;</td></tr></table>'
    """
    lines = ["".join(f"<th>{escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
