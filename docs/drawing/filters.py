"""Diagrams of low-passes: what passes, and what it does to a line of a grid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

import gridreg
from drawing.svg import Line
from gridreg.regularizers.filters import low_pass_response
from gridreg.regularizers.low_pass import annealed_radius

NODES = 64


def example_line() -> Tensor:
    """A line of a grid: a step, a bump, a slope, and roughness."""
    x = torch.linspace(0, 1, NODES)
    noise = torch.randn(NODES, generator=torch.Generator().manual_seed(3))
    wall = torch.where((x > 0.18) & (x < 0.4), 1.0, 0.0)
    return wall + 0.9 * torch.exp(-(((x - 0.66) / 0.05) ** 2)) + 0.4 * x + 0.07 * noise


def seen_through(*views: tuple[gridreg.Regularizer, int]) -> list[Line]:
    """The example line under what a field sees of it through a regularizer at a step of 100, for each of some."""
    x, values = np.linspace(0, 1, NODES), example_line().numpy()
    lines = [Line(x, values, low=np.minimum(values, 0.0))]
    for series, (regularizer, step) in enumerate(views, start=2):
        field = nn.Module()
        field.grid = nn.Parameter(example_line()[None])
        with gridreg.apply(field, regularizer, total_steps=100) as handle, torch.no_grad():
            handle.step(step)
            lines.append(Line(x, field.grid[0].numpy(), series))
    return lines


def diagrams() -> dict[str, list[Line]]:
    """What each diagram shows."""
    grid, steps = gridreg.parameters("grid", dim=0), 0.4 * np.linspace(0, 1, 601)
    numbers, blur = torch.linspace(0, 32, 257), gridreg.GridBlur(grid, until=100)
    return {
        "filter-response": [
            Line(numbers, low_pass_response(numbers, 32, keep), series)
            for series, keep in enumerate((0.1, 0.3, 0.6), start=1)
        ],
        "filter-fourier": seen_through(*((gridreg.FourierLowPass(grid, keep), 0) for keep in (0.05, 0.3))),
        "filter-borders": seen_through(
            (gridreg.FourierLowPass(grid, 0.1, "periodic"), 0),
            (gridreg.FourierLowPass(grid, 0.1, "mirror"), 0),
        ),
        "filter-radius": [Line(steps, [annealed_radius(step, 0.3) for step in steps])],
        "filter-blur": seen_through((blur, 0), (blur, 60)),
    }
