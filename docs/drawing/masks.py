"""Diagrams of masks: what a field gets to see of a grid of ones, at every step of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

import gridreg
from drawing.svg import Ridges

TOTAL = 600
STEPS = np.arange(TOTAL + 1)
FRACTIONS = STEPS / TOTAL


class Ones(nn.Module):
    """A grid of ones, ``(channels, 4)``."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.ones(channels, 4))


def seen(
    *regularizers: gridreg.Regularizer, channels: int, steps: NDArray[np.int64] = STEPS
) -> NDArray[np.float64]:
    """Return what the field sees of ones at ``(channels, steps)``, through regularizers attached to ``grid``."""
    field = Ones(channels)
    columns = []
    with gridreg.apply(field, *regularizers, total_steps=TOTAL) as handle, torch.no_grad():
        for step in steps.tolist():
            handle.step(step)
            columns.append(field.grid[:, 0].double().numpy())
    return np.stack(columns, axis=1)


def site(octaves: Sequence[int] | None = None) -> gridreg.Selector:
    """The grid of `Ones`."""
    return gridreg.parameters("grid", dim=0, octaves=octaves)


def by_octave(octaves: Sequence[int]) -> list[int]:
    """A colour for each octave, grey for what is encoded itself."""
    return [5 if octave < 0 else 1 + octave % 4 for octave in octaves]


def encoding_labels(coordinates: str, octaves: Sequence[int]) -> list[str]:
    """Names of the channels of an encoding in the order of coordinates."""
    count = max(octaves) + 1
    factors = ["" if k == 0 else str(2**k) for k in range(count)]
    waves = [
        f"{wave} {factor}{axis}" for wave in ("sin", "cos") for axis in coordinates for factor in factors
    ]
    return [*coordinates, *waves]


def over_run(
    *regularizers: gridreg.Regularizer,
    channels: int,
    series: Sequence[int] | None = None,
    labels: Sequence[str] | None = None,
) -> Ridges:
    """Regularizers over the whole run."""
    return Ridges(seen(*regularizers, channels=channels), FRACTIONS, series, labels)


def diagrams() -> dict[str, Ridges]:
    """What each diagram shows."""
    coordinate = gridreg.octaves_of_channels(2, 4, "coordinate")
    octave = gridreg.octaves_of_channels(2, 4, "octave")
    levels = [level for level in range(8) for _ in range(2)]
    rising, fixed = gridreg.FrequencyMask(site(), until=0.9), gridreg.FixedMask(site(), visible_ratio=0.8)
    # A draw holds until the next step.
    coarse = np.arange(0, TOTAL + 1, 12)
    held = np.repeat(coarse, 2)[1:] / TOTAL
    draws = seen(gridreg.ComponentDropout(site()), channels=10, steps=coarse)
    return {
        "mask-frequency": over_run(rising, channels=18),
        "mask-octaves": over_run(
            gridreg.FrequencyMask(site(coordinate), until=0.9),
            channels=18,
            series=by_octave(coordinate),
            labels=encoding_labels("xy", coordinate),
        ),
        "mask-fixed": over_run(fixed, channels=18),
        "mask-cosine": over_run(
            gridreg.CosineMask(site(octave), until=0.9), channels=18, series=by_octave(octave)
        ),
        "mask-level": over_run(
            gridreg.LevelMask(site(), start=2, every=0.1), channels=16, series=by_octave(levels)
        ),
        "mask-view": over_run(
            gridreg.ViewDependenceMask(site(), bands=2, until=0.7),
            channels=9,
            series=by_octave(gridreg.spherical_bands(9)),
        ),
        "mask-two": over_run(rising, fixed, channels=18),
        "mask-dropout": Ridges(np.repeat(draws, 2, axis=1)[:, :-1] / 1.25, held),
    }
