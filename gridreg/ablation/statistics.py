"""Means with intervals, and paired differences against a baseline.

Scenes differ by far more than regularizers do (lego and drums by 7 dB), so a mean over scenes says little about
which of two compositions is better. The difference of two runs that share scene, views, seed, preset and backbone
does not contain the scene any more; its mean over such *pairs* is what is judged here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.special import stdtr, stdtrit  # type: ignore[import-untyped]

from gridreg.errors import InputError

Verdict = Literal["higher", "lower", "within noise", "one pair", "no pair"]


@dataclass(frozen=True, order=True)
class Cell:
    """Everything that determines a run but the composition: two runs that share it are a pair.

    Args:
        scene: its name.
        protocol: name.
        views: number of training views.
        seed: of the run.
        preset: name.
        backbone: name.
        size: width of the images in pixels; 0: the protocol's.
    """

    scene: str
    protocol: str
    views: int
    seed: int
    preset: str
    backbone: str
    size: int = 0


@dataclass(frozen=True)
class Estimate:
    """A mean and how well it is known.

    Args:
        mean: of the values.
        half_width: of the interval around it; None when there is one value, which tells nothing about scatter.
        count: of the values.
    """

    mean: float
    half_width: float | None
    count: int

    @property
    def low(self) -> float:
        """Lower end of the interval; NaN when there is none."""
        return self.mean - (math.nan if self.half_width is None else self.half_width)

    @property
    def high(self) -> float:
        """Upper end of the interval; NaN when there is none."""
        return self.mean + (math.nan if self.half_width is None else self.half_width)


@dataclass(frozen=True)
class Difference:
    """A composition less the baseline, over the pairs that both have.

    Args:
        pairs: the difference of each pair.
        estimate: their mean and interval; None without a pair.
        p_value: of the two-sided paired t test of "no difference"; None below two pairs.
    """

    pairs: Mapping[Cell, float]
    estimate: Estimate | None
    p_value: float | None

    @property
    def verdict(self) -> Verdict:
        """Whether the interval leaves 0 out, and on which side."""
        if self.estimate is None:
            return "no pair"
        if self.estimate.half_width is None:
            return "one pair"
        if self.estimate.low > 0:
            return "higher"
        return "lower" if self.estimate.high < 0 else "within noise"


def estimate(values: Iterable[float], confidence: float = 0.95) -> Estimate:
    """Mean of a sample and its interval by Student's t, ``mean +- t(n - 1) s / sqrt(n)``.

    The interval holds for the mean of a normal population of which the values are independent draws (Student 1908).

    Args:
        values: at least one, all finite.
        confidence: probability that such an interval covers the true mean.

    Raises:
        InputError: without a value, with one that is not finite, or a confidence outside (0, 1).

    >>> e = estimate([1.0, 2.0, 3.0])
    >>> e.mean, round(e.half_width, 3), e.count
    (2.0, 2.484, 3)
    """
    sample = [float(value) for value in values]
    if not sample or not all(math.isfinite(value) for value in sample):
        raise InputError(f"values={sample}: expected at least one number, all finite")
    if not 0 < confidence < 1:
        raise InputError(f"confidence={confidence}: expected a number between 0 and 1")
    count = len(sample)
    # Exactly rounded sums: the order of the runs in the store must not show in the last digit.
    mean = math.fsum(sample) / count
    if count == 1:
        return Estimate(mean, None, 1)
    return Estimate(
        mean, float(stdtrit(count - 1, (1 + confidence) / 2)) * standard_error(sample, mean), count
    )


def paired_differences(values: Mapping[str, Mapping[Cell, float]], baseline: str) -> dict[str, Difference]:
    """The difference of every composition to the baseline, pair by pair.

    Runs without a partner are left out of the difference (they count in plain means). All pairs weigh the same.

    Args:
        values: a figure by composition and cell.
        baseline: the composition that is subtracted.

    Returns:
        By composition, the baseline left out.

    Raises:
        InputError: ``values`` does not know the baseline.

    >>> cells = [Cell("lego", "dietnerf8", 8, seed, "quick", "vm") for seed in (0, 1)]
    >>> found = paired_differences(
    ...     {"tv": dict(zip(cells, [26.5, 25.5])), "none": dict(zip(cells, [25.0, 24.0]))}, "none"
    ... )
    >>> found["tv"].estimate.mean, found["tv"].verdict
    (1.5, 'higher')
    """
    if baseline not in values:
        raise InputError(f"baseline={baseline!r}: expected one of {', '.join(map(repr, values))}")
    reference = values[baseline]
    differences = {}
    for label, cells in values.items():
        if label != baseline:
            shared = sorted(cell for cell in cells if cell in reference)
            pairs = {cell: cells[cell] - reference[cell] for cell in shared}
            found = estimate(pairs.values()) if pairs else None
            differences[label] = Difference(pairs, found, _p_value(list(pairs.values())))
    return differences


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number, so that the chance of *any* false finding stays below the level.

    Holm's step-down procedure: the k-th smallest of m is multiplied by m - k + 1, and none is below a smaller one's.

    Source: Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6 (1979).

    Raises:
        InputError: a value outside [0, 1].

    >>> holm([0.04, 0.01])
    [0.04, 0.02]
    """
    for p in p_values:
        if not 0 <= p <= 1:
            raise InputError(f"p_values: found {p}, expected numbers from 0 to 1")
    adjusted = [0.0] * len(p_values)
    least = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        least = min(1.0, max(least, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = least
    return adjusted


def standard_error(sample: Sequence[float], mean: float) -> float:
    """Standard error of the mean of a sample of at least two."""
    count = len(sample)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in sample) / (count - 1) / count)


def _p_value(sample: Sequence[float]) -> float | None:
    if len(sample) < 2:
        return None
    mean = math.fsum(sample) / len(sample)
    error = standard_error(sample, mean)
    if error == 0:
        return 0.0 if mean else 1.0
    return float(2 * stdtr(len(sample) - 1, -abs(mean / error)))
