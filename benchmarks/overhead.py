"""What an attached composition costs: the same training step with and without it, in turns.

    python benchmarks/overhead.py
    python benchmarks/overhead.py --repeats 60 --edge 128

Fields with the same values, a ball that rays end in as they end in a trained surface, do the same step (render 1,024
rays, backward pass, Adam): one bare; one with masks on all five sites that have opened fully, as they are at the end of
a run; one with the same masks half-way; and a second bare one, whose ratio shows the noise. Prints and stores the
medians of the ratios, turn by turn, with the interval that holds the middle half (benchmarks/results/overhead.jsonl).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import stored
import torch
from timing.ball import BallStep, as_contestants, ball_field, ball_rays
from timing.common import at_least, in_turns, medians, ratios

import gridreg
from gridreg.cli import run_cli
from gridreg.training.versions import versions

STUDY = "overhead"
SITES = ("density", "appearance", "encoding.features", "encoding.direction", "encoding.position")
# By name, the share of the run at which the masks stand; None: no composition.
SETTINGS: dict[str, float | None] = {
    "bare": None,
    "bare again": None,
    "masks open": 1.0,
    "masks half-way": 0.25,
}


def make_step(backbone: str, edge: int, rays: int, at: float | None) -> BallStep:
    """A training step; with masks that open in the first half of a run, at a share of it, or bare."""
    masks = None if at is None else [gridreg.FrequencyMask(site, until=0.5) for site in SITES]
    step = int(1000 * (at or 0))
    field = ball_field(backbone, edge)
    return BallStep(field, ball_rays(rays), masks, at=step)


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backbone", default="vm", choices=("vm", "cp"))
    parser.add_argument("--edge", type=at_least(2), default=128, help="nodes along an edge of the grid")
    parser.add_argument("--rays", type=at_least(1), default=1024)
    parser.add_argument("--repeats", type=at_least(2), default=100)
    parser.add_argument("--threads", type=at_least(1), default=torch.get_num_threads())
    parser.add_argument("--results", type=Path, default=stored.RESULTS, help="folder of the stored figures")
    arguments = parser.parse_args(words)
    torch.set_num_threads(arguments.threads)
    steps = {
        name: make_step(arguments.backbone, arguments.edge, arguments.rays, at)
        for name, at in SETTINGS.items()
    }
    times = in_turns(as_contestants(steps), arguments.repeats)
    found = ratios(times, "bare")
    result: dict[str, object] = {
        "benchmark": "overhead",
        "backbone": arguments.backbone,
        "edge": arguments.edge,
        "rays": arguments.rays,
        "repeats": arguments.repeats,
        **steps["bare"].samples_per_ray(),
        "median_ms": {name: 1e3 * seconds for name, seconds in medians(times).items()},
        "ratios": found,
        "versions": versions(),
    }
    print(
        f"{arguments.backbone}, edge {arguments.edge}, {arguments.rays} rays with "
        f"{result['density_samples_per_ray']:.1f} density and {result['colour_samples_per_ray']:.1f} colour samples, "
        f"{arguments.threads} threads, bare {1e3 * medians(times)['bare']:.1f} ms"
    )
    for name, ratio in found.items():
        median, low, high = (100 * (ratio[key] - 1) for key in ("median", "quarter", "three_quarters"))
        print(f"{name:>15} / bare: {median:+.1f} % (middle half {low:+.1f} to {high:+.1f} %)")
    name = f"{arguments.backbone}-{arguments.edge}-{arguments.threads}threads"
    stored.save(STUDY, name, result, arguments.results)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
