"""The two situations of the published schedule that are measured, each held still."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops import use_backend
from gridreg.rendering import OccupancyGrid, Rays
from gridreg.scenes import Scene
from gridreg.training import RunConfig, Trainer, build_trainer, load_preset, load_run, regularizers_of


@dataclass(frozen=True)
class Situation:
    """A trainer that repeats one iteration: learning rates are 0, so every repetition sees the same field.

    Args:
        name: for tables.
        trainer: what repeats.
        step: the iteration that its schedules read.
    """

    name: str
    trainer: Trainer
    step: int

    def rewind(self, turn: int) -> None:
        """Back to the same iteration, with the rays of a turn."""
        self.trainer.step = self.step
        self.trainer.generator.manual_seed(turn)

    def run(self, turn: int, backend: str = "auto") -> None:
        """One iteration with the rays of a turn."""
        self.rewind(turn)
        with use_backend(backend):
            self.trainer.train_step()

    def batch(self, turn: int) -> tuple[Rays, Tensor]:
        """The rays of a turn and their colours on white ``(R, 3)``."""
        self.rewind(turn)
        rays, rgba = self.trainer.bank.draw(self.trainer.settings.rays, self.trainer.generator)
        return rays, rgba[:, :3] * rgba[:, 3:] + 1 - rgba[:, 3:]

    @torch.no_grad()
    def describe(self, turns: int = 3) -> dict[str, Any]:
        """Size of the grid and mean number of samples per ray."""
        trainer, density, colour = self.trainer, 0, 0
        for turn in range(turns):
            self.rewind(turn)
            trainer.handle.step(self.step)
            rendered = trainer.render_batch()[0]
            assert rendered.samples is not None
            assert rendered.coloured is not None
            density += rendered.samples.t.numel()
            colour += rendered.coloured.numel()
        rays = turns * trainer.settings.rays
        return {
            "situation": self.name,
            "resolution": list(getattr(trainer.field, "resolution", ())),
            "rays": trainer.settings.rays,
            "occupied_cells": trainer.occupancy.fraction,
            "density_samples_per_ray": density / rays,
            "colour_samples_per_ray": colour / rays,
        }


def _without_events(config: RunConfig) -> RunConfig:
    nothing: dict[str, Any] = dict.fromkeys(
        ("resample_at", "occupancy_at", "shrink_at", "filter_rays_at", "evaluate_at"), ()
    )
    return replace(config, train=replace(config.train, occupancy_every=0, **nothing))


def _still(trainer: Trainer, name: str, step: int) -> Situation:
    for group in trainer.optimizer.param_groups:
        group["initial_lr"] = 0.0
    return Situation(name, trainer, step)


def _middle(first: int, last: int) -> int:
    return (first + last) // 2


def early(config: RunConfig, scene: Scene, *, edge: int, learning: int) -> Situation:
    """The first part of the schedule: a fresh field of ``edge^3`` cells in the scene's own box, every cell occupied.

    Schedules stand where they are in the middle of that part.

    Args:
        config: a preset's.
        scene: with its training views.
        edge: of the grid.
        learning: iterations of training before the field is held still.
    """
    train = config.train
    settings = replace(_without_events(config).train, voxels_start=edge**3, carve=False)
    trainer = build_trainer(replace(config, train=settings), scene)
    trainer.train(until=min(learning, train.steps))
    first = min([step for step in (*train.occupancy_at, *train.resample_at) if step], default=train.steps)
    return _still(trainer, f"{edge}³ without occupancy", _middle(0, first))


def learn(config: RunConfig, scene: Scene, steps: int, voxels: int) -> Trainer:
    """A preset's field that has learnt the scene as `quick` does, in ``steps`` iterations.

    The published initial density takes thousands of iterations to come alive; from a wanted initial opacity, inside the
    visual hull, hundreds do.

    Args:
        config: whose field is taken.
        scene: with its training views.
        steps: iterations.
        voxels: cells that the grid has at most.
    """
    quick = load_preset("quick")
    schedule = quick.train.scaled(steps)
    train = replace(
        schedule,
        rays=config.train.rays,
        voxels_start=min(voxels, schedule.voxels_start),
        voxels_end=min(voxels, schedule.voxels_end),
    )
    field = config.field
    if config.backbone != "mlp":
        field = {**config.field, "density_shift": None, "initial_opacity": 0.1}
    teaching = replace(config, field=field, train=train, composition=quick.composition)
    trainer = build_trainer(teaching, scene)
    trainer.train()
    trainer.handle.remove()
    return trainer


def late(
    config: RunConfig,
    scene: Scene,
    *,
    edge: int,
    learning: int,
    warm_up: int,
    trained: Path | None = None,
) -> Situation:
    """The last part of the schedule: a field that has learnt the scene, of ``edge^3`` cells, with its occupancy.

    Schedules stand where they are in the middle of that part.

    Args:
        config: a preset's; its composition and settings hold from the last resampling on.
        scene: with its training views.
        edge: of the grid.
        learning: iterations in which the field learns the scene.
        warm_up: iterations at the last size, before the field is held still.
        trained: folder of a finished run on the scene, whose field and cells are taken as they are.

    Raises:
        InputError: if that run is missing, damaged or of another scene.
    """
    settings = replace(_without_events(config).train, voxels_start=edge**3, carve=trained is None)
    middle = _middle(max(config.train.resample_at, default=0), settings.steps)
    if trained is None:
        field = learn(config, scene, learning, edge**3).field
        name = f"{edge}³ with occupancy"
    else:
        run = load_run(trained)
        if run.fingerprint != scene.fingerprint:
            raise InputError(f"--trained {trained}: a run on other views than those of {scene.name}")
        run.handle.remove()
        field = run.field.train()
        name = f"{'x'.join(map(str, getattr(field, 'resolution', ())))} with occupancy"
    trainer = Trainer(field, scene, regularizers_of(config), settings, seed=config.seed)
    trainer.step = middle
    if trained is not None:
        trainer.space.occupancy = run.occupancy
    else:
        if hasattr(field, "resample"):
            trainer.space.resample(middle)
            trainer.restart_optimizer()
        trainer.space.update(middle)
    trainer.space.filter_rays()
    trainer.train(until=min(middle + warm_up, settings.steps))
    return _still(trainer, name, middle)


def require_grid(trainer: Trainer, option: str) -> None:
    """Raise a readable error unless the field has the grids of VM."""
    if not hasattr(trainer.field, "density_planes"):
        kind = type(trainer.field).__name__
        raise InputError(
            f"{option}: found a field {kind}, expected VMField (backbone vm), whose grids it knows"
        )


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Compute with so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cells_of(
    density: Callable[[Tensor], Tensor], bounds: Tensor, step: float, edge: int = 64
) -> OccupancyGrid:
    """The occupied cells of a density, found as a trainer finds them."""
    grid = OccupancyGrid.full(bounds, (edge, edge, edge))
    grid.update(density, step)
    return grid
