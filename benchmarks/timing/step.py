"""`step`: a training step by stage, compiled, plain and a peer's."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gridreg.ops import use_backend
from gridreg.scenes import Scene
from gridreg.training import RunConfig

from . import common, situations
from .common import Record
from .peer import Peer, load_class
from .situations import Situation
from .stopwatch import STAGES, Stopwatch, watched_step

HELP = "a training step in two situations of the schedule, by stage; beside the plain path and a peer"


def add_situation_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("situations")
    group.add_argument(
        "--early-edge", type=common.at_least(2), default=128, help="edge of the grid without occupancy"
    )
    group.add_argument(
        "--late-edge", type=common.at_least(2), default=300, help="edge of the grid with occupancy"
    )
    group.add_argument(
        "--begin",
        type=common.count,
        default=200,
        help="iterations of the schedule before the first is held still",
    )
    group.add_argument(
        "--learn", type=common.count, default=400, help="iterations that teach the second field the scene"
    )
    group.add_argument(
        "--warm-up", type=common.count, default=30, help="iterations at its last size before it is held still"
    )
    group.add_argument(
        "--trained",
        type=Path,
        metavar="DIR",
        help="a finished run on the scene, whose field is taken as the second",
    )
    group.add_argument("--only", choices=("early", "late"), help="one situation instead of both")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser, preset="tensorf")
    add_situation_arguments(parser)
    parser.add_argument("--repeats", type=common.count, default=20)
    parser.add_argument("--peer", type=Path, metavar="DIR", help="a TensoRF checkout, run on the same rays")
    parser.add_argument("--no-plain", action="store_true", help="leave out the plain PyTorch path")


def make(arguments: argparse.Namespace, config: RunConfig, scene: Scene) -> list[Callable[[], Situation]]:
    """The situations, each built when it is called, so that one is in memory at a time."""
    wanted: dict[str, Callable[[], Situation]] = {
        "early": lambda: situations.early(config, scene, edge=arguments.early_edge, learning=arguments.begin),
        "late": lambda: situations.late(
            config,
            scene,
            edge=arguments.late_edge,
            learning=arguments.learn,
            warm_up=arguments.warm_up,
            trained=arguments.trained,
        ),
    }
    return [build for name, build in wanted.items() if arguments.only in (None, name)]


class Watched:
    """Iterations under the stopwatch; of each, the whole and the seconds of every part."""

    def __init__(self, situation: Situation, backend: str) -> None:
        self.situation, self.backend = situation, backend
        self.turns: list[tuple[float, Stopwatch]] = []

    def __call__(self, turn: int) -> None:
        self.situation.rewind(turn)
        with use_backend(self.backend):
            self.turns.append(watched_step(self.situation.trainer))

    def figures(self, skip: int = 0) -> Record:
        """Medians of the stages without the first turns.

        ``sum_of_stages`` is the fraction that all stages make of the whole step as a clock outside measured it.
        """
        turns = self.turns[skip:]
        stages = [watch.by_stage() for _, watch in turns]
        fractions = [sum(found.values()) / whole for found, (whole, _) in zip(stages, turns, strict=True)]
        return {
            "stages": {name: statistics.median([found[name] for found in stages]) for name in STAGES},
            "sum_of_stages": statistics.median(fractions),
        }

    def typical(self, skip: int = 0) -> tuple[float, dict[str, float]]:
        """The whole and the parts of the turn that took the median time: these do add up, as medians need not."""
        turns = sorted(self.turns[skip:], key=lambda turn: turn[0])
        whole, watch = turns[(len(turns) - 1) // 2]
        return whole, dict(watch.seconds)


def measure_one(situation: Situation, arguments: argparse.Namespace) -> Record:
    """All contestants in one situation, in turns."""
    watched = {"compiled": Watched(situation, "auto")}
    contestants: dict[str, Callable[[int], object]] = {"compiled": situation.run}
    if not arguments.no_plain:
        watched["plain"] = Watched(situation, "torch")
    contestants |= {f"{name}, watched": run for name, run in watched.items()}
    facts: dict[str, Any] = {}
    if arguments.peer is not None:
        late = situation.trainer.occupancy.fraction < 1
        peer = Peer(arguments.peer, situation.trainer, occupancy=late)
        facts = {"peer": {"name": arguments.peer.resolve().name, **peer.facts}}
        contestants["peer"] = lambda turn: peer.step(*situation.batch(turn))
    times = common.in_turns(contestants, arguments.repeats, warm_up=1)
    return {
        **situation.describe(),
        **facts,
        "parts": watched["compiled"].typical(skip=1)[1],
        "seconds": common.medians(times),
        "ratios": common.ratios(times, "compiled"),
        "watched": {name: run.figures(skip=1) for name, run in watched.items()},
    }


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    config = common.configuration(arguments)
    if arguments.peer is not None:
        # A wrong folder must show before minutes of preparation.
        load_class(arguments.peer)
    scene = common.scene_of(config, test=())
    found = [measure_one(build(), arguments) for build in make(arguments, config, scene)]
    record = {"scene": common.scene_name(arguments), "preset": arguments.preset, "situations": found}
    return record, common.setting(arguments)


def show(record: Record) -> str:
    parts = []
    for one in record["situations"]:
        watched = one["watched"]
        names = list(watched)
        head = ["stage", *(f"{name} (ms)" for name in names)]
        rows: list[list[str]] = []
        for stage in STAGES:
            rows.append([stage, *(common.ms(watched[name]["stages"][stage]) for name in names)])
        sums = [sum(watched[name]["stages"].values()) for name in names]
        rows.append(["sum of stages", *map(common.ms, sums)])
        rows.append(["whole step", *(common.ms(one["seconds"][f"{name}, watched"]) for name in names)])
        lines = [
            f"{common.situation_line(record, one)} {common.percent(one['occupied_cells'])} of the cells are occupied.",
            "",
            common.markdown(head, rows),
            "",
            f"Without the stopwatch: compiled {common.ms(one['seconds']['compiled'])} ms"
            + _against(one, "plain, watched", "plain path")
            + _against(one, "peer", f"peer {one.get('peer', {}).get('name', '')}")
            + ".",
            *_peer_facts(one),
        ]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _against(one: Record, name: str, label: str) -> str:
    if name not in one["seconds"]:
        return ""
    ratio = one["ratios"][name]
    return (
        f"; {label} {common.ms(one['seconds'][name])} ms, {ratio['median']:.1f} times as long "
        f"(middle half {ratio['quarter']:.1f} to {ratio['three_quarters']:.1f})"
    )


def _peer_facts(one: Record) -> list[str]:
    if "peer" not in one:
        return []
    peer = one["peer"]
    grids = "the same values in its grids" if peer["same_grids"] else "its own initial values"
    cells = "the same occupied cells" if peer["occupancy"] else "no occupancy"
    penalty = "its L1 penalty" if peer["l1"] else "no penalty"
    return ["", f"The peer has {grids}, {cells} and {penalty}."]
