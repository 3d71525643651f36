"""`roofline`: what a step must move and do, against what this processor can."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from gridreg.attach._hooks import open_channels
from gridreg.errors import InputError
from gridreg.ops.cpu import lookups
from gridreg.ops.cpu.reductions import round_stochastically
from gridreg.ops.interpolation import LINE_AXES, PLANE_AXES
from gridreg.ops.perceptron import product_dtype

from . import common, machine, step
from .common import Record
from .machine import Machine
from .situations import Situation, require_grid
from .stopwatch import replaced
from .work import Counts, Work, work

HELP = "bytes and operations of a step against bandwidth and arithmetic rate, by stage"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser, preset="tensorf")
    step.add_situation_arguments(parser)
    parser.add_argument("--repeats", type=common.count, default=20)
    parser.add_argument(
        "--megabytes", type=common.count, default=256, help="of each array of the triad; more than the caches"
    )
    parser.add_argument(
        "--matrix", type=common.count, default=1024, help="edge of the matrices that are multiplied"
    )


def touched_nodes(u: Tensor, resolution: tuple[int, int, int]) -> int:
    """Distinct nodes of three planes and three lines around normalised positions ``(N, 3)``."""
    if not u.shape[0]:
        return 0
    edges = torch.tensor(resolution)
    below = (u.clamp(0, 1) * (edges - 1)).floor().long().minimum(edges - 2)
    total = 0
    for a, b in PLANE_AXES:
        cells = (below[:, a] * edges[b] + below[:, b]).unique()
        corners = [cells, cells + 1, cells + edges[b], cells + edges[b] + 1]
        total += torch.cat(corners).unique().numel()
    for axis in LINE_AXES:
        nodes = below[:, axis].unique()
        total += torch.cat([nodes, nodes + 1]).unique().numel()
    return total


def _open(field: Any, kind: str) -> int:
    """Channels that no mask has closed, of the product that has most."""
    products = []
    for k in map(str, range(3)):
        planes, lines = getattr(field, f"{kind}_planes"), getattr(field, f"{kind}_lines")
        every = lines[int(k)].shape[-1]
        found = [open_channels(grids, k) for grids in (planes, lines)]
        products.append(min([every, *(n for n in found if n is not None)]))
    return max(products)


def _updated(trainer: Any) -> int:
    """Elements that Adam must update: those that ever had a gradient."""
    total = 0
    for group in trainer.optimizer.param_groups:
        for parameter in group["params"]:
            state = trainer.optimizer.state.get(parameter, {})
            if "exp_avg_sq" in state:
                total += int(torch.count_nonzero(state["exp_avg_sq"]))
    return total


def nonzero_gradients(situation: Situation, turn: int) -> Tensor:
    """Return which samples ``(N,)`` of a turn have a gradient of their density, once small ones are rounded."""
    found: list[Tensor] = []

    def watched(values: Tensor, fraction: float) -> Tensor:
        rounded = round_stochastically(values, fraction)
        found.append(rounded != 0)
        return rounded

    with replaced(lookups, "round_stochastically", watched):
        situation.run(turn)
    return found[0]


@torch.no_grad()
def counts_of(situation: Situation, turn: int = 0) -> Counts:
    """Return what the step of a turn finds.

    Raises:
        InputError: if the field is not a VM field with an MLP for its decoder.
    """
    trainer = situation.trainer
    field = trainer.field
    require_grid(trainer, "roofline")
    if not hasattr(field.decoder, "layers"):
        raise InputError("roofline: found a decoder without layers, expected one of mlp, mlp_fea, mlp_pe")
    with torch.enable_grad():
        nonzero = nonzero_gradients(situation, turn)
    situation.rewind(turn)
    trainer.handle.step(situation.step)
    rendered = trainer.render_batch()[0]
    samples, coloured = rendered.samples, rendered.coloured
    assert samples is not None
    assert samples.positions is not None
    assert coloured is not None
    u = field.normalise(samples.positions)
    decoder = field.decoder
    encodings = [(decoder.features, decoder.feature_octaves), (3, decoder.direction_octaves)]
    if decoder.position_octaves is not None:
        encodings.append((3, decoder.position_octaves))
    return Counts(
        rays=trainer.settings.rays,
        steps=int(samples.steps.sum()),
        cells=trainer.occupancy.cells.numel(),
        samples=samples.t.numel(),
        coloured=coloured.numel(),
        density_channels=_open(field, "density"),
        appearance_channels=_open(field, "appearance"),
        density_nodes=touched_nodes(u, field.resolution),
        appearance_nodes=touched_nodes(u[coloured], field.resolution),
        nonzero=int(nonzero.sum()),
        nonzero_nodes=touched_nodes(u[nonzero], field.resolution),
        features=decoder.features,
        layers=(sum(decoder.block_sizes), *(layer.weight.shape[0] for layer in decoder.layers)),
        encodings=tuple(encodings),
        parameters=_updated(trainer),
        low=product_dtype(decoder.precision) is torch.bfloat16,
    )


def bounds(task: Work, rates: Machine) -> dict[str, float]:
    """Least seconds that a stage takes, by what limits it.

    ``roof`` is the larger of memory and arithmetic; ``cached`` takes the caches into account too.
    """
    memory = task.bytes / rates.memory
    arithmetic = task.operations / rates.float32 + task.low / rates.bfloat16
    roof = max(memory, arithmetic)
    return {
        "memory": memory,
        "arithmetic": arithmetic,
        "roof": roof,
        "cached": max(roof, task.cached / rates.cache),
    }


def account(counts: Counts, parts: dict[str, float], rates: Machine, whole: float) -> Record:
    """By stage: what it must do, the least time for it, and the time it took.

    Args:
        counts: of the step.
        parts: seconds of each stage.
        rates: of the processor.
        whole: seconds of the step.
    """
    rows = {}
    for name, task in work(counts).items():
        rows[name] = {**asdict(task), "seconds": parts.get(name, 0.0), **bounds(task, rates)}
    roof, cached = (sum(row[key] for row in rows.values()) for key in ("roof", "cached"))
    staged = sum(row["seconds"] for row in rows.values())
    return {
        "rows": rows,
        "whole": whole,
        "roof": roof,
        "cached": cached,
        "share": roof / whole,
        "share_with_caches": cached / whole,
        # Where the time above the roof goes: through caches, in stages beyond that, and between stages.
        "above": {
            "caches": cached - roof,
            "in stages": staged - cached,
            "between stages": whole - staged,
        },
    }


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    config = common.configuration(arguments)
    scene = common.scene_of(config, test=())
    found = []
    rates = machine.measure(arguments.megabytes, arguments.matrix)
    for build in step.make(arguments, config, scene):
        situation = build()
        watched = step.Watched(situation, "auto")
        # One turn's rays, over and over: those that are counted.
        common.in_turns({"watched": lambda _, run=watched: run(0)}, arguments.repeats)
        whole, parts = watched.typical(skip=2)
        counts = counts_of(situation)
        found.append(
            {
                **situation.describe(1),
                "counts": asdict(counts),
                "sum_of_stages": watched.figures(skip=2)["sum_of_stages"],
                **account(counts, parts, rates, whole),
            }
        )
    record = {
        "scene": common.scene_name(arguments),
        "preset": arguments.preset,
        "machine": asdict(rates),
        "situations": found,
    }
    return record, common.setting(arguments)


def _giga(rate: float) -> str:
    return f"{rate / 1e9:.1f}"


def show(record: Record) -> str:
    rates = record["machine"]
    parts = [
        f"Measured in this run: memory {_giga(rates['memory'])} GB/s, caches {_giga(rates['cache'])} GB/s, float32 "
        f"{_giga(rates['float32'])} and bfloat16 {_giga(rates['bfloat16'])} Gflop/s."
    ]
    head = [
        "stage",
        "took (ms)",
        "MB",
        "Mflop",
        "memory (ms)",
        "arithmetic (ms)",
        "with caches (ms)",
        "share",
    ]
    for one in record["situations"]:
        rows: list[list[str]] = []
        for name, row in one["rows"].items():
            took = row["seconds"]
            rows.append(
                [
                    name,
                    common.ms(took),
                    f"{row['bytes'] / 1e6:.2f}",
                    f"{(row['operations'] + row['low']) / 1e6:.1f}",
                    common.ms(row["memory"]),
                    common.ms(row["arithmetic"]),
                    common.ms(row["cached"]),
                    common.percent(row["roof"] / took) if took else "",
                ]
            )
        moved = sum(row["bytes"] for row in one["rows"].values()) / 1e6
        done = sum(row["operations"] + row["low"] for row in one["rows"].values()) / 1e6
        total = ["whole step", common.ms(one["whole"]), f"{moved:.2f}", f"{done:.1f}", "", ""]
        rows.append([*total, common.ms(one["cached"]), common.percent(one["share"])])
        above = {name: common.ms(seconds) for name, seconds in one["above"].items()}
        parts += [
            common.situation_line(record, one),
            common.markdown(head, rows),
            f"The roof is {common.ms(one['roof'])} ms, {common.percent(one['share'])} of the step "
            f"({common.percent(one['share_with_caches'])} with the caches). Above it: {above['caches']} ms through "
            f"caches, {above['in stages']} ms in the stages beyond that, {above['between stages']} ms between them "
            "(losses, masks, penalties, learning rates, Python).",
        ]
    return "\n\n".join(parts)
