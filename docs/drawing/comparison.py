"""Diagrams of where the published sources contradict each other."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import gridreg
from drawing.masks import SHARES, TOTAL, seen, site
from drawing.svg import Panel, document, number, ridges

CHANNELS = 18


def variant(name: str) -> gridreg.FrequencyMask:
    """The frequency mask in one of its forms, over the whole run."""
    return gridreg.FrequencyMask(site(), until=1.0, variant=name)  # type: ignore[arg-type]


def forms() -> dict[str, str]:
    """The three forms side by side."""
    titles = {
        "block": "block: FreeNeRF's program, ours",
        "printed": "printed: the equation in the papers",
        "authors": "authors: Few TensoRF's program",
    }
    return {
        f"contradiction-{name}": ridges(
            title, seen(variant(name), channels=CHANNELS), SHARES, series=[k] * CHANNELS
        )
        for k, (name, title) in enumerate(titles.items(), start=1)
    }


def one_channel(channel: int = 9) -> str:
    """One channel in both forms."""
    panel = Panel(
        f"Channel {channel} of {CHANNELS} over the run",
        x=(0, 1), y=(0, 1.25), x_label="fraction of the run", y_label="mask", x_ticks=(0, 0.2, 0.4, 0.6, 0.8, 1),
        y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    steps = np.arange(TOTAL + 1)
    for series, name in enumerate(("block", "printed"), start=1):
        row = seen(variant(name), channels=CHANNELS, steps=steps)[channel]
        panel.line(steps / TOTAL, row, series, dashed=name == "block")
    panel.note(0.47, 0.6, "block", 1)
    panel.note(0.02, 1.12, "printed: falls from almost 1 to 0, twice", 2)
    return panel.svg()


class Product(nn.Module):
    """Planes times lines of ones."""

    def __init__(self) -> None:
        super().__init__()
        self.plane, self.line = nn.Parameter(torch.ones(CHANNELS)), nn.Parameter(torch.ones(CHANNELS))

    def forward(self) -> torch.Tensor:
        """The products."""
        return self.plane * self.line


def squared(channel: int = 9) -> str:
    """Draw the factor of a product if one factor is masked, or both."""
    panel = Panel(
        f"Factor of a plane-line product, channel {channel}",
        x=(0.25, 0.6), y=(0, 1.15), x_label="fraction of the run", x_ticks=(0.3, 0.4, 0.5, 0.6), y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    steps = np.arange(int(0.25 * TOTAL), int(0.6 * TOTAL) + 1)
    for series, (glob, text) in enumerate((("line", "line masked"), ("*", "both masked")), start=1):
        field, row = Product(), []
        mask = gridreg.FrequencyMask(gridreg.parameters(glob, dim=0), until=1.0)
        with gridreg.apply(field, mask, total_steps=TOTAL) as handle, torch.no_grad():
            for step in steps.tolist():
                handle.step(step)
                row.append(float(field()[channel]))
        panel.line(steps / TOTAL, row, series)
        panel.note(0.275, 1.02 - 0.14 * series, text, series)
    return panel.svg()


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


def reach() -> str:
    """Draw how far 20 steps of half a voxel reach in a box of edge 3."""
    nodes = np.arange(64, 513, 4)
    panel = Panel(
        "Reach of the first 20 steps, box of edge 3",
        x=(64, 512), y=(0, 0.5), x_label="nodes along an edge (step: half a voxel)", y_label="world units",
        x_ticks=(64, 128, 300, 512), y_ticks=(0, 0.1, 0.2, 0.3, 0.4, 0.5),
    )  # fmt: skip
    panel.line(nodes, 20 * 0.5 * 3.0 / (nodes - 1))
    panel.line([64, 512], [0.3, 0.3], 2, dashed=True)
    panel.note(500, 0.315, "distance=0.3", 2, "end")
    panel.note(150, 0.22, "samples=20", 1)
    return panel.svg()


def diagrams() -> dict[str, str]:
    """SVG text by name."""
    return {
        **forms(),
        "contradiction-channel": one_channel(),
        "contradiction-squared": squared(),
        "order-octave": order("octave", "octave by octave"),
        "order-sines": order("sines_first", "all sines, then all cosines"),
        "order-coordinate": order("coordinate", "coordinate by coordinate"),
        "contradiction-reach": reach(),
    }
