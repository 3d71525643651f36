"""Variations of a composition that race: all are tried on the first views, and whoever is behind is dropped."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gridreg.ablation.edits import Plain, normalised
from gridreg.ablation.statistics import standard_error

FACTORS = (0.25, 4.0)
"""What every weight of the composition is multiplied by, one regularizer at a time."""

ADDITIONS: tuple[dict[str, Any], ...] = (
    {"name": "OcclusionLoss", "weight": 1e-3, "samples": 10},
    {"name": "DistortionLoss", "weight": 0.003},
    {"name": "FrequencyMask", "site": "density", "until": 0.2},
    {"name": "FrequencyMask", "site": "appearance", "until": 0.2},
)
"""What is tried where the composition has none of its kind."""

START = "preset"
FEWEST = 3
"""Views that a gain must be measured on."""


@dataclass(frozen=True)
class Gain:
    """PSNR of left-out views against the preset's, in dB.

    Args:
        label: of the variation.
        values: one for each view that both were tried on.
    """

    label: str
    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean over the views; 0 without any."""
        return math.fsum(self.values) / max(1, len(self.values))

    @property
    def error(self) -> float:
        """Standard error of the mean; infinite below two views."""
        return standard_error(self.values, self.mean) if len(self.values) > 1 else math.inf

    @property
    def holds(self) -> bool:
        """Whether it was measured on enough views and exceeds its standard error."""
        return len(self.values) >= FEWEST and self.mean > self.error


@dataclass(frozen=True)
class Outcome:
    """A race's end.

    Args:
        composition: that won, as plain data.
        gains: every one that was measured.
        winner: among them; None if the composition of the start stays.
    """

    composition: Plain
    gains: tuple[Gain, ...]
    winner: Gain | None


Trial = Callable[[Mapping[str, Plain], Sequence[int]], Mapping[tuple[str, int], float]]


def candidates(plain: Plain) -> dict[str, Plain]:
    """Return variations of a composition by label: a class left out, stronger, weaker, or added.

    Args:
        plain: as `gridreg.to_config` writes it.

    >>> list(candidates([{"name": "L1", "site": "density", "weight": 8e-5}]))[:3]
    ['L1 left out', 'L1 x 0.25', 'L1 x 4']
    """
    found: dict[str, Plain] = {}
    names = list(dict.fromkeys(r["name"] for r in plain))
    for name in names:
        found[f"{name} left out"] = [r for r in plain if r["name"] != name]
        weights = [r.get("weight") for r in plain if r["name"] == name]
        if all(isinstance(w, (int, float)) and w > 0 for w in weights):
            for factor in FACTORS:
                found[f"{name} x {factor:g}"] = [
                    {**r, "weight": r["weight"] * factor} if r["name"] == name else r for r in plain
                ]
    for name in dict.fromkeys(r["name"] for r in ADDITIONS):
        if name not in names:
            found[f"{name} added"] = [*plain, *normalised([r for r in ADDITIONS if r["name"] == name])]
    return found


def chosen(gains: Sequence[Gain]) -> Gain | None:
    """Return the variation with the best gain less its standard error, if that is above zero, else None."""
    return max((gain for gain in gains if gain.holds), key=lambda gain: gain.mean - gain.error, default=None)


def race(plain: Plain, views: int, trial: Trial, affordable: Callable[[int], int]) -> Outcome:
    """Race the variations of a composition.

    Args:
        plain: the composition to start from.
        views: that can be left out.
        trial: does the compositions of a mapping, with each of some views left out, and returns their PSNR by label
            and view; a composition that cannot be attached is missing in it.
        affordable: how many of so many further trials the budget allows.
    """
    rows = {START: plain, **candidates(plain)}
    alive, scores, done = list(rows), dict[tuple[str, int], float](), 0

    def gains() -> list[Gain]:
        found: dict[str, list[float]] = {}
        for (label, view), psnr in scores.items():
            found.setdefault(label, []).append(psnr - scores[START, view])
        return [Gain(label, tuple(values)) for label, values in found.items() if label != START]

    while done < views:
        # As many trials again as views are done are kept for all winners at once.
        count = len(alive) if done == 0 else affordable(len(alive) + done + 1) - done - 1
        if count < 2:
            break
        alive = alive[:count]
        scores.update(trial({label: rows[label] for label in alive}, [done]))
        done += 1
        raced = sorted((g for g in gains() if g.label in alive), key=lambda g: -g.mean)
        if done > 1:
            # Who is behind by more than a tenth of a decibel and its error goes, and of the rest the worse half.
            raced = [g for g in raced if g.mean + min(g.error, 0.1) > 0][: max(3, math.ceil(len(raced) / 2))]
        alive = [START, *(gain.label for gain in raced)]
    best: dict[str, str] = {}
    for gain in sorted(gains(), key=lambda g: g.mean - g.error):
        if len(gain.values) == done and gain.holds:
            best[gain.label.partition(" ")[0]] = gain.label
    if len(best) > 1:
        together, everything = " and ".join(best.values()), plain
        for label in best.values():
            everything = candidates(everything)[label]
        rows[together] = everything
        scores.update(trial({together: everything}, list(range(done))))
    winner = chosen(gains())
    return Outcome(plain if winner is None else rows[winner.label], tuple(gains()), winner)


def table(gains: Sequence[Gain]) -> str:
    """Return the gains in lines, best first."""
    rows = sorted(gains, key=lambda gain: -gain.mean)
    width = max((len(gain.label) for gain in rows), default=0)
    return "\n".join(
        f"{g.label:<{width}}  {g.mean:+6.2f} dB"
        + (f" +- {g.error:.2f}" if len(g.values) > 1 else "")
        + f", {len(g.values)} view{'s' * (len(g.values) != 1)}"
        for g in rows
    )
