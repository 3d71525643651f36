"""Plain records: the specification of a run, its result, and the study that asks for it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

NUMERICS_VERSION = 4
"""Raised by one whenever the same configuration gives other numbers, so that stored results are not mixed."""

Status = Literal["waiting", "running", "done", "failed"]
STATUSES: tuple[Status, ...] = ("waiting", "running", "done", "failed")

_BUILTIN = "builtin"

# Settings that came later, with the values that leave a run as it was before them.
_LATER = {"patches": 1, "patch_size": 8, "reshuffle": False}


@dataclass(frozen=True)
class RunSpec:
    """Everything that determines a run, and the name of the row it stands in.

    Args:
        label: name of the row in tables, such as ``few_tensorf`` or ``quick - TotalVariation``; two rows may ask for
            the same run.
        scene: the scene's folder; None for the built-in scene.
        protocol: which views are trained on and scored.
        views: number of training views; 0 where the scene alone knows it (every frame that is not held out).
        seed: of every random number.
        preset: where the configuration started from.
        backbone: name of the field.
        config: the whole `gridreg.training.RunConfig` as plain data, the composition spelled out.
        size: width of the images in pixels, instead of the protocol's.
        test: indices into the test frames, instead of the protocol's.
        command: words of a program that does the run, see `gridreg.ablation.own_command`; none: gridreg does.

    Example:
        >>> spec = RunSpec("none", None, "builtin8", 8, 0, "quick", "vm", {"composition": [], "seed": 0})
        >>> spec.scene_name, len(spec.hash)
        ('builtin', 16)
    """

    label: str
    scene: str | None
    protocol: str
    views: int
    seed: int
    preset: str
    backbone: str
    config: dict[str, Any] = field(hash=False)
    size: int | None = None
    test: tuple[int, ...] | None = None
    command: tuple[str, ...] = ()

    @property
    def scene_name(self) -> str:
        """The last part of the scene's path, or ``builtin``."""
        return _BUILTIN if self.scene is None else Path(self.scene).name

    @cached_property
    def hash(self) -> str:
        """16 hexadecimal digits of everything that determines the result.

        The scene goes in by its name, because it may lie elsewhere on another machine; the store compares the
        fingerprints of what was trained on. Names of row, preset and modules, and how often a checkpoint is written,
        stay out: they change nothing. So does the number of threads, which is recorded with the result, and settings
        that did not exist when stores were first written, at the values that leave a run as it was.
        """
        config = {
            key: value for key, value in self.config.items() if key not in ("scene", "preset", "modules")
        }
        if isinstance(config.get("train"), dict):
            config["train"] = {
                key: value
                for key, value in config["train"].items()
                if key != "checkpoint_minutes" and (key not in _LATER or value != _LATER[key])
            }
        content = {
            "numerics": NUMERICS_VERSION,
            "scene": self.scene_name,
            "protocol": self.protocol,
            "seed": self.seed,
            "backbone": self.backbone,
            "size": self.size,
            "test": None if self.test is None else list(self.test),
            "config": config,
        }
        if self.command:
            content["command"] = list(self.command)
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=True)
        return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]

    def to_json(self) -> dict[str, Any]:
        """Plain data for a database or a file."""
        return asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> RunSpec:
        """Undo `to_json`.

        Raises:
            InputError: if a key is missing or unknown, or a value of another type.
        """
        # Of training this takes one module, but importing it brings them all.
        from gridreg.training.typed_data import from_data

        return from_data(RunSpec, data, source="run")

    def describe(self) -> str:
        """The run in one line, for people.

        Example:
            >>> RunSpec("none", "scenes/lego", "dietnerf8", 8, 0, "quick", "vm", {}).describe()
            'none | lego | dietnerf8 | quick vm | seed 0'
        """
        parts = (
            self.label,
            self.scene_name,
            self.protocol,
            f"{self.preset} {self.backbone}",
            f"seed {self.seed}",
        )
        return " | ".join(parts)


@dataclass(frozen=True)
class RunResult:
    """A run and what is known of it.

    Args:
        spec: what determines it; its label is that of the study that was asked for.
        status: ``waiting``, ``running``, ``done`` or ``failed``.
        metrics: of a finished run, what `gridreg.training.execute` returned (``mean``, ``images``, ``seconds`` by
            phase, ``steps``, ``versions``, ...); None before.
        reason: of a failed run, one line.
        folder: holds ``test/*.png``, ``history.jsonl``, ``config.yaml``, ``checkpoint/``, ``result.json``.
        seconds: the run took, interruptions left out; 0 before it is finished.
        machine: that finished it.
        images: of test views by name, and of their targets by ``target:NAME``, where they are not in the folder.
    """

    spec: RunSpec
    status: Status
    metrics: dict[str, Any] | None
    reason: str
    folder: Path
    seconds: float
    machine: str
    images: Mapping[str, Path] = field(default_factory=dict)

    def history(self) -> list[dict[str, Any]]:
        """Rows of the run's curves, ``{"step": n, name: value, ...}``, masks under ``masks``; empty if there are none.

        Raises:
            InputError: if the file cannot be read.
        """
        path = self.folder / "history.jsonl"
        # Which draws curves too, and is slow to import.
        from gridreg.training.curves import History

        return History.load(path).rows if path.exists() else []


@dataclass(frozen=True)
class Study:
    """A question: rows to compare, on scenes, view counts and seeds.

    Args:
        name: its name in the store.
        title: for people.
        baseline: label of the row that the others are compared with.
        runs: every run, row by row; runs of two rows may be one and the same (equal ``hash``).
        source: the YAML text it was read from.
        modules: imported by whoever runs it, for regularizers and fields of one's own.
    """

    name: str
    title: str
    baseline: str
    runs: tuple[RunSpec, ...]
    source: str
    modules: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the rows, in the order of the study."""
        return tuple(dict.fromkeys(run.label for run in self.runs))
