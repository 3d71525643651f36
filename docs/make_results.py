"""Write docs/results.md and the table in README.md from the figures stored in benchmarks/results.

python docs/make_results.py            write both
python docs/make_results.py --check    exit with status 1 if one is stale

The page's words stand in docs/results.md.jinja, the rows of its tables in docs/results.yaml.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import jinja2

sys.path.insert(0, str(Path(__file__).parent))
import results_foreign
from generated import write_or_check
from results_tables import Results

TEMPLATE = Path(__file__).with_name("results.md.jinja")
PAGE, README = Path(__file__).with_name("results.md"), Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"
FOREIGN = "<!-- foreign: begin -->", "<!-- foreign: end -->"


def page(results: Results) -> str:
    """Return the whole page."""
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        results=results, foreign=results_foreign
    )


def with_front(readme: str, front: str) -> str:
    """Return README.md with its table renewed, between the marks around it."""
    return between(readme, f"\n{front}\n", BEGIN, END)


def between(readme: str, text: str, first: str, last: str) -> str:
    """Return README.md with what is between two marks renewed."""
    before, begin, rest = readme.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise ValueError(f"README.md: found no table between {first!r} and {last!r}")
    return f"{before}{begin}{text}{end}{after}"


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page and the table; return the exit status."""

    def texts() -> dict[Path, str]:
        results = Results()
        readme = with_front(README.read_text(encoding="utf-8"), results.front())
        return {PAGE: page(results), README: between(readme, results_foreign.sentence(), *FOREIGN)}

    return write_or_check(words, "make_results.py", texts)


if __name__ == "__main__":
    sys.exit(main())
