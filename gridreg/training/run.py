"""One run from a configuration to an output folder: train, checkpoint, score, draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

import gridreg
from gridreg.base import Regularizer
from gridreg.errors import InputError
from gridreg.fields import make_field
from gridreg.handle import Handle
from gridreg.rendering import March, OccupancyGrid
from gridreg.scenes import Scene, builtin_scene, default_protocol, load_scene
from gridreg.training import events
from gridreg.training.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from gridreg.training.config import from_data, to_data
from gridreg.training.rays import NdcWarp
from gridreg.training.settings import RunConfig
from gridreg.training.trainer import Trainer, load_field

__all__ = [
    "LoadedRun",
    "build_trainer",
    "load_run",
    "open_scene",
    "regularizers_of",
    "resume_trainer",
    "save_run",
]


def open_scene(
    config: RunConfig, cache: Path, validation: int | None = None, *, test: Sequence[int] | None = None
) -> Scene:
    """The scene of a configuration; without one, the built-in scene, made in ``cache`` if it is not there.

    Args:
        config: names scene and protocol.
        cache: folder for the built-in scene.
        validation: how many views to read for tuning, outside the protocol's.
        test: indices of the test views instead of the protocol's; an empty one reads none.
    """
    folder = builtin_scene(cache) if config.scene is None else Path(config.scene)
    return load_scene(folder, config.protocol or default_protocol(folder), test=test, validation=validation)


def regularizers_of(config: RunConfig) -> list[Regularizer]:
    """The composition of a configuration."""
    if isinstance(config.composition, str):
        return list(gridreg.composition(config.composition))
    return list(gridreg.from_config(config.composition))


def build_trainer(config: RunConfig, scene: Scene) -> Trainer:
    """Field and trainer of a configuration, at step 0."""
    settings = config.train
    bounds = events.carved_box(scene) if settings.carve and not scene.ndc else scene.bounds
    field = make_field(
        config.backbone,
        bounds,
        events.resolution_of(settings.voxels_start, bounds),
        generator=torch.Generator().manual_seed(config.seed),
        **config.field,
    )
    return Trainer(field, scene, regularizers_of(config), settings, seed=config.seed)


def save_run(folder: Path, trainer: Trainer, config: RunConfig, record: dict[str, Any]) -> None:
    """Write a checkpoint: whole or not at all.

    Args:
        folder: the checkpoint's.
        record: what else belongs to the run so far, as plain data (history, seconds).
    """
    state = {
        "trainer": trainer.state_dict(),
        "march": {"near": trainer.scene.near, "far": trainer.scene.far},
        "warp": None if trainer.warp is None else asdict(trainer.warp),
        "bounds": trainer.scene.bounds,
        "background": trainer.scene.background,
        "record": record,
    }
    save_checkpoint(folder, state, config=to_data(config), fingerprint=trainer.scene.fingerprint)


def resume_trainer(folder: Path, config: RunConfig, scene: Scene) -> tuple[Trainer, dict[str, Any]]:
    """The trainer as it was when the checkpoint was written, and the record saved with it.

    Raises:
        InputError: if the checkpoint is missing, damaged, of another scene or of another configuration.
    """
    saved = load_checkpoint(folder, fingerprint=scene.fingerprint)
    theirs, ours = dict(saved.config), dict(to_data(config))
    # Where the scene lies and how often to save do not change what is computed.
    for plain in (theirs, ours):
        plain.pop("scene", None)
        plain["train"] = {k: v for k, v in plain["train"].items() if k != "checkpoint_minutes"}
    if theirs != ours:
        different = sorted(key for key in {*theirs, *ours} if theirs.get(key) != ours.get(key))
        raise InputError(
            f"{folder}: a checkpoint of another configuration (differs in {', '.join(different)}); "
            "resume with the configuration it was started with, or choose another output folder"
        )
    trainer = build_trainer(config, scene)
    trainer.load_state_dict(saved.state["trainer"])
    return trainer, saved.state["record"]


@dataclass(frozen=True)
class LoadedRun:
    """A trained field and all it takes to render it.

    Args:
        field: in eval mode.
        occupancy: cells that may hold something.
        march: step and range of the rays.
        background: ``(3,)`` colour behind the field.
        config: of the run.
        step: iterations done.
        handle: of the regularizers; masks that are not fully open act only as long as it is kept.
        fingerprint: of the scene it was trained on, see `gridreg.scenes.Scene`.
        warp: maps rays of cameras to the field's coordinates; None: these are the world's.
    """

    field: Any
    occupancy: OccupancyGrid
    march: March
    background: torch.Tensor
    config: RunConfig
    step: int
    handle: Handle
    fingerprint: str
    warp: NdcWarp | None = None


def load_run(folder: str | Path) -> LoadedRun:
    """Read a checkpoint for rendering, without its scene.

    Args:
        folder: a checkpoint, or an output folder that holds one.

    Raises:
        InputError: if there is none, or it is damaged.
    """
    path = Path(folder)
    if has_checkpoint(path / "checkpoint"):
        path = path / "checkpoint"
    elif path.is_dir() and not (path / "state.json").exists() and not (path / "tensors.safetensors").exists():
        raise InputError(f"{path}: holds no checkpoint, expected the output folder of a run")
    saved = load_checkpoint(path)
    config = from_data(RunConfig, saved.config, source=str(path))
    state = saved.state["trainer"]
    bounds = state["field"]["bounds"]
    field = make_field(config.backbone, bounds, tuple(state["resolution"]) or (128,) * 3, **config.field)
    load_field(field, state)
    # Masks that are not yet open are part of what was trained.
    handle = gridreg.apply(field, *regularizers_of(config), total_steps=config.train.steps, seed=config.seed)
    handle.load_state_dict(state["handle"])
    handle.step(min(int(state["step"]), config.train.steps))
    field.eval()
    march = events.march_of(field, config.train, saved.state["march"]["near"], saved.state["march"]["far"])
    return LoadedRun(
        field,
        OccupancyGrid(**state["occupancy"]),
        march,
        saved.state["background"],
        config,
        int(state["step"]),
        handle,
        saved.fingerprint,
        _saved_warp(saved.state.get("warp")),
    )


def _saved_warp(saved: dict[str, Any] | None) -> NdcWarp | None:
    if saved is None:
        return None
    fx, fy, cx, cy = saved["intrinsics"]
    return NdcWarp((fx, fy, cx, cy), saved["height"], saved["width"])
