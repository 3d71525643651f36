"""Write docs/results.md and tables of README.md and docs/photographs.md from the figures in benchmarks/results.

python docs/make_results.py            write them
python docs/make_results.py --check    exit with status 1 if one is stale

The page's words stand in docs/results.md.jinja, the rows of its tables in docs/results.yaml.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import results_foreign
from generated import rendered, write_or_check
from results_tables import RESULTS, ROWS, Results, load, table

PAGE, README = Path(__file__).with_name("results.md"), Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"
FOREIGN = "<!-- foreign: begin -->", "<!-- foreign: end -->"
PHOTOGRAPHS = Path(__file__).with_name("photographs.md")
SHEET = "<!-- sheet: begin -->", "<!-- sheet: end -->"


def between(page: str, text: str, first: str, last: str) -> str:
    """Return a page with what is between two marks renewed."""
    before, begin, rest = page.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise ValueError(f"found no table between {first!r} and {last!r}")
    return f"{before}{begin}{text}{end}{after}"


def sheet(folder: Path = RESULTS) -> str:
    """Return what ``gridreg reconstruct`` makes of the built-in photographs, measured against the truth."""
    (one,) = [r for r in load("own_photographs", folder) if r["name"].startswith("sheet-8x")]
    rows = [
        (name, text.format(minutes=one["seconds"]["wall"] / 60, **one))
        for name, text in ROWS["sheet"].items()
    ]
    return f"\n{table(('', 'measured'), rows)}\n"


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page and the table; return the exit status."""

    def texts() -> dict[Path, str]:
        results = Results()
        readme = between(README.read_text(encoding="utf-8"), f"\n{results.front()}\n", BEGIN, END)
        photographs = between(PHOTOGRAPHS.read_text(encoding="utf-8"), sheet(), *SHEET)
        front = between(readme, results_foreign.sentence(), *FOREIGN)
        page = rendered("results.md", results=results, foreign=results_foreign)
        return {PAGE: page, README: front, PHOTOGRAPHS: photographs}

    return write_or_check(words, "make_results.py", texts)


if __name__ == "__main__":
    sys.exit(main())
