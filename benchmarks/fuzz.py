"""Damaged inputs of every format, for as long as is asked: how many were refused, accepted, and failed.

    python benchmarks/fuzz.py --minutes 30
    python benchmarks/fuzz.py --inputs 20000

A failure is an exception other than `gridreg.InputError`, a refusal that is not one printable line of at most 500
characters, something accepted that is not finite, positive and ordered, more than two seconds of processor time, or
more than 300 MB of memory at any moment. Memory is counted from what this process holds after all imports and one
sound input of each format (that figure is printed): its peak is counted anew for every input (``VmHWM``). Each
failure is kept as a file in the folder ``--corpus``, from where it goes to ``tests/fuzz/corpus``, which a test
replays. The figures go to benchmarks/results/fuzz.jsonl after each round of 200 inputs, by first seed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import stored
from hypothesis import HealthCheck, Phase, given, seed, settings

from gridreg.training.versions import versions

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.fuzz.corpus import store
from tests.fuzz.formats import Input
from tests.fuzz.formats_of_runs import inputs
from tests.fuzz.judge import Verdict, judge, memory

ROUND = 200
WARM_UP = 2


@dataclass
class Campaign:
    """What was tried so far.

    Attributes:
        corpus: folder for the files of what failed.
        base: memory that the process held before the first input, MB.
        seen: verdicts by format.
    """

    corpus: Path
    base: float = 0.0
    seen: dict[str, list[Verdict]] = field(default_factory=dict)

    @property
    def total(self) -> int:
        """Number of inputs."""
        return sum(map(len, self.seen.values()))

    def add(self, item: Input, verdict: Verdict) -> None:
        """Count an input and keep one that failed."""
        self.seen.setdefault(item.kind, []).append(verdict)
        if verdict.outcome == "failed":
            place = self.corpus / f"{item.kind.replace(' ', '_').replace('.', '_')}-{self.total}.json"
            store(item, verdict.said, place)
            print(f"{item.kind}: {verdict.said} ({place})", file=sys.stderr, flush=True)

    def round(self, number: int, count: int, keep: bool = True) -> None:
        """Judge inputs; the number is their seed."""

        @seed(number)
        @settings(
            max_examples=count,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(inputs())
        def look(item: Input) -> None:
            with tempfile.TemporaryDirectory() as folder:
                verdict = judge(item, Path(folder), base=self.base or None)
                if keep:
                    self.add(item, verdict)

        look()

    def record(self, first_seed: int, began: float) -> dict[str, Any]:
        """Return the figures as plain data."""
        formats = {}
        for kind, verdicts in sorted(self.seen.items()):
            outcomes = [verdict.outcome for verdict in verdicts]
            formats[kind] = {
                "tried": len(verdicts),
                **{outcome: outcomes.count(outcome) for outcome in ("refused", "accepted", "failed")},
                "seconds": round(max(verdict.seconds for verdict in verdicts), 2),
                "megabytes": round(max(verdict.megabytes for verdict in verdicts)),
            }
        said = Counter(
            f"{kind}: {v.said[:60]}" for kind, own in self.seen.items() for v in own if v.outcome == "failed"
        )
        return {
            "tried": self.total,
            "failed": said.total(),
            "first_seed": first_seed,
            "seconds": round(time.monotonic() - began),
            "base_megabytes": round(self.base),
            "formats": formats,
            "failures": dict(said.most_common(20)),
            "versions": versions(),
        }


def main() -> None:
    """Run a campaign, print and store its figures; exit with 1 if anything failed."""
    parser = stored.parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="how long, at the least")
    parser.add_argument("--inputs", type=int, default=0, help="how many, at the least")
    parser.add_argument("--corpus", type=Path, default=Path("outputs/fuzz"), help="folder for failures")
    parser.add_argument("--seed", type=int, default=0, help="of the first round")
    options = parser.parse_args()
    began, end = time.monotonic(), time.monotonic() + 60 * (0.0 if options.inputs else options.minutes)
    campaign = Campaign(options.corpus)
    # What is imported late, and what the readers keep for good, is part of the process and not of an input.
    campaign.round(10**6 + options.seed, WARM_UP * ROUND, keep=False)
    campaign.base = memory()[0]
    number = options.seed
    while campaign.total < options.inputs or time.monotonic() < end:
        campaign.round(number, ROUND)
        number += 1
        stored.save("fuzz", f"seed {options.seed}", campaign.record(options.seed, began), options.results)
    record = campaign.record(options.seed, began)
    for kind, figures in record["formats"].items():
        print(f"{kind:16} {figures}")
    shown = {key: record[key] for key in ("tried", "failed", "seconds", "base_megabytes")}
    print(f"{'all':16} {shown}")
    sys.exit(1 if record["failed"] else 0)


if __name__ == "__main__":
    main()
