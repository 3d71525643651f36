"""One run of a study, from its claim to its result."""

from __future__ import annotations

import os
import platform
import sys
import traceback
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gridreg.ablation.records import RunSpec
from gridreg.ablation.study import DATA_VARIABLE
from gridreg.errors import InputError
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.training import RunConfig, execute
from gridreg.training.checkpoint import has_checkpoint, load_checkpoint
from gridreg.training.config import from_data
from gridreg.training.files import check_output_folder, output_errors, remove_folder, write_text
from gridreg.training.versions import cpu_model

__all__ = ["LOG_NAME", "Outcome", "Scenes", "describe_machine", "perform", "reason_of", "scene_key"]

LOG_NAME = "log.txt"
"""File in a run's folder with what the run printed, and the traceback of an error."""

_KEPT = 2


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    Args:
        metrics: as `gridreg.training.execute` returned them; None if the run was interrupted.
        fingerprint: of the scene.
        machine: that computed it.
    """

    metrics: dict[str, Any] | None
    fingerprint: str
    machine: str


class Scenes:
    """Opens scenes and keeps the last ones, because neighbouring runs share theirs.

    Args:
        cache: folder for the built-in scene.
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        self._kept: OrderedDict[tuple[Any, ...], Scene] = OrderedDict()

    def get(self, spec: RunSpec) -> Scene:
        """The scene of a run.

        Raises:
            InputError: if it cannot be read.
        """
        key = scene_key(spec)
        if key not in self._kept:
            self.put(spec, self._load(spec))
        self._kept.move_to_end(key)
        return self._kept[key]

    def put(self, spec: RunSpec, scene: Scene) -> None:
        """Keep a scene that came by another way."""
        self._kept[scene_key(spec)] = scene
        while len(self._kept) > _KEPT:
            self._kept.popitem(last=False)

    def _load(self, spec: RunSpec) -> Scene:
        if spec.scene is None:
            folder, size = builtin_scene(self._cache, size=spec.size or 200), None
        else:
            folder, size = locate_scene(spec.scene), spec.size
        return load_scene(folder, spec.protocol, size=size, test=spec.test)


def scene_key(spec: RunSpec) -> tuple[Any, ...]:
    """What tells two opened scenes apart."""
    return (spec.scene, spec.protocol, spec.size, spec.test)


def locate_scene(path: str) -> Path:
    """Where a scene lies on this machine: at its path, or by the end of its path below the folder in GRIDREG_DATA.

    Raises:
        InputError: if it is at neither.
    """
    data = os.environ.get(DATA_VARIABLE)
    parts = Path(path).parts
    # On another machine the same tree of scenes may begin elsewhere: name, then folder and name, and so on.
    below = [Path(data, *parts[-count:]) for count in range(1, len(parts))] if data else []
    for place in (Path(path), *below):
        if place.is_dir():
            return place
    hint = (
        f"{data} ({DATA_VARIABLE}) holds none of this name either" if data else f"{DATA_VARIABLE} is not set"
    )
    raise InputError(
        f"scene {Path(path).name}: not on {platform.node()}: found no folder {path}, and {hint}; expected it there, "
        "or scenes shipped with the run"
    )


def perform(
    spec: RunSpec,
    folder: Path,
    scenes: Scenes,
    *,
    keep_checkpoint: bool = True,
    watch: Callable[[], None] | None = None,
) -> Outcome:
    """Train and score a run in its folder; goes on from the checkpoint that stands there.

    Args:
        spec: what to run.
        folder: where.
        scenes: opens the scene.
        keep_checkpoint: leave the checkpoint of a finished run there.
        watch: called at every iteration; an exception from it ends the run.

    Raises:
        InputError: for an unusable scene or folder, or a training that has died.
    """
    scene = scenes.get(spec)
    path = spec.scene if spec.scene is None else str(locate_or_keep(spec.scene))
    config = replace(from_data(RunConfig, spec.config, source=spec.describe()), scene=path)
    check_output_folder(folder)
    resume = _usable(folder / "checkpoint", scene)

    def on_step(_: Any) -> None:
        if watch is not None:
            watch()

    _, metrics = execute(config, scene, folder, resume=resume, command=sys.argv, on_step=on_step)
    if metrics is not None and not keep_checkpoint:
        remove_folder(folder / "checkpoint")
    return Outcome(metrics, scene.fingerprint, describe_machine())


def locate_or_keep(path: str) -> Path:
    """Where a scene lies on this machine, or its path elsewhere if it was shipped."""
    try:
        return locate_scene(path)
    except InputError:
        return Path(path)


def describe_machine() -> str:
    """Host and processor.

    Example:
        >>> describe_machine().startswith(platform.node())
        True
    """
    return f"{platform.node()} ({cpu_model()})"


def reason_of(error: BaseException, folder: Path) -> str:
    """One line for the store; what the line leaves out goes to the run's log.

    Args:
        error: that ended the run.
        folder: of the run.
    """
    if isinstance(error, InputError):
        return str(error)
    text = "".join(traceback.format_exception(error))
    log = folder / LOG_NAME
    with output_errors(log):
        before = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    write_text(log, before + text)
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]} (see {LOG_NAME})"


def _usable(checkpoint: Path, scene: Scene) -> bool:
    """Whether to go on from a checkpoint; one that cannot be used is put aside, and the run starts over."""
    if not has_checkpoint(checkpoint):
        return False
    try:
        load_checkpoint(checkpoint, fingerprint=scene.fingerprint)
    except InputError as error:
        print(f"starting over: {error}", file=sys.stderr)
        for name in (checkpoint.name, f".{checkpoint.name}.new", f".{checkpoint.name}.old"):
            remove_folder(checkpoint.with_name(name))
        return False
    return True
