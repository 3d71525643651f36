"""One run from a configuration to a trainer and its checkpoints, and back."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

import gridreg
from gridreg.base import Regularizer
from gridreg.errors import InputError
from gridreg.fields import make_field
from gridreg.machine import check_memory
from gridreg.scenes import IN_PLACE, Scene, Views, builtin_scene, default_protocol, load_scene
from gridreg.training.checkpoint import load_checkpoint, save_checkpoint, sound
from gridreg.training.events import carved_box, resolution_of
from gridreg.training.settings import RunConfig
from gridreg.training.trainer import Trainer
from gridreg.training.typed_data import to_data


def open_scene(
    config: RunConfig, cache: Path, validation: int | None = None, *, test: Sequence[int] | None = None
) -> Scene:
    """Load the scene of a configuration; without one, the built-in scene, made in ``cache`` if it is not there.

    What there is to say about how its files were understood goes to standard error.

    Args:
        config: names scene and protocol.
        cache: folder for the built-in scene.
        validation: how many views to read for tuning, outside the protocol's.
        test: indices of the test views instead of the protocol's; an empty one reads none.
    """
    folder = builtin_scene(cache) if config.scene is None else Path(config.scene)
    protocol = config.protocol or default_protocol(folder)
    scene = load_scene(
        folder, protocol, size=config.size, opaque=config.opaque, test=test, validation=validation
    )
    for note in scene.notes:
        print(f"note: {note}", file=sys.stderr, flush=True)
    return scene


def regularizers_of(config: RunConfig) -> list[Regularizer]:
    """The composition of a configuration."""
    if isinstance(config.composition, str):
        return list(gridreg.composition(config.composition))
    return list(gridreg.from_config(config.composition))


def check_grid(config: RunConfig, voxels: int) -> None:
    """Refuse a grid of a configuration that the memory cannot hold.

    Args:
        config: names field and channels.
        voxels: of the grid.

    Raises:
        InputError: naming how much it takes at the least.
    """
    counts = (value for name, value in config.field.items() if name.endswith("components"))
    channels = sum(value for value in counts if isinstance(value, int)) or 16
    # Three planes or lines of so many channels, with their gradients and two moments.
    values = 3 * channels * float(voxels) ** (2 / 3 if config.backbone == "vm" else 1 / 3)
    check_memory(16 * values, f"train.voxels_start, train.voxels_end: {channels} channels of {voxels} voxels")


def check_size(config: RunConfig) -> None:
    """Refuse a configuration that needs more memory than there is.

    Raises:
        InputError: names the setting.
    """
    settings = config.train
    check_memory(400 * settings.rays, f"train.rays={settings.rays}")
    check_grid(config, max(settings.voxels_start, settings.voxels_end))


def build_trainer(config: RunConfig, scene: Scene) -> Trainer:
    """Field and trainer of a configuration, at step 0."""
    check_size(config)
    settings = config.train
    bounds = carved_box(scene) if settings.carve and not scene.ndc else scene.bounds
    field = make_field(
        config.backbone,
        bounds,
        resolution_of(settings.voxels_start, bounds),
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
        "cameras": _cameras(trainer.scene.train),
        "record": record,
    }
    if trainer.scene.world != IN_PLACE:
        state["world"] = trainer.scene.world._asdict() | {"origin": list(trainer.scene.world.origin)}
    save_checkpoint(folder, state, config=to_data(config), fingerprint=trainer.scene.fingerprint)


def _cameras(views: Views) -> dict[str, Any]:
    size = {"height": views.height, "width": views.width}
    return {"poses": views.poses, "intrinsics": views.intrinsics, **size}


def resume_trainer(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    make: Callable[[RunConfig, Scene], Trainer] = build_trainer,
) -> tuple[Trainer, dict[str, Any]]:
    """The trainer as it was when the checkpoint was written, made anew, and the record saved with it.

    Raises:
        InputError: if the checkpoint is missing, damaged, of another scene or of another configuration.
    """
    saved = load_checkpoint(folder, fingerprint=scene.fingerprint)
    if "members" in saved.state:
        raise InputError(
            f"{folder}: an ensemble, which cannot be trained; resume its members in their own folders"
        )
    with sound(folder):
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
    trainer = make(config, scene)
    with sound(folder):
        trainer.load_state_dict(saved.state["trainer"])
        return trainer, saved.state["record"]
