"""Damaged inputs of every format, for as long as is asked: how many were refused, accepted, and failed.

    python benchmarks/fuzz.py --minutes 30

A failure is an exception other than `gridreg.InputError`, a refusal that is not one clear line, something accepted that
is not finite, positive and ordered, or more than two seconds of processor time. The files of each failure are kept in
the folder ``--corpus``, so that it can be looked at and become a test; the figures of each format are printed.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.fuzz.formats import Input, inputs
from tests.fuzz.judge import judge

ROUND = 200


def campaign(minutes: float, corpus: Path, first_seed: int = 0) -> dict[str, Counter[str]]:
    """Judge inputs until the time is up.

    Args:
        minutes: how long.
        corpus: folder for the files of what failed.
        first_seed: of the first round of inputs; each round has the next one.

    Returns:
        For each format how many inputs were refused, accepted and failed.
    """
    counts: dict[str, Counter[str]] = {}
    end = time.monotonic() + 60 * minutes

    def one_round(number: int) -> None:
        @seed(number)
        @settings(
            max_examples=ROUND,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(inputs())
        def look(item: Input) -> None:
            with tempfile.TemporaryDirectory() as folder:
                verdict = judge(item, Path(folder))
                tally = counts.setdefault(item.kind, Counter())
                tally[verdict.outcome] += 1
                if verdict.outcome == "failed":
                    place = corpus / f"{item.kind.replace(' ', '_')}-{number}-{tally['failed']}"
                    shutil.copytree(folder, place, dirs_exist_ok=True)
                    print(f"{item.kind}: {verdict.said} ({place})", file=sys.stderr, flush=True)

        look()

    number = first_seed
    while time.monotonic() < end:
        one_round(number)
        number += 1
    return counts


def main() -> None:
    """Run a campaign and print its figures; exit with 1 if anything failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long")
    parser.add_argument("--corpus", type=Path, default=Path("outputs/fuzz"), help="where failures are kept")
    parser.add_argument("--seed", type=int, default=0, help="of the first round")
    options = parser.parse_args()
    counts = campaign(options.minutes, options.corpus, options.seed)
    total: Counter[str] = Counter()
    for kind, tally in sorted(counts.items()):
        total += tally
        print(f"{kind:16} {tally.total():7} tried {_words(tally)}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{'all':16} {total.total():7} tried {_words(total)}, at most {peak:.0f} MB")
    sys.exit(1 if total["failed"] else 0)


def _words(tally: Counter[str]) -> str:
    return ", ".join(f"{tally[outcome]:7} {outcome}" for outcome in ("refused", "accepted", "failed"))


if __name__ == "__main__":
    main()
