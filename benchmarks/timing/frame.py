"""`frame`: seconds for a picture of a trained field."""

from __future__ import annotations

import argparse
import time

from gridreg.rendering import Camera, Lens
from gridreg.training import build_trainer

from . import common
from .common import Record

HELP = "seconds for a test view after training, in several sizes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser, preset="quick")
    parser.add_argument("--steps", type=common.count, help="iterations of training; default: the preset's")
    parser.add_argument("--sizes", type=common.count, nargs="+", default=[400, 200], help="widths, pixels")
    parser.add_argument("--views", type=common.count, help="how many of the test views; default: all")


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    config = common.configuration(arguments, arguments.steps)
    scene = common.scene_of(config)
    trainer = build_trainer(config, scene)
    trainer.train()
    trainer.handle.step(config.train.steps)
    trainer.field.eval()
    views = scene.test
    chosen = range(len(views))[: arguments.views]
    sizes: dict[str, Record] = {}
    for width in arguments.sizes:
        height = round(width * views.height / views.width)
        times = []
        for turn, view in enumerate([chosen[0], *chosen]):
            # One image goes before those that count.
            intrinsics = views.intrinsics[view] * (width / views.width)
            camera = Camera(views.poses[view], Lens.from_tensor(intrinsics, height, width))
            began = time.perf_counter()
            trainer.model.render(camera)
            if turn:
                times.append(time.perf_counter() - began)
        sizes[str(width)] = {"height": height, "seconds": common.spread(times)}
    record: Record = {
        "scene": common.scene_name(arguments),
        "preset": arguments.preset,
        "steps": trainer.step,
        "resolution": list(getattr(trainer.field, "resolution", ())),
        "views": len(chosen),
        "sizes": sizes,
    }
    length = "" if arguments.steps is None else f"-{arguments.steps}steps"
    return record, common.setting(arguments) + length


def show(record: Record) -> str:
    rows = []
    for width, size in record["sizes"].items():
        seconds = size["seconds"]
        rows.append(
            [
                f"{width}x{size['height']}",
                f"{seconds['median']:.3f}",
                f"{seconds['quarter']:.3f} to {seconds['three_quarters']:.3f}",
                f"{1 / seconds['median']:.1f}",
            ]
        )
    grid = "x".join(map(str, record["resolution"])) or "none"
    return (
        f"{record['scene']}, {record['preset']}, {record['steps']} iterations, grid {grid}; median over "
        f"{record['views']} test views.\n\n"
        + common.markdown(["size", "seconds", "middle half", "pictures per second"], rows)
    )
