"""Diagrams of low-passes: what passes, and what it does to a line of a grid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

import gridreg
from drawing.svg import Panel
from gridreg.regularizers.filters import low_pass_response
from gridreg.regularizers.low_pass import annealed_radius

NODES = 64


def example_line() -> Tensor:
    """A line of a grid: a step, a bump, a slope, and roughness."""
    x = torch.linspace(0, 1, NODES)
    noise = torch.randn(NODES, generator=torch.Generator().manual_seed(3))
    wall = torch.where((x > 0.18) & (x < 0.4), 1.0, 0.0)
    return wall + 0.9 * torch.exp(-(((x - 0.66) / 0.05) ** 2)) + 0.4 * x + 0.07 * noise


class Line(nn.Module):
    """A grid of one channel, ``(1, nodes)``."""

    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(example_line()[None])


def filtered(regularizer: gridreg.Regularizer, step: int, total_steps: int = 100) -> np.ndarray:
    """Return what a field sees of the example line at a step."""
    field = Line()
    with gridreg.apply(field, regularizer, total_steps=total_steps) as handle, torch.no_grad():
        handle.step(step)
        return field.grid[0].numpy()


def response() -> str:
    """Factors of the frequencies for some fractions."""
    highest = 32
    numbers = torch.linspace(0, highest, 257)
    panel = Panel(
        "Factor of each frequency, FourierLowPass",
        x=(0, highest), y=(0, 1.08), x_label="frequency (periods per edge)", x_ticks=(0, 8, 16, 24, 32),
        y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    for series, keep in enumerate((0.1, 0.3, 0.6), start=1):
        panel.line(numbers, low_pass_response(numbers, highest, keep), series)
        panel.note(23, 1 - 0.13 * series, f"keep={keep}", series)
    return panel.svg()


def lines(title: str, shown: list[tuple[str, np.ndarray]]) -> str:
    """The example line under the same line filtered."""
    x = np.linspace(0, 1, NODES)
    panel = Panel(
        title,
        x=(0, 1),
        y=(-0.35, 1.6),
        x_label="place along the grid's edge",
        x_ticks=(0, 0.5, 1),
        y_ticks=(0, 1),
    )
    values = example_line().numpy()
    panel.area(x, np.minimum(values, 0.0), values, 1)
    for series, (text, row) in enumerate(shown, start=2):
        panel.line(x, row, series)
        panel.note(0.42 + 0.3 * (series - 2), 1.47, text, series)
    return panel.svg()


def diagrams() -> dict[str, str]:
    """SVG text by name."""
    grid = gridreg.parameters("grid", dim=0)
    fourier = [(f"keep={keep}", filtered(gridreg.FourierLowPass(grid, keep), 0)) for keep in (0.05, 0.3)]
    borders = [
        (boundary, filtered(gridreg.FourierLowPass(grid, 0.1, boundary), 0))
        for boundary in ("periodic", "mirror")
    ]
    annealing = gridreg.GridBlur(grid, until=100)
    blurred = [(f"at {step} %", filtered(annealing, step)) for step in (0, 60)]
    steps = np.linspace(0, 1, 601)
    panel = Panel(
        "Radius of GridBlur(until=0.3)",
        x=(0, 0.4), y=(0, 0.16), x_label="fraction of the run", y_label="fraction of the edge",
        x_ticks=(0, 0.1, 0.2, 0.3, 0.4), y_ticks=(0, 0.05, 0.1, 0.15),
    )  # fmt: skip
    panel.line(0.4 * steps, [annealed_radius(0.4 * step, 0.3) for step in steps])
    return {
        "filter-response": response(),
        "filter-fourier": lines("A line seen through FourierLowPass", fourier),
        "filter-borders": lines("keep=0.1 with both boundaries", borders),
        "filter-radius": panel.svg(),
        "filter-blur": lines("A line seen through GridBlur", blurred),
    }
