"""Pages and tables from the templates in ``page/``."""

from __future__ import annotations

import re
from typing import Any

from gridreg.export.html import page_environment

_LATEX_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    '"': r"\textquotedbl{}", "|": r"\textbar{}",
    "\N{MINUS SIGN}": "$-$", "–": "--", "±": r"$\pm$", "Δ": r"$\Delta$", "α": r"$\alpha$", "≈": r"$\approx$",
    "·": r"$\cdot$", "▲": r"$\blacktriangle$", "▼": r"$\blacktriangledown$", "△": r"$\vartriangle$",
    "▽": r"$\triangledown$",
}  # fmt: skip


def render(template: str, **values: Any) -> str:
    """The text that a template makes of some values; in HTML, text among them is escaped.

    Args:
        template: name of a file in ``page/``.
        values: by the names that the template uses, all of which must be there.
    """
    environment = page_environment("gridreg.ablation")
    environment.filters |= {"markdown": _markdown, "latex": _latex}
    return environment.get_template(template).render(values)


def _markdown(text: str) -> str:
    safe = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # A backslash before punctuation makes it text, in tables too.
    return re.sub(r"([\\`*_\[\]#|~$!])", r"\\\1", " ".join(safe.split()))


def _latex(text: str) -> str:
    safe = "".join(_LATEX_SPECIAL.get(character, character) for character in " ".join(text.split()))
    # After a row's end, LaTeX takes an opening bracket for an option.
    return f"{{{safe}}}" if safe.startswith("[") else safe
