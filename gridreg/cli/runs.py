"""Checkpoints as the commands name them, and the scenes that they were trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gridreg.errors import InputError
from gridreg.scenes import Scene, builtin_photographs
from gridreg.training import LoadedRun, open_scene

CACHE = Path("outputs")
"""Where the built-in scene is made, below the current folder."""


def folder_of(checkpoint: Path) -> Path:
    """The output folder of a run that is named by itself or by its checkpoint."""
    return checkpoint.parent if checkpoint.name == "checkpoint" else checkpoint


def photographs_of(source: Path) -> Path:
    """The folder of photographs that is named: for the word ``builtin``, of the built-in ones, made if need be."""
    if source.name == str(source) == "builtin" and not source.exists():
        return builtin_photographs(CACHE) / "photographs"
    return source


def scene_of(run: LoadedRun, checkpoint: Path, scene: Path | None, *, test: bool = True) -> Scene:
    """The scene that a checkpoint was trained on.

    Args:
        run: the checkpoint.
        checkpoint: how it was named, for messages.
        scene: where the scene lies now; None: where the run found it.
        test: whether test views are read.

    Raises:
        InputError: if it is not there, cannot be read, or is another scene by its fingerprint.
    """
    config = run.config if scene is None else replace(run.config, scene=str(scene))
    if config.scene is not None and not Path(config.scene).is_dir():
        raise InputError(f"{config.scene}: no such scene folder; say with --scene where it lies now")
    found = open_scene(config, CACHE, test=None if test else ())
    if found.fingerprint != run.fingerprint:
        raise InputError(
            f"{checkpoint}: trained on another scene than {config.scene or 'the built-in one'} under {found.protocol} "
            f"(fingerprint {run.fingerprint[:12]}, found {found.fingerprint[:12]}); expected the same training images"
        )
    return found


def views_scene(run: LoadedRun, checkpoint: Path, scene: Path | None) -> Scene | None:
    """The scene for its training cameras alone: None where it was not asked for and does not lie where it lay.

    Raises:
        InputError: if it was asked for and does not fit.
    """
    if scene is None and run.config.scene is not None and not Path(run.config.scene).is_dir():
        return None
    return scene_of(run, checkpoint, scene, test=False)
