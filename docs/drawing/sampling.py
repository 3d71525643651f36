"""Diagrams of schedules, and of regularizers of sampling, gradients and optimizer."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import gridreg
from drawing.svg import Line
from gridreg.samples import RaySamples

TOTAL = 15_000


def schedule(shape: gridreg.Schedule, last: int, every: int, series: int) -> Line:
    """The values of a schedule up to a step."""
    steps = np.arange(0, last + 1, every)
    return Line(steps, [shape.at(int(step), TOTAL) for step in steps], series)


def annealed_interval() -> list[Line]:
    """Near and far over the first steps."""
    steps = np.arange(0, 401, 4)
    near, far = torch.tensor([2.0]), torch.tensor([6.0])
    rows = []
    with gridreg.apply(nn.Linear(1, 1), gridreg.SampleSpaceAnnealing(), total_steps=TOTAL) as handle:
        for step in steps.tolist():
            handle.step(step)
            rows.append([float(end) for end in handle.near_far(near, far)])
    low, high = np.array(rows).T
    return [Line(steps, high, low=low), Line(steps, low), Line(steps, high)]


def gradient_factor() -> list[Line]:
    """The factor of a gradient."""
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    density = torch.ones(1, 101, dtype=torch.float64, requires_grad=True)
    rays = RaySamples.from_dense(t, torch.full_like(t, 0.02), density)
    total = gridreg.scale_gradients_by_distance(rays, 1.0).density.sum()
    return [Line(t, torch.autograd.grad(total, density)[0][0])]


def decayed(rate: float, steps: int = 1000) -> list[float]:
    """Values of a parameter that starts at 1 and that nothing pulls at, step by step, under AdamW."""
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


def diagrams() -> dict[str, list[Line]]:
    """What each diagram shows."""
    return {
        "schedule-rising": [
            schedule(gridreg.Linear(0.3, 1.0, until=2 / 3), TOTAL, 25, 1),
            schedule(gridreg.Cosine(0.3, 1.0, until=2 / 3), TOTAL, 25, 2),
        ],
        "schedule-geometric": [schedule(gridreg.Geometric(400.0, 0.1, until=512), 1024, 8, 3)],
        "schedule-piecewise": [schedule(gridreg.Piecewise((8e-5, 4e-5), (2000,)), 6000, 10, 4)],
        "sampling-interval": annealed_interval(),
        "sampling-gradients": gradient_factor(),
        "optimizer-decay": [
            Line(np.arange(1001), decayed(rate), series) for series, rate in enumerate((0.02, 0.2), start=1)
        ],
    }
