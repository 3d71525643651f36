"""`schedule`: a whole run of a preset, by span of its schedule."""

from __future__ import annotations

import argparse

from . import common, whole_run
from .common import Record

HELP = "a whole schedule on a scene: seconds by span, PSNR, peak memory"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    whole_run.add_arguments(parser, preset="few_tensorf")
    parser.add_argument(
        "--steps", type=common.count, help="iterations; events move in proportion; default: all"
    )


def label(arguments: argparse.Namespace) -> str:
    length = "" if arguments.steps is None else f"-{arguments.steps}steps"
    plain = "" if arguments.backend == "auto" else f"-{arguments.backend}"
    return f"{common.setting(arguments)}{plain}{length}-seed{arguments.seed}"


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    return whole_run.run_apart(arguments), label(arguments)


def show(record: Record) -> str:
    seconds, peaks = record["seconds"], record["peak_bytes"]
    rows: list[list[object]] = []
    for span in record["spans"]:
        steps = span["to"] - span["from"]
        grid = "x".join(map(str, span["resolution"])) or "none"
        rows.append(
            [
                f"{span['from']} to {span['to']}",
                grid,
                f"{span['seconds']:.1f}",
                common.ms(span["seconds"] / steps),
                f"{span['peak_bytes'] / 1e6:.0f}",
            ]
        )
    table = common.markdown(["iterations", "grid", "seconds", "per iteration (ms)", "peak so far (MB)"], rows)
    views = record["test_views"]
    stolen = record.get("stolen")
    taken = (
        "" if stolen is None else f"; {stolen:.0%} of the processors' time went to other guests of the host"
    )
    return (
        f"{record['scene']}, {record['protocol']}, {record['preset']}, {record['steps']} iterations, "
        f"seed {record['seed']}, {record['arguments']['backend']} path: {seconds['train']:.1f} s of training, "
        f"PSNR {record['mean']['psnr']:.2f} dB on {views} test views in {seconds['test']:.1f} s, "
        f"peak memory {max(peaks.values()) / 1e6:.0f} MB{taken}.\n\n{table}"
    )
