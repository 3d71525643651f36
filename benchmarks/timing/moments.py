"""Named moments of a run: where it renames, writes and removes files, and the stages that it passes."""

from __future__ import annotations

import importlib
import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# What changes files, and which argument says which.
_SAVES = [
    ("os", "rename", 1),
    ("os", "replace", 1),
    ("os", "fsync", None),
    ("shutil", "rmtree", 0),
    ("pathlib", "Path.write_bytes", 0),
    ("pathlib", "Path.unlink", 0),
    ("safetensors.torch", "save_file", 1),
]
_STAGES = {
    "gridreg.training.execute": [
        ("build_trainer", "setup"),
        ("resume_trainer", "setup"),
        ("History.record", "iteration"),
        ("Execution.save", "save"),
        ("Execution._look", "look"),
        ("save_scored", "scored view"),
        ("save_contact_sheet", "contact sheet"),
        ("draw_curves", "curves"),
        ("draw_masks", "masks"),
        ("write_json", "metrics"),
    ],
    "gridreg.training.events": [
        ("OccupiedSpace.update", "occupancy"),
        ("OccupiedSpace.shrink", "shrinking"),
        ("OccupiedSpace.resample", "resampling"),
        ("OccupiedSpace.filter_rays", "filtering of rays"),
    ],
    "gridreg.export.runs": [("write_mesh", "mesh"), ("render_video", "video")],
    "gridreg.export.mesh_files": [("extract_mesh", "mesh cut"), ("save_mesh", "mesh file")],
    "gridreg.export.writers": [("_write_mp4", "video file"), ("_finish", "video end")],
    "gridreg.ablation.store": [
        ("Store.add", "study taken in"),
        ("Store.claim", "claim"),
        ("Store.finish", "result"),
        ("transitions.set_done", "result in its transaction"),
    ],
    "gridreg.ablation.report": [("write_report", "report")],
}


class Moments:
    """Counts the moments of this process inside one folder, and acts at one of them.

    Args:
        folder: output folder; other files do not count.
        note: file for the moments, ``kind<tab>name`` a line; None: nowhere.
        act_at: number of the moment to act at; None: never.
        signal_number: to send to this process then.
        wait_for: instead, say that the moment is there (``.reached``) and wait until this file exists.
    """

    def __init__(
        self,
        folder: Path,
        note: Path | None = None,
        act_at: int | None = None,
        signal_number: int = signal.SIGKILL,
        wait_for: Path | None = None,
    ) -> None:
        self.folder, self.note, self.act_at = folder, note, act_at
        self.signal_number, self.wait_for = signal_number, wait_for
        self.count = 0

    def at(self, kind: str, name: str, partly: Callable[[], Any] | None = None) -> None:
        """Pass a moment; ``partly`` does half of what comes, before a kill in its middle."""
        if self.note is not None:
            with self.note.open("a") as stream:
                stream.write(f"{kind}\t{name}\n")
        self.count += 1
        if self.act_at != self.count - 1:
            return
        if partly is not None:
            partly()
        if self.wait_for is None:
            os.kill(os.getpid(), self.signal_number)
            return
        self.wait_for.with_suffix(".reached").touch()
        while not self.wait_for.exists():
            time.sleep(0.05)

    def install(self) -> None:
        """Put itself into the functions of this process, which is to end with the run."""
        for module, name, place in _SAVES:
            self._wrap(module, name, lambda f, n=name, p=place: self._saving(f, n, p))
        for module, stages in _STAGES.items():
            for name, stage in stages:
                self._wrap(module, name, lambda f, s=stage: self._staged(f, s))

    def _wrap(self, module: str, name: str, wrapper: Callable[[Any], Any]) -> None:
        owner: Any = importlib.import_module(module)
        *path, last = name.split(".")
        for part in path:
            owner = getattr(owner, part)
        setattr(owner, last, wrapper(getattr(owner, last)))

    def _saving(self, function: Any, name: str, place: int | None) -> Any:
        def called(*arguments: Any, **options: Any) -> Any:
            if place is None:
                where = os.readlink(f"/proc/self/fd/{arguments[0]}")
            else:
                where = os.fspath(arguments[place])
            if not Path(where).is_relative_to(self.folder):
                return function(*arguments, **options)
            shown = f"{name.rpartition('.')[2]} {_family(Path(where))}"
            self.at("save", f"before {shown}")
            if name in ("Path.write_bytes", "save_file"):
                self.at("save", f"amid {shown}", lambda: _half(function, arguments, Path(where)))
            result = function(*arguments, **options)
            self.at("save", f"after {shown}")
            return result

        return called

    def _staged(self, function: Any, stage: str) -> Any:
        def called(*arguments: Any, **options: Any) -> Any:
            self.at("stage", stage)
            result = function(*arguments, **options)
            self.at("stage", f"after {stage}")
            return result

        return called


def _half(function: Any, arguments: tuple[Any, ...], path: Path) -> None:
    function(*arguments)
    os.truncate(path, path.stat().st_size // 2)


def _family(path: Path) -> str:
    """Name of a file without what differs between runs and views: tokens of temporary files, hashes, numbers."""
    parts = path.name.split(".")
    name = f".{parts[1]}.tmp.{parts[-1]}" if "tmp" in parts and len(parts) > 3 else path.name
    name = "HASH" if re.fullmatch("[0-9a-f]{16,}", name) else re.sub(r"\d+", "N", name)
    return f"{path.parent.name}/{name}" if path.parent.name in (".checkpoint.new", "test") else name
