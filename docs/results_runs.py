"""The stored runs that docs/results.md is made of, their figures, and how these are written."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gridreg.ablation.statistics import Estimate, estimate
from gridreg.ablation.tables import signed

STUDY_STORE = Path(__file__).parent.parent / "benchmarks" / "results"
STORE = STUDY_STORE / "quality"
ENSEMBLE_STORE = STUDY_STORE / "ensembles"


def records_in(folder: Path, pattern: str = "*.json") -> list[dict[str, Any]]:
    """All stored runs of a folder whose names fit, in the order of these."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(pattern))]


class Runs:
    """The stored runs, by scene, protocol, run and seed; changed ones and those of the plain path are left out.

    A run of another length than its preset's is called ``RUN --steps N``.
    """

    def __init__(self, folder: Path = STORE) -> None:
        self.records: dict[tuple[str, str, str], dict[int, dict[str, Any]]] = {}
        for record in records_in(folder):
            if record["changes"] or "--backend" in record["command"]:
                continue
            length = f" --steps {record['steps']}" if "--steps" in record["command"] else ""
            key = (record["scene"], record["protocol"], record["run"] + length)
            self.records.setdefault(key, {})[record["seed"]] = record

    def of(self, scene: str, protocol: str, run: str) -> dict[int, dict[str, Any]]:
        """Records by seed."""
        return self.records.get((scene, protocol, run), {})

    def mean(
        self, scene: str, protocol: str, run: str, pick: Callable[[dict[str, Any]], float]
    ) -> Estimate | None:
        """Mean over seeds of a figure; None without a run."""
        found = [pick(record) for record in self.of(scene, protocol, run).values()]
        return estimate(found) if found else None

    def gains(
        self, scenes: Sequence[str], protocol: str, run: str, base: str, base_protocol: str | None = None
    ) -> list[float]:
        """Differences of PSNR (dB) of two runs, over the pairs of scene and seed that both have."""
        pairs = []
        for scene in scenes:
            ours, theirs = self.of(scene, protocol, run), self.of(scene, base_protocol or protocol, base)
            pairs += [psnr(ours[seed]) - psnr(theirs[seed]) for seed in sorted(ours.keys() & theirs.keys())]
        return pairs


def psnr(record: dict[str, Any]) -> float:
    """Mean PSNR, dB."""
    return float(record["mean"]["psnr"])


def ssim(record: dict[str, Any]) -> float:
    """Mean SSIM, Gaussian windows."""
    return float(record["mean"]["ssim_gaussian"])


def study_gains(records: Sequence[dict[str, Any]], label: str) -> list[float]:
    """Differences of PSNR (dB) of a study's row to its baseline, over the pairs of scene and seed that both have."""
    row, base = (
        {(record["scene"], record["seed"]): psnr(record) for record in records if record["label"] == wanted}
        for wanted in (label, records[0]["baseline"])
    )
    return [row[pair] - base[pair] for pair in sorted(row.keys() & base.keys())]


def least_to_most(gains: Sequence[float]) -> str:
    """``−0.18 to +0.10``."""
    return f"{signed(min(gains))} to {signed(max(gains))}"


def time_taken(records: dict[int, dict[str, Any]]) -> str:
    """``7.1; 1/2``: minutes of training, the median of the seeds, and how many threads each had; or a dash."""
    if not records:
        return "–"
    minutes = statistics.median(record["seconds"]["train"] / 60 for record in records.values())
    threads = "/".join(map(str, sorted({record["versions"]["threads"] for record in records.values()})))
    return f"{minutes:.1f}; {threads}"


def with_spread(found: Estimate | None, digits: int = 2) -> str:
    """``25.10 ± 0.20 (3)``, ``25.10 (1)`` or a dash."""
    if found is None:
        return "–"
    spread = "" if found.half_width is None else f" ± {found.half_width:.{digits}f}"
    return f"{found.mean:.{digits}f}{spread} ({found.count})"


def with_interval(found: Estimate) -> str:
    """``−0.04 [−0.14, +0.06]``, or the mean of one pair alone."""
    spread = "" if found.half_width is None else f" [{signed(found.low)}, {signed(found.high)}]"
    return f"{signed(found.mean)}{spread}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
