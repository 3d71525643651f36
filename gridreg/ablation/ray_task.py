"""What a Ray worker does with one run: it needs gridreg and, unless scenes are shipped, the scene; not the store."""

from __future__ import annotations

import contextlib
import importlib
import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gridreg.ablation.packing import pack_folder, unpack_folder
from gridreg.ablation.perform import LOG_NAME, Scenes, perform, reason_of
from gridreg.ablation.records import RunSpec
from gridreg.scenes import Scene

__all__ = ["Order", "Reply", "carry_out"]

_scenes: list[Scenes] = []


@dataclass(frozen=True)
class Order:
    """A run as it travels to a worker.

    Args:
        spec: `RunSpec.to_json`.
        files: of the run's folder so far, see `gridreg.ablation.packing.pack_folder`; a checkpoint among them goes on.
        threads: of torch.
        keep_checkpoint: send back that of a finished run.
        modules: to import first.
    """

    spec: dict[str, Any]
    files: bytes
    threads: int
    keep_checkpoint: bool
    modules: tuple[str, ...]


@dataclass(frozen=True)
class Reply:
    """What a worker sends back.

    Args:
        metrics: of a finished run; None if it failed or was interrupted.
        reason: of a failure; empty if it was interrupted.
        files: of the run's folder.
        machine: that worked.
        fingerprint: of the scene.
    """

    metrics: dict[str, Any] | None
    reason: str
    files: bytes
    machine: str = ""
    fingerprint: str = ""


def carry_out(order: Order, fetch_scene: Sequence[Callable[[], Scene]] = ()) -> Reply:
    """Do a run in a temporary folder.

    Args:
        order: the run.
        fetch_scene: gets the scene where it was shipped; nothing: it is found by path.
    """
    torch.set_num_threads(order.threads)
    spec = RunSpec.from_json(order.spec)
    if not _scenes:
        # One for the life of the worker process, because neighbouring runs share their scene.
        _scenes.append(Scenes(Path(tempfile.gettempdir()) / "gridreg-scenes"))
    with tempfile.TemporaryDirectory(prefix="gridreg-run-") as parent:
        folder = Path(parent) / "run"
        unpack_folder(order.files, folder)
        printed = io.StringIO()
        try:
            with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
                for module in order.modules:
                    importlib.import_module(module)
                for fetch in fetch_scene:
                    _scenes[0].put(spec, fetch())
                outcome = perform(spec, folder, _scenes[0], keep_checkpoint=order.keep_checkpoint)
        except Exception as error:
            _append_log(folder, printed.getvalue())
            return Reply(None, reason_of(error, folder), pack_folder(folder))
        _append_log(folder, printed.getvalue())
        return Reply(outcome.metrics, "", pack_folder(folder), outcome.machine, outcome.fingerprint)


def _append_log(folder: Path, text: str) -> None:
    with (folder / LOG_NAME).open("a", encoding="utf-8") as log:
        log.write(text)
