"""Diagrams of schedules, and of regularizers of sampling, gradients and optimizer."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import gridreg
from drawing.svg import Panel
from gridreg.samples import RaySamples

TOTAL = 15_000


def schedules() -> dict[str, str]:
    """One panel for each shape."""
    steps = np.arange(0, TOTAL + 1, 25)
    ticks = (0, 5000, 10_000, 15_000)
    rising = Panel(
        "From 0.3 to 1 until two thirds of the run",
        x=(0, TOTAL), y=(0, 1.1), x_label="step of 15,000", x_ticks=ticks, y_ticks=(0, 0.3, 1),
    )  # fmt: skip
    rising.line(steps, [gridreg.Linear(0.3, 1.0, until=2 / 3).at(int(s), TOTAL) for s in steps], 1)
    rising.line(steps, [gridreg.Cosine(0.3, 1.0, until=2 / 3).at(int(s), TOTAL) for s in steps], 2)
    rising.note(2600, 0.62, "Linear", 1, "end")
    rising.note(4200, 0.42, "Cosine", 2)
    few = np.arange(0, 1025, 8)
    falling = Panel(
        "Geometric(400, 0.1, until=512)",
        x=(0, 1024), y=(0.05, 1000), x_label="step", x_ticks=(0, 256, 512, 1024),
        y_ticks=(0.1, 1, 10, 100, 1000), log_y=True,
    )  # fmt: skip
    falling.line(few, [gridreg.Geometric(400.0, 0.1, until=512).at(int(s), TOTAL) for s in few], 3)
    pieces = Panel(
        "Piecewise((8e-5, 4e-5), (2000,))",
        x=(0, 6000), y=(0, 1e-4), x_label="step", x_ticks=(0, 2000, 4000, 6000),
        y_ticks=((0, "0"), (4e-5, "4e-5"), (8e-5, "8e-5")),
    )  # fmt: skip
    fine = np.arange(0, 6001, 10)
    pieces.line(fine, [gridreg.Piecewise((8e-5, 4e-5), (2000,)).at(int(s), TOTAL) for s in fine], 4)
    return {
        "schedule-rising": rising.svg(),
        "schedule-geometric": falling.svg(),
        "schedule-piecewise": pieces.svg(),
    }


def annealed_interval() -> str:
    """Near and far over the first steps."""
    steps = np.arange(0, 401, 4)
    near, far = torch.tensor([2.0]), torch.tensor([6.0])
    rows = []
    with gridreg.apply(nn.Linear(1, 1), gridreg.SampleSpaceAnnealing(), total_steps=TOTAL) as handle:
        for step in steps.tolist():
            handle.step(step)
            rows.append([float(end) for end in handle.near_far(near, far)])
    low, high = np.array(rows).T
    panel = Panel(
        "SampleSpaceAnnealing() between near 2 and far 6",
        x=(0, 400), y=(1.5, 6.5), x_label="step", y_label="world units", x_ticks=(0, 128, 256, 400), y_ticks=(2, 4, 6),
    )  # fmt: skip
    panel.area(steps, low, high)
    panel.line(steps, low)
    panel.line(steps, high)
    panel.note(200, 3.9, "sampled", 1, "middle")
    return panel.svg()


def gradient_factor() -> str:
    """Draw the factor of a gradient."""
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    density = torch.ones(1, 101, dtype=torch.float64, requires_grad=True)
    rays = RaySamples.from_dense(t, torch.full_like(t, 0.02), density)
    gridreg.scale_gradients_by_distance(rays, 1.0).density.sum().backward()
    panel = Panel(
        "DistanceGradientScaling(distance=1)",
        x=(0, 2), y=(0, 1.1), x_label="distance from the camera, world units", y_label="factor of gradients",
        x_ticks=(0, 0.5, 1, 1.5, 2), y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    if density.grad is not None:
        panel.line(t, density.grad[0])
    return panel.svg()


def decay() -> str:
    """A parameter that nothing pulls at, under AdamW."""
    panel = Panel(
        "WeightDecay of a value without a gradient",
        x=(0, 1000), y=(0, 1.1), x_label="step, at a learning rate of 0.02", x_ticks=(0, 250, 500, 750, 1000),
        y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    for series, rate in enumerate((0.02, 0.2), start=1):
        values = decayed(rate, 1000)
        panel.line(np.arange(len(values)), values, series)
        panel.note(420, values[420] + 0.07, f"decay={rate}", series)
    return panel.svg()


def decayed(rate: float, steps: int) -> list[float]:
    """Values of a parameter that starts at 1, step by step."""
    layer = nn.Linear(1, 1, bias=False)
    nn.init.ones_(layer.weight)
    with gridreg.apply(
        layer, gridreg.WeightDecay(gridreg.parameters("weight", dim=0), rate), total_steps=steps
    ) as handle:
        groups = handle.parameter_groups([{"params": [layer.weight], "lr": 0.02}])
    optimizer = torch.optim.AdamW(groups)
    values = [1.0]
    for _ in range(steps):
        layer.weight.grad = torch.zeros_like(layer.weight)
        optimizer.step()
        values.append(layer.weight.item())
    return values


def diagrams() -> dict[str, str]:
    """SVG text by name."""
    return {
        **schedules(),
        "sampling-interval": annealed_interval(),
        "sampling-gradients": gradient_factor(),
        "optimizer-decay": decay(),
    }
