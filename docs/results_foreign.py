"""The table of gains on fields of other programs, and the README's sentence, from benchmarks/results/foreign.jsonl."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from results_tables import ROWS, seeds_in_words, table, with_interval
from stored import RESULTS, Record, load

NAMES, PIECES = ROWS["foreign"]["fields"], ROWS["foreign"]["pieces"]


class Gain(NamedTuple):
    """A field on a scene: PSNR bare, what a composition gains by seed and by image, dB; its cost, percent of a step."""

    scene: str
    composition: str
    bare: float
    seeds: list[float]
    images: list[float]
    cost: float


def gains(folder: Path = RESULTS) -> dict[str, list[Gain]]:
    """Every field whose test views were scored, on every scene."""
    runs: dict[tuple[str, str, str], list[Record]] = {}
    for record in load("foreign", folder):
        if record["split"] == "test":
            runs.setdefault((record["field"], record["scene"], record["composition"]), []).append(record)
    found: dict[str, list[Gain]] = {field: [] for field in NAMES}
    for (field, scene, composition), records in sorted(runs.items()):
        pairs = [list(zip(r["psnr"]["attached"], r["psnr"]["bare"], strict=True)) for r in records]
        by_seed = [[a - b for a, b in images] for images in pairs]
        seconds = [r["step_seconds"]["attached"] / r["step_seconds"]["bare"] - 1 for r in records]
        found[field].append(
            Gain(
                scene,
                composition,
                statistics.fmean(b for images in pairs for _, b in images),
                [statistics.fmean(images) for images in by_seed],
                [gain for images in by_seed for gain in images],
                100 * statistics.median(seconds),
            )
        )
    return {field: rows for field, rows in found.items() if rows}


def in_words(composition: str) -> str:
    """Names and weights of the pieces of a composition."""
    pieces = (piece.partition(":") for piece in composition.split("+"))
    return ", ".join(PIECES[kind] + (f" {weight}" if weight else "") for kind, _, weight in pieces)


def foreign(folder: Path = RESULTS) -> str:
    """The table."""
    opened = {r["field"]: r["percent"] for r in load("foreign", folder) if r["split"] == "cost"}
    rows = []
    for field, found in gains(folder).items():
        for gain in found:
            better = f"{sum(value > 0 for value in gain.images)} of {len(gain.images)}"
            seeds = f"{with_interval(gain.seeds)} ({seeds_in_words(len(gain.seeds))})"
            what = [NAMES[field], in_words(gain.composition)]
            rows.append([*what, gain.scene, f"{gain.bare:.2f}", seeds, better, f"{gain.cost:+.0f} %", ""])
        pairs = [value for gain in found for value in gain.seeds]
        both = f"{with_interval(pairs)} ({len(pairs)} pairs)"
        masks = f"{opened[field]:+.1f} %" if field in opened else "–"
        rows.append([f"**{NAMES[field]}**", "", "together", "", both, "", "", masks])
    head = [
        "field",
        "composition",
        "scene",
        "bare (dB)",
        "gain (dB)",
        "images that gain",
        "step",
        "open masks",
    ]
    return table(head, rows)


def sentence(folder: Path = RESULTS) -> str:
    """The README's sentence."""
    parts, count = [], 0
    for field, found in gains(folder).items():
        pairs = [value for gain in found for value in gain.seeds]
        count += len(pairs)
        parts.append(f"{with_interval(pairs)} on {NAMES[field]}")
    return (
        f"Attached to fields of other programs (8 views, short runs, {count} pairs of scene and seed), the composition "
        f"that validation views chose gains {', '.join(parts)}, in dB with 95 % intervals: "
        "[the table](docs/results.md#fields-of-other-programs)."
    )


def chosen_on(folder: Path = RESULTS) -> Sequence[str]:
    """For each field the scenes whose validation views chose its composition."""
    scenes: dict[str, set[str]] = {}
    for record in load("foreign", folder):
        if record["split"] == "validation":
            scenes.setdefault(record["field"], set()).add(record["scene"])
    return [f"{NAMES[field]} by {' and '.join(sorted(scenes[field]))}" for field in NAMES if field in scenes]
