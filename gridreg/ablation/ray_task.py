"""A run on a Ray worker: it needs gridreg and, unless scenes are shipped, the scene; not the store."""

from __future__ import annotations

import atexit
import functools
import importlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from gridreg.ablation.perform import Scenes, TaskResult, perform
from gridreg.ablation.records import RunSpec
from gridreg.errors import InputError
from gridreg.machine import remove_left_behind
from gridreg.scenes import Scene
from gridreg.training.files import output_errors, remove_folder, replacing_folder


@dataclass(frozen=True)
class Task:
    """A run as it travels to a worker.

    Args:
        spec: `RunSpec.to_json`.
        files: of the run's folder so far; a checkpoint among them goes on.
        threads: of torch.
        keep_checkpoint: send back that of a finished run.
        modules: to import first.
    """

    spec: dict[str, Any]
    files: dict[str, bytes]
    threads: int
    keep_checkpoint: bool
    modules: tuple[str, ...]


def run_task(task: Task, fetch_scene: Callable[[], Scene] | None = None) -> TaskResult:
    """Do a run in a temporary folder.

    Args:
        task: the run.
        fetch_scene: gets the scene where it was shipped; None: it is found by path.
    """
    torch.set_num_threads(task.threads)
    spec = RunSpec.from_json(task.spec)
    with tempfile.TemporaryDirectory(prefix="gridreg-run-") as parent:
        folder = Path(parent) / "run"
        write_folder(task.files, folder)
        try:
            for module in task.modules:
                importlib.import_module(module)
            if fetch_scene is not None:
                _worker_scenes().get(spec, fetch_scene)
        except Exception as error:
            return TaskResult(reason=f"{type(error).__name__}: {error}", files=task.files)
        result = perform(spec, folder, _worker_scenes(), log=True)
        if result.metrics is not None and not task.keep_checkpoint:
            remove_folder(folder / "checkpoint")
        return replace(result, files=read_folder(folder))


@functools.cache
def _worker_scenes() -> Scenes:
    """Scenes for the life of the worker process, because neighbouring runs share theirs."""
    # Not a name that another user could know and take first.
    folder = tempfile.mkdtemp(prefix="gridreg-scenes-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Scenes(Path(folder))


def read_folder(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by its path in it; nothing if there is no folder.

    Raises:
        InputError: if a file cannot be read.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            try:
                found[path.relative_to(folder).as_posix()] = path.read_bytes()
            except OSError as error:
                raise InputError(f"{path}: cannot read: {error.strerror}") from error
    return found


def write_folder(files: Mapping[str, bytes], folder: Path) -> None:
    """Make ``folder`` what `read_folder` saw; what stood there goes when the new content is complete.

    Raises:
        InputError: if a path leads out of the folder, or the place is not writable.
    """
    with output_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_left_behind(folder.parent)
    with replacing_folder(folder) as fresh:
        for name, content in files.items():
            place = PurePosixPath(name)
            # What a worker sends is written below this folder and nowhere else.
            if place.is_absolute() or ".." in place.parts or not place.parts:
                raise InputError(f"{folder}: found {name!r} in what a worker sent, expected plain files")
            (fresh / place).parent.mkdir(parents=True, exist_ok=True)
            (fresh / place).write_bytes(content)
