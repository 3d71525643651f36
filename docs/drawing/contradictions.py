"""Diagrams of where the published sources contradict each other."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import gridreg
from drawing.masks import TOTAL, over_run, seen, site
from drawing.svg import Line, Ridges, document, number

CHANNELS = 18


def variant(name: str) -> gridreg.FrequencyMask:
    """The frequency mask in one of its forms, over the whole run."""
    return gridreg.FrequencyMask(site(), until=1.0, variant=name)  # type: ignore[arg-type]


def forms() -> dict[str, Ridges]:
    """The three forms side by side."""
    names = enumerate(("block", "printed", "authors"), start=1)
    return {
        f"contradiction-{name}": over_run(variant(name), channels=CHANNELS, series=[k] * CHANNELS)
        for k, name in names
    }


def one_channel(channel: int = 9) -> list[Line]:
    """One channel in both forms."""
    steps = np.arange(TOTAL + 1)
    block, printed = (
        seen(variant(name), channels=CHANNELS, steps=steps)[channel] for name in ("block", "printed")
    )
    return [Line(steps / TOTAL, block, 1, dashed=True), Line(steps / TOTAL, printed, 2)]


class Product(nn.Module):
    """Planes times lines of ones."""

    def __init__(self) -> None:
        super().__init__()
        self.plane, self.line = nn.Parameter(torch.ones(CHANNELS)), nn.Parameter(torch.ones(CHANNELS))

    def forward(self) -> torch.Tensor:
        """The products."""
        return self.plane * self.line


def squared(channel: int = 9) -> list[Line]:
    """The factor of a product if one factor is masked, or both."""
    steps = np.arange(int(0.25 * TOTAL), int(0.6 * TOTAL) + 1)
    lines = []
    for series, glob in enumerate(("line", "*"), start=1):
        field, row = Product(), []
        mask = gridreg.FrequencyMask(gridreg.parameters(glob, dim=0), until=1.0)
        with gridreg.apply(field, mask, total_steps=TOTAL) as handle, torch.no_grad():
            for step in steps.tolist():
                handle.step(step)
                row.append(float(field()[channel]))
        lines.append(Line(steps / TOTAL, row, series))
    return lines


def order(name: gridreg.encodings.Order, title: str, progress: float = 0.25, coordinates: str = "xyz") -> str:
    """Draw which waves a mask by channel index leaves open: columns are octaves."""
    count = 3
    octaves = gridreg.octaves_of_channels(len(coordinates), count, name)
    # The encoding of a point itself says which wave stands in which channel.
    point = torch.tensor([0.3, 0.7, 1.1], dtype=torch.float64)
    encoded = gridreg.positional_encoding(point, count, name).tolist()
    mask = gridreg.frequency_mask(len(octaves), progress, 1.0).tolist()
    parts = [f'<text x="12" y="15" class="title">{title}</text>']
    columns = ["itself", *(f"2^{k}" for k in range(count))]
    parts += [
        f'<text x="{104 + 60 * c}" y="38" text-anchor="middle">{text}</text>'
        for c, text in enumerate(columns)
    ]
    for r, (axis, wave) in enumerate((axis, wave) for axis in range(3) for wave in ("sin", "cos")):
        top = 46 + 24 * r
        parts.append(f'<text x="66" y="{top + 15}" text-anchor="end">{wave} {coordinates[axis]}</text>')
        for c in range(count + 1):
            if c == 0 and wave == "cos":
                continue
            angle = point[axis] * 2.0 ** (c - 1)
            wanted = float(point[axis] if c == 0 else angle.sin() if wave == "sin" else angle.cos())
            opened = mask[min(range(len(encoded)), key=lambda i: abs(encoded[i] - wanted))]
            x = 78 + 60 * c
            parts.append(f'<path class="hair" d="M{x} {top}h52v20h-52z"/>')
            if opened:
                parts.append(
                    f'<path class="area f{c or 5}" d="M{x} {top}h{number(52 * opened)}v20h-{number(52 * opened)}z"/>'
                )
    return document(parts, 200)


def diagrams() -> dict[str, Ridges | list[Line] | str]:
    """What each diagram shows, or SVG text."""
    nodes = np.arange(64, 513, 4)
    return {
        **forms(),
        "contradiction-channel": one_channel(),
        "contradiction-squared": squared(),
        "order-octave": order("octave", "octave by octave"),
        "order-sines": order("sines_first", "all sines, then all cosines"),
        "order-coordinate": order("coordinate", "coordinate by coordinate"),
        # How far 20 steps of half a voxel reach in a box of edge 3.
        "contradiction-reach": [
            Line(nodes, 20 * 0.5 * 3.0 / (nodes - 1)),
            Line([64, 512], [0.3, 0.3], 2, dashed=True),
        ],
    }
