"""`masks`: a masked step against the same step without masks, at several shares of open channels."""

from __future__ import annotations

import argparse

import gridreg
from gridreg.errors import InputError

from . import common
from .ball import BallStep, as_contestants, ball_field, ball_rays
from .common import Record

HELP = "masked against unmasked steps, at several shares of open channels"

COMPONENTS = ("density", "appearance")
ENCODINGS = ("encoding.features", "encoding.direction", "encoding.position")


def share(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"found {value}, expected a share in [0, 1]")
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backbone", default="vm", choices=("vm", "cp"))
    parser.add_argument("--rays", type=common.count, default=1024)
    parser.add_argument("--edge", type=common.at_least(2), default=300)
    parser.add_argument("--shares", type=share, nargs="+", default=[0.125, 0.25, 0.5, 0.75, 1.0])
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
    for value in arguments.shares:
        field = ball_field(arguments.backbone, arguments.edge)
        composition = [gridreg.FixedMask(site, visible_ratio=value) for site in sites]
        steps[f"{value:g}"] = BallStep(field, rays, composition)
    times = common.in_turns(as_contestants(steps), arguments.repeats)
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
    head = ["open share", "step (ms)", "masked / unmasked", "middle half", "colour samples per ray"]
    return (
        f"Backbone {arguments['backbone']}, edge {arguments['edge']}, {arguments['rays']} rays; fixed masks on "
        f"{', '.join(record['sites'])}.\n\n{common.markdown(head, body)}"
    )
