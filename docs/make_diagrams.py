"""Write docs/diagrams/*.svg, drawn from what the code computes.

python docs/make_diagrams.py            write the diagrams
python docs/make_diagrams.py --check    exit with status 1 if one is stale, missing or left over
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))
from drawing import contradictions, filters, masks, penalties, sampling
from drawing.svg import drawn
from generated import write_or_check

FOLDER = Path(__file__).with_name("diagrams")
# Pixels. Processors round sums differently in the last digits.
TOLERANCE = 0.25


def diagrams() -> dict[str, str]:
    """Return all diagrams, SVG text by name."""
    torch.set_num_threads(1)
    parts = [module.diagrams() for module in (masks, filters, penalties, sampling, contradictions)]
    shown = {name: content for part in parts for name, content in part.items()}
    return {
        name: content if isinstance(content, str) else drawn(name, content) for name, content in shown.items()
    }


def same(first: str, second: str) -> bool:
    """Return True if two diagrams differ in nothing but rounding."""
    figure = re.compile(r"-?\d+(?:\.\d+)?")
    if figure.sub("", first) != figure.sub("", second):
        return False
    pairs = zip(figure.findall(first), figure.findall(second), strict=True)
    return all(abs(float(a) - float(b)) <= TOLERANCE for a, b in pairs)


def main(words: Sequence[str] | None = None, folder: Path = FOLDER) -> int:
    """Write or check the diagrams; return the exit status."""

    def texts() -> dict[Path, str]:
        return {folder / f"{name}.svg": text for name, text in diagrams().items()}

    return write_or_check(words, "make_diagrams.py", texts, same, folder)


if __name__ == "__main__":
    sys.exit(main())
