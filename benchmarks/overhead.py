"""What an attached composition costs: the same training step with and without it, in turns.

    python benchmarks/overhead.py
    python benchmarks/overhead.py --repeats 60 --edge 128

Two fields with the same values do the same step (render 1,024 rays, backward pass, Adam): one bare, one with masks on all five sites
that have opened fully, as they are at the end of a run; and one with the same masks half-way. Prints and stores the medians of
the ratios, pair by pair, with the interval that holds the middle 50 %. JSON in benchmarks/results/overhead/.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

import gridreg
from gridreg.fields import make_field
from gridreg.rendering import March, OccupancyGrid, Rays, render_rays
from gridreg.training.files import write_json
from gridreg.training.versions import versions

RESULTS = Path(__file__).parent / "results" / "overhead"
SITES = ("density", "appearance", "encoding.features", "encoding.direction", "encoding.position")
BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def make_rays(count: int) -> Rays:
    """Rays from a sphere of radius 4 towards the box."""
    generator = torch.Generator().manual_seed(0)
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    aims = 0.8 * (2 * torch.rand(count, 3, generator=generator) - 1)
    return Rays(origins, torch.nn.functional.normalize(aims - origins, dim=-1))


def make_step(backbone: str, edge: int, rays: Rays, at: float | None) -> Callable[[], None]:
    """A training step; with a composition at a share of its run, or bare."""
    generator = torch.Generator().manual_seed(0)
    field = make_field(
        backbone,
        BOX,
        (edge,) * 3,
        generator=generator,
        decoder="mlp",
        density_shift=None,
        initial_opacity=0.9,
    )
    occupancy = OccupancyGrid.full(field.bounds, (64, 64, 64))
    march = March(step=2.0 / edge)
    optimizer = field.make_optimizer(
        [{**group, "lr": 0.02 if group["name"] == "grid" else 1e-3} for group in field.parameter_groups()],
        betas=(0.9, 0.99),
    )
    handle = None
    if at is not None:
        masks = [gridreg.FrequencyMask(site, until=0.5) for site in SITES]
        handle = gridreg.apply(field, *masks, total_steps=1000)
    target = torch.rand(len(rays), 3, generator=generator)
    jitter = torch.full((len(rays),), 0.5)

    def step() -> None:
        if handle is not None:
            handle.step(int(1000 * (at or 0)))
        rendered = render_rays(
            field, rays, occupancy, march, background=torch.ones(3), jitter=jitter, hook=handle
        )
        loss = (rendered.colour - target).square().mean()
        if handle is not None:
            loss = loss + handle.loss(rendered.samples)
        with field.gradient_context():
            loss.backward()
        optimizer.step()
        # The field must not change from one measurement to the next.
        for group in optimizer.param_groups:
            group["lr"] = 0.0

    return step


def measure(steps: dict[str, Callable[[], None]], repeats: int) -> dict[str, list[float]]:
    """Seconds of each step, in turns; the order changes every time."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        step()
        step()
    for turn in range(repeats):
        names = list(steps)[turn % len(steps) :] + list(steps)[: turn % len(steps)]
        for name in names:
            began = time.perf_counter()
            steps[name]()
            times[name].append(time.perf_counter() - began)
    return times


def main() -> int:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backbone", default="vm", choices=("vm", "cp"))
    parser.add_argument("--edge", type=int, default=128, help="nodes along an edge of the grid")
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rays = make_rays(arguments.rays)
    settings = {"bare": None, "bare again": None, "masks open": 1.0, "masks half-way": 0.25}
    steps = {name: make_step(arguments.backbone, arguments.edge, rays, at) for name, at in settings.items()}
    times = measure(steps, arguments.repeats)
    result: dict[str, object] = {
        "benchmark": "overhead",
        "backbone": arguments.backbone,
        "edge": arguments.edge,
        "rays": arguments.rays,
        "repeats": arguments.repeats,
        "median_ms": {name: 1e3 * statistics.median(values) for name, values in times.items()},
        "versions": versions(),
    }
    ratios = {}
    print(f"{arguments.backbone}, edge {arguments.edge}, {arguments.rays} rays, {arguments.threads} threads")
    for name in list(times)[1:]:
        pairs = sorted(a / b for a, b in zip(times[name], times["bare"], strict=True))
        low, middle, high = statistics.quantiles(pairs, n=4)
        ratios[name] = {"median": middle, "quarter": low, "three_quarters": high}
        print(
            f"{name:>15} / bare: {100 * (middle - 1):+.1f} % (middle half {100 * (low - 1):+.1f} to {100 * (high - 1):+.1f} %)"
        )
    result["ratios"] = ratios
    RESULTS.mkdir(parents=True, exist_ok=True)
    write_json(RESULTS / f"{arguments.backbone}-{arguments.edge}-{arguments.threads}threads.json", result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
