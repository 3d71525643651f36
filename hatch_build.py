"""README.md for a package index, where links to files of the repository would lead nowhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class ReadmeHook(MetadataHookInterface):
    """Gives the package its description."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set ``readme`` to README.md, with links that work without the repository."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        url = metadata.get("urls", {}).get("Repository", "")
        metadata["readme"] = {"content-type": "text/markdown", "text": absolute(text, url)}


def absolute(text: str, url: str) -> str:
    """Markdown whose relative links and images lead into a repository; without one they are words.

    >>> absolute("![a](b.webp) [c](d.md#e) [f](https://g)", "https://host/name")
    '![a](https://host/name/raw/main/b.webp) [c](https://host/name/blob/main/d.md#e) [f](https://g)'
    >>> absolute("![a](b.webp) [c](d.md#e) [f](https://g)", "")
    ' c [f](https://g)'
    """

    def link(found: re.Match[str]) -> str:
        image, words, place = found.groups()
        if "://" in place or place.startswith("#"):
            return found[0]
        if not url:
            return "" if image else words
        return f"{image}[{words}]({url}/{'raw' if image else 'blob'}/main/{place})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", link, text)
