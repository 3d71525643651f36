"""Checkpoints read to be looked at: one run, or an ensemble of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import gridreg
from gridreg.errors import InputError
from gridreg.fields import import_modules, make_field
from gridreg.rendering import (
    Ensemble,
    JoinedSurroundings,
    Model,
    OccupancyGrid,
    Surroundings,
)
from gridreg.rendering.cameras import Camera, cameras_of
from gridreg.scenes import IN_PLACE, World
from gridreg.scenes.gate import check_extent
from gridreg.scenes.notebook import card
from gridreg.scenes.views import background_colour
from gridreg.training.checkpoint import has_checkpoint, load_checkpoint, sound
from gridreg.training.events import march_of
from gridreg.training.rays import NdcWarp
from gridreg.training.run import check_grid, regularizers_of
from gridreg.training.settings import RunConfig
from gridreg.training.surroundings import make_surroundings
from gridreg.training.trainer import load_field
from gridreg.training.typed_data import from_data


@dataclass(frozen=True, kw_only=True, repr=False)
class LoadedRun(Model):
    """A trained field, in eval mode, with all it takes to render it, and the run that it comes from.

    Args:
        field, occupancy, march, background, warp, surroundings: see `gridreg.rendering.Model`.
        handle: of the regularizers; masks that are not fully open act only as long as it is kept. None for an ensemble,
            whose members have theirs.
        config: of the run; of an ensemble, the first member's.
        step: iterations done; of an ensemble, the fewest of its members'.
        fingerprint: of the scene it was trained on, see `gridreg.scenes.Scene`.
        world: where the scene lies in the world of its files.
        exposed: whether exposures of the photographs were estimated.
        cameras: of the training views; older checkpoints do not have them.
        members: the runs that an ensemble is made of, else none.
    """

    config: RunConfig
    step: int
    fingerprint: str
    world: World = IN_PLACE
    exposed: bool = False
    cameras: tuple[Camera, ...] = ()
    members: tuple[LoadedRun, ...] = ()

    def __repr__(self) -> str:
        config, of = self.config, f", {len(self.members)} members" if self.members else ""
        name = f"{config.preset or 'run'}, {type(self.field).__name__}"
        return f"LoadedRun({name}, step {self.step} of {config.train.steps}, seed {config.seed}{of})"

    def _repr_html_(self) -> str:
        """The run as notebooks show it, with the table of its regularizers."""
        return card(repr(self), "") + ("" if self.handle is None else self.handle._repr_html_())


def checkpoint_of(folder: str | Path) -> Path:
    """The checkpoint in the output folder of a run, or the folder itself if it is one.

    Raises:
        InputError: if there is a folder without any.
    """
    path = Path(folder)
    if has_checkpoint(path / "checkpoint"):
        return path / "checkpoint"
    if path.is_dir() and not (path / "state.json").exists() and not (path / "tensors.safetensors").exists():
        raise InputError(f"{path}: holds no checkpoint, expected the output folder of a run")
    return path


def members_in(path: Path) -> tuple[list[dict[str, Any]], bool, str]:
    """Configuration and state of each run in a checkpoint, ``{"config": ..., "state": ...}``.

    Returns:
        One entry for each run; whether it is an ensemble; the fingerprint of the scene.

    Raises:
        InputError: of `load_checkpoint`.
    """
    saved = load_checkpoint(path)
    with sound(path):
        if "members" in saved.state:
            return list(saved.state["members"]), True, saved.fingerprint
    return [{"config": saved.config, "state": saved.state}], False, saved.fingerprint


def load_run(folder: str | Path, device: torch.device | str = "cpu") -> LoadedRun:
    """Read a checkpoint for rendering, without its scene.

    Args:
        folder: a checkpoint, or an output folder that holds one, of a run or of an ensemble.
        device: where the field is to be.

    Raises:
        InputError: if there is none, or it is damaged.
    """
    path = checkpoint_of(folder)
    members, joined, fingerprint = members_in(path)
    with sound(path):
        runs = [_run(member["config"], member["state"], fingerprint, path, device) for member in members]
        return ensemble_of(runs) if joined else runs[0]


def ensemble_of(runs: Sequence[LoadedRun]) -> LoadedRun:
    """Runs of one scene as one, see `gridreg.rendering.Ensemble`; the march has the shortest step of any.

    Args:
        runs: with equal fingerprint, background and warp.

    Raises:
        InputError: without runs.
    """
    field = Ensemble([run.field for run in runs], [run.occupancy for run in runs]).eval()
    around = [run.surroundings for run in runs if isinstance(run.surroundings, Surroundings)]
    march = replace(runs[0].march, step=min(run.march.step for run in runs))
    step = min(run.step for run in runs)
    return replace(
        runs[0],
        field=field,
        occupancy=field.occupancy(),
        march=march,
        step=step,
        handle=None,
        surroundings=JoinedSurroundings(around) if len(around) == len(runs) else None,
        members=tuple(runs),
    )


def _run(
    plain: Any, state: dict[str, Any], fingerprint: str, path: Path, device: torch.device | str
) -> LoadedRun:
    config = from_data(RunConfig, plain, source=str(path))
    folder = path.parent if path.name == "checkpoint" else path
    import_modules(config.modules, str(path), never=folder)
    trainer = state["trainer"]
    bounds, resolution = trainer["field"]["bounds"], tuple(trainer["resolution"]) or (128,) * 3
    near, far = float(state["march"]["near"]), float(state["march"]["far"])
    check_extent(near, far, bounds)
    check_grid(config, math.prod(resolution))
    field = make_field(config.backbone, bounds, resolution, **config.field)
    load_field(field, trainer)
    field.to(device)
    # Masks that are not yet open are part of what was trained.
    handle = gridreg.apply(field, *regularizers_of(config), total_steps=config.train.steps, seed=config.seed)
    handle.load_state_dict(trainer["handle"])
    handle.step(min(int(trainer["step"]), config.train.steps))
    field.eval()
    return LoadedRun(
        field=field,
        occupancy=OccupancyGrid.restored(trainer["occupancy"]).to(device),
        march=march_of(field, config.train, near, far),
        background=background_colour(state["background"]).to(device),
        handle=handle,
        warp=_saved_warp(state.get("warp")),
        surroundings=_saved_surroundings(trainer.get("surroundings"), device),
        exposed="exposure" in trainer,
        config=config,
        step=int(trainer["step"]),
        fingerprint=fingerprint,
        world=_saved_world(state.get("world")),
        cameras=_saved_cameras(state.get("cameras")),
    )


def _saved_cameras(saved: dict[str, Any] | None) -> tuple[Camera, ...]:
    if saved is None:
        return ()
    poses = saved["poses"].float()
    if poses.shape[1:] != (4, 4) or not bool(torch.isfinite(poses).all()):
        raise ValueError("poses of the training views are not (V, 4, 4) finite numbers")
    return cameras_of(poses, saved["intrinsics"], int(saved["height"]), int(saved["width"]))


def _saved_world(saved: dict[str, Any] | None) -> World:
    if saved is None:
        return IN_PLACE
    x, y, z = map(float, saved["origin"])
    unit = float(saved["unit"])
    if not (all(map(math.isfinite, (x, y, z))) and 0 < unit < math.inf):
        raise ValueError(f"a world of origin {(x, y, z)} and unit {unit}")
    return World((x, y, z), unit, bool(saved.get("metric")))


def _saved_surroundings(saved: dict[str, Any] | None, device: torch.device | str) -> Surroundings | None:
    if saved is None:
        return None
    found = make_surroundings(saved["field"]["box"], 0.0, nodes=saved["nodes"])
    found.load_state_dict(saved["field"])
    return found.eval().to(device)


def _saved_warp(saved: dict[str, Any] | None) -> NdcWarp | None:
    if saved is None:
        return None
    fx, fy, cx, cy = saved["intrinsics"]
    return NdcWarp((fx, fy, cx, cy), saved["height"], saved["width"])
