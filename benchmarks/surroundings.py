"""Measure what a background outside the box gives, on the built-in scene in a room.

    python benchmarks/surroundings.py

The built-in scene stands in the middle of a cubic room, four times as wide as the box, with patterned walls; its
photographs are opaque. `quick` is trained with surroundings and without, in the box that follows from the cameras, and
scored on held-out views. One record for each in benchmarks/results/surroundings.jsonl.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import stored
import torch
from torch import Tensor

from gridreg.cli import run_cli
from gridreg.rendering import camera_rays
from gridreg.scenes import Scene, Views, builtin_scene, load_scene
from gridreg.scenes.focus import focus_extent
from gridreg.training import TrainOptions, configure, execute

STUDY = "surroundings"
HALF = 6.0
"""Half the edge of the room, world units."""


def walls(origins: Tensor, directions: Tensor) -> Tensor:
    """Return the colours ``(R, 3)`` of the walls that rays from inside the room meet."""
    distance = ((HALF * directions.sign() - origins) / directions).amin(dim=-1)
    x = (origins + distance[:, None] * directions) / HALF
    stripes = 0.5 + 0.25 * torch.sin(5 * x.roll(1, dims=-1)) + 0.15 * torch.sin(11 * x + 1)
    return stripes.clamp(0, 1)


def in_room(views: Views) -> Views:
    """Return views with walls behind the object, opaque."""
    behind = [
        walls(rays.origins, rays.directions).reshape(views.height, views.width, 3)
        for rays in (
            camera_rays(pose, lens, views.height, views.width)
            for pose, lens in zip(views.poses, views.intrinsics, strict=True)
        )
    ]
    alpha = views.rgba[..., 3:]
    rgb = views.rgba[..., :3] * alpha + (1 - alpha) * torch.stack(behind)
    return replace(views, pixels=torch.cat([rgb, torch.ones_like(alpha)], dim=-1))


def room(folder: Path) -> Scene:
    """Return the scene in its room; it is trained on its 25 test views, as it takes many to see all walls."""
    scene = load_scene(folder, "first18")
    train, test = in_room(scene.test), in_room(scene.train)
    size = (train.width, train.height)
    extent = focus_extent(train.poses.double().numpy(), train.intrinsics.double().numpy(), size)
    bounds = torch.as_tensor(extent.bounds, dtype=torch.float32)
    return replace(scene, train=train, test=test, near=extent.near, far=extent.far, bounds=bounds)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=100, help="pixels of the photographs' edges")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=stored.RESULTS, help="folder of the stored figures")
    arguments = parser.parse_args()
    scene = room(builtin_scene(stored.SCENES, size=arguments.size))
    for on in ("true", "false"):
        options = TrainOptions(
            preset=arguments.preset,
            steps=arguments.steps,
            seed=arguments.seed,
            set=(f"train.surroundings={on}",),
        )
        with tempfile.TemporaryDirectory() as folder:
            _, metrics = execute(configure(options), scene, Path(folder) / "run")
        if metrics is None:
            raise KeyboardInterrupt
        name = f"builtin-{arguments.size}-{arguments.preset}-{arguments.steps}steps-{on}-seed{arguments.seed}"
        command = stored.command_line("benchmarks/surroundings.py")
        stored.save(
            STUDY, name, {**metrics, "surroundings": on == "true", "command": command}, arguments.results
        )
        print(f"surroundings {on}: {metrics['mean']['psnr']:.2f} dB held out", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
