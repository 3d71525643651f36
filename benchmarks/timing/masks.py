"""`masks`: a masked step against the same step without masks, at several fractions of open channels.

The rows "opened" and "half-way" are masks that open in the first half of a run, at its end and at a quarter of it: what
an attached composition costs that does nothing any more.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import gridreg
from gridreg.errors import InputError

from . import common
from .ball import BallStep, ball_field, ball_rays
from .common import Record

HELP = "masked against unmasked steps: masks that have opened, and several fractions of open channels"

COMPONENTS = ("density", "appearance")
ENCODINGS = ("encoding.features", "encoding.direction", "encoding.position")


def fraction(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"found {value}, expected a fraction in [0, 1]")
    return value


def opening_step(backbone: str, edge: int, rays: int, sites: Sequence[str], at: float) -> BallStep:
    """Return a step with masks that open in the first half of a run, at a fraction of it."""
    masks = [gridreg.FrequencyMask(site, until=0.5) for site in sites]
    return BallStep(ball_field(backbone, edge), ball_rays(rays), masks, at=int(1000 * at))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backbone", default="vm", choices=("vm", "cp"))
    parser.add_argument("--rays", type=common.count, default=1024)
    parser.add_argument("--edge", type=common.at_least(2), default=300)
    parser.add_argument("--shares", type=fraction, nargs="+", default=[0.125, 0.25, 0.5, 0.75, 1.0])
    parser.add_argument("--repeats", type=common.count, default=20)
    parser.add_argument("--components-only", action="store_true", help="leave the encodings open")


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    sites = COMPONENTS if arguments.components_only else COMPONENTS + ENCODINGS
    rays = ball_rays(arguments.rays)
    bare = BallStep(ball_field(arguments.backbone, arguments.edge), rays)
    channels = bare.field.density_lines[0].shape[-1]
    for value in arguments.shares:
        if int(channels * value) < 1:
            raise InputError(
                f"--shares: found {value:g}, which opens none of {channels} channels; expected more"
            )
    # A second one like the first shows how far the noise goes.
    steps = {
        "no masks": bare,
        "no masks again": BallStep(ball_field(arguments.backbone, arguments.edge), rays),
    }
    for name, at in (("opened", 1.0), ("half-way", 0.25)):
        steps[name] = opening_step(arguments.backbone, arguments.edge, arguments.rays, sites, at)
    for value in arguments.shares:
        field = ball_field(arguments.backbone, arguments.edge)
        composition = [gridreg.FixedMask(site, visible_ratio=value) for site in sites]
        steps[f"{value:g}"] = BallStep(field, rays, composition)
    times = common.in_turns(dict(steps), arguments.repeats)
    found = common.ratios(times, "no masks")
    rows = {
        name: {
            "seconds": common.spread(values),
            "ratio": found.get(name, {"median": 1.0, "quarter": 1.0, "three_quarters": 1.0}),
            **steps[name].samples_per_ray(),
        }
        for name, values in times.items()
    }
    return {"sites": list(sites), "rows": rows}, arguments.backbone


def show(record: Record) -> str:
    arguments = record["arguments"]
    body = []
    for name, row in record["rows"].items():
        ratio = row["ratio"]
        body.append(
            [
                name,
                common.ms(row["seconds"]["median"]),
                f"{ratio['median']:.2f}",
                f"{ratio['quarter']:.2f} to {ratio['three_quarters']:.2f}",
                f"{row['colour_samples_per_ray']:.1f}",
            ]
        )
    head = ["open fraction", "step (ms)", "masked / unmasked", "middle half", "colour samples per ray"]
    return (
        f"Backbone {arguments['backbone']}, edge {arguments['edge']}, {arguments['rays']} rays; masks on "
        f"{', '.join(record['sites'])}.\n\n{common.markdown(head, body)}"
    )
