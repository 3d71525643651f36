"""Write docs/pictures/*.svg, drawn from what the code computes.

python docs/make_pictures.py            write the pictures
python docs/make_pictures.py --check    exit with status 1 if one is stale, missing or left over
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from drawing import comparison, filters, masks, penalties, sampling

FOLDER = Path(__file__).with_name("pictures")
# Pixels. Processors round sums differently in the last digits.
TOLERANCE = 0.25


def pictures() -> dict[str, str]:
    """All pictures, SVG text by name."""
    torch.set_num_threads(1)
    parts = [module.pictures() for module in (masks, filters, penalties, sampling, comparison)]
    return {name: text for part in parts for name, text in part.items()}


def same(first: str, second: str) -> bool:
    """Whether two pictures differ in nothing but rounding."""
    figure = re.compile(r"-?\d+(?:\.\d+)?")
    if figure.sub("", first) != figure.sub("", second):
        return False
    pairs = zip(figure.findall(first), figure.findall(second), strict=True)
    return all(abs(float(a) - float(b)) <= TOLERANCE for a, b in pairs)


def stale(drawn: dict[str, str], folder: Path) -> list[str]:
    """Names of files that are not as drawn, are missing, or belong to no picture."""
    wrong = [
        f"{name}.svg"
        for name, text in drawn.items()
        if not (folder / f"{name}.svg").is_file()
        or not same((folder / f"{name}.svg").read_text("utf-8"), text)
    ]
    return wrong + [path.name for path in sorted(folder.glob("*.svg")) if path.stem not in drawn]


def main(arguments: Sequence[str] | None = None, folder: Path = FOLDER) -> int:
    """Write or check the pictures; the exit status."""
    parser = argparse.ArgumentParser(description="Write docs/pictures/*.svg from the code.")
    parser.add_argument("--check", action="store_true", help="only say which pictures are stale")
    check = parser.parse_args(arguments).check
    drawn = pictures()
    wrong = stale(drawn, folder)
    if check:
        print(
            f"{folder.name}: "
            + (f"stale: {', '.join(wrong)}; run python docs/make_pictures.py" if wrong else "up to date")
        )
        return int(bool(wrong))
    folder.mkdir(exist_ok=True)
    for name in wrong:
        path = folder / name
        if path.stem not in drawn:
            path.unlink()
            continue
        beside = path.with_suffix(".tmp")
        beside.write_text(drawn[path.stem], encoding="utf-8")
        beside.replace(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
