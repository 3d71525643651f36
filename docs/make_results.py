"""Write docs/results.md and the table in README.md from the figures stored in benchmarks/results.

python docs/make_results.py            write both
python docs/make_results.py --check    exit with status 1 if one is stale

The page's words stand in docs/results.md.jinja, the rows of its tables in docs/results.yaml.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import jinja2

sys.path.insert(0, str(Path(__file__).parent))
from results_tables import Results

from gridreg.training.files import write_text

TEMPLATE = Path(__file__).with_name("results.md.jinja")
PAGE, README = Path(__file__).with_name("results.md"), Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"


def page(results: Results) -> str:
    """Return the whole page."""
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(results=results)


def with_front(readme: str, front: str) -> str:
    """Return README.md with its table renewed, between the marks around it."""
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md: found no table between {BEGIN!r} and {END!r}")
    return f"{before}{begin}\n{front}\n{end}{after}"


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only say whether they are up to date")
    arguments = parser.parse_args(words)
    results = Results()
    readme = with_front(README.read_text(encoding="utf-8"), results.front())
    written = {PAGE: page(results), README: readme}
    stale = [path for path, text in written.items() if path.read_text(encoding="utf-8") != text]
    if arguments.check:
        names = ", ".join(path.name for path in stale)
        print(f"{names}: stale; run python docs/make_results.py" if stale else "up to date")
        return int(bool(stale))
    for path in stale:
        write_text(path, written[path])
    return 0


if __name__ == "__main__":
    sys.exit(main())
