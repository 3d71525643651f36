"""One run of a study, from its specification to its result."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import sys
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gridreg.ablation.claims import ClaimLostError
from gridreg.ablation.database import DiskFullError
from gridreg.ablation.own_command import run_command
from gridreg.ablation.records import RunSpec
from gridreg.ablation.study import DATA_VARIABLE
from gridreg.errors import InputError
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.training import RunConfig, execute
from gridreg.training.checkpoint import has_checkpoint, load_checkpoint
from gridreg.training.files import check_output_folder, output_errors, remove_folder
from gridreg.training.typed_data import from_data
from gridreg.training.versions import cpu_model

LOG_NAME = "log.txt"
"""File in a run's folder with what the run printed, and the traceback of an error."""

_KEPT = 2


@dataclass(frozen=True)
class TaskResult:
    """Outcome of a run; with neither metrics nor a reason, it was interrupted.

    Args:
        metrics: as `gridreg.training.execute` returned them.
        reason: of a failure, one line.
        disk_full: whether it failed for want of space.
        machine: that computed it.
        fingerprint: of the scene.
        files: of the run's folder by path in it, where it was done on another machine.
    """

    metrics: dict[str, Any] | None = None
    reason: str = ""
    disk_full: bool = False
    machine: str = ""
    fingerprint: str = ""
    files: dict[str, bytes] = field(default_factory=dict)


class Scenes:
    """Opens scenes and keeps the last ones, because neighbouring runs share theirs.

    Args:
        cache: folder for the built-in scene.
        device: where runs on them compute.
    """

    def __init__(self, cache: Path, device: str = "cpu") -> None:
        self._cache, self._device = cache, device
        self._kept: OrderedDict[tuple[Any, ...], Scene] = OrderedDict()

    def get(self, spec: RunSpec, fetch: Callable[[], Scene] | None = None) -> Scene:
        """The scene of a run.

        Args:
            spec: the run.
            fetch: gets the scene where it comes by another way than from its folder.

        Raises:
            InputError: if it cannot be read.
        """
        key = scene_key(spec)
        if key not in self._kept:
            self._kept[key] = self._load(spec) if fetch is None else fetch()
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def _load(self, spec: RunSpec) -> Scene:
        if spec.scene is None:
            folder, size = builtin_scene(self._cache, size=spec.size or 200), None
        else:
            folder, size = locate_scene(spec.scene), spec.size
        scene = load_scene(folder, spec.protocol, size=size, test=spec.test, opaque=_is_opaque(spec))
        return scene.to(self._device)


def scene_key(spec: RunSpec) -> tuple[Any, ...]:
    """All that tells two opened scenes apart."""
    return (spec.scene, spec.protocol, spec.size, spec.test, _is_opaque(spec))


def _is_opaque(spec: RunSpec) -> bool:
    return bool(spec.config.get("opaque", False))


def locate_scene(path: str) -> Path:
    """The folder of a scene on this machine: its path, or the end of its path below the folder in GRIDREG_DATA.

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
    watch: Callable[[], None] = lambda: None,
    log: bool = False,
) -> TaskResult:
    """Train and score a run in its folder, from the checkpoint that stands there; what goes wrong is in the result.

    Args:
        spec: what to run.
        folder: where.
        scenes: opens the scene.
        watch: called at every iteration; it may end the run by raising `ClaimLostError`.
        log: what the run prints goes to its folder instead of the terminal.

    Raises:
        ClaimLostError: if ``watch`` raised it.
    """
    try:
        with _printing_to(folder) if log else contextlib.nullcontext():
            if spec.command:
                return TaskResult(run_command(spec, folder, watch), machine=describe_machine())
            scene, path = scenes.get(spec), spec.scene
            if path is not None:
                # A scene that was shipped lies nowhere here.
                with contextlib.suppress(InputError):
                    path = str(locate_scene(path))
            config = replace(from_data(RunConfig, spec.config, source=spec.describe()), scene=path)
            check_output_folder(folder)
            resume = _usable(folder / "checkpoint", scene)
            _, metrics = execute(
                config, scene, folder, resume=resume, command=sys.argv, on_step=lambda report: watch()
            )
            return TaskResult(metrics, machine=describe_machine(), fingerprint=scene.fingerprint)
    except ClaimLostError:
        raise
    except Exception as error:
        return TaskResult(reason=_reason_of(error, folder), disk_full=is_disk_full(error))


def describe_machine() -> str:
    """Host and processor.

    Example:
        >>> describe_machine().startswith(platform.node())
        True
    """
    return f"{platform.node()} ({cpu_model()})"


def is_disk_full(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, says that there is no space left."""
    while error is not None:
        if isinstance(error, DiskFullError):
            return True
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


def _reason_of(error: Exception, folder: Path) -> str:
    """One line for the store; where it leaves something out, the traceback goes to the run's log."""
    if isinstance(error, InputError):
        return str(error)
    with contextlib.suppress(OSError), (folder / LOG_NAME).open("a", encoding="utf-8") as stream:
        stream.write("".join(traceback.format_exception(error)))
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]} (see {LOG_NAME})"


@contextmanager
def _printing_to(folder: Path) -> Iterator[None]:
    """A block whose output goes to the log of the run in ``folder``."""
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stream = (folder / LOG_NAME).open("a", encoding="utf-8")
    with stream, contextlib.redirect_stderr(stream), contextlib.redirect_stdout(stream):
        yield


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
