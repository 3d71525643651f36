"""Hooks of the site: diagrams go inline, and nothing may come from another server."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

_DIAGRAM = re.compile(r'<img alt="([^"]*)" src="(?:\.\./)*(diagrams/[\w-]+\.svg)" ?/?>')
_FORMULA = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.S)
_FOREIGN = re.compile(
    r'<(?:script|img|iframe|source)\b[^>]*\bsrc="(?:https?:)?//[^"]*"'
    r'|<link\b[^>]*\bhref="(?:https?:)?//[^"]*"'
    r"|(?:@import\s+|url\()[\"']?(?:https?:)?//[^\"')]*"
)


def on_config(config: Any) -> Any:
    """The settings, with the page of results in the menu once a benchmark has written it."""
    if (Path(config["docs_dir"]) / "results.md").is_file():
        config["nav"].insert(-1, {"Results": "results.md"})
    return config


def on_page_content(text: str, config: Any, **_: Any) -> str:
    """A page's HTML with its diagrams inside, so that they follow the page's colours, and its formulas as MathML."""
    return _FORMULA.sub(formula, inlined(text, Path(config["docs_dir"])))


def formula(found: re.Match[str]) -> str:
    """MathML of a formula in TeX: browsers draw it by themselves, so nothing is fetched and no script runs."""
    from latex2mathml.converter import convert

    return f'<span class="formula">{convert(html.unescape(found[1]))}</span>'


def inlined(text: str, docs: Path) -> str:
    """HTML in which the project's own diagrams are no longer references to files."""

    def drawing(found: re.Match[str]) -> str:
        svg = (docs / found[2]).read_text(encoding="utf-8")
        # The page's stylesheet takes the place of the file's own, which knows nothing of the page's switch.
        svg = re.sub(r"<style>.*?</style>", "", svg, flags=re.S).replace(
            ' xmlns="http://www.w3.org/2000/svg"', ""
        )
        return svg.replace("<svg ", f'<svg role="img" aria-label="{found[1]}" ', 1).strip()

    return _DIAGRAM.sub(drawing, text)


def foreign(text: str) -> list[str]:
    """Return what an HTML or CSS file would fetch from another server."""
    return [html.unescape(found[0]) for found in _FOREIGN.finditer(text)]


def on_post_build(config: Any, **_: Any) -> None:
    """Refuse a site that needs another server."""
    from mkdocs.exceptions import PluginError

    site = Path(config["site_dir"])
    for path in sorted([*site.rglob("*.html"), *site.rglob("*.css")]):
        found = foreign(path.read_text(encoding="utf-8"))
        if found:
            raise PluginError(f"{path.relative_to(site)}: fetches from elsewhere: {found[0]}")
