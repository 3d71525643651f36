"""The keys of a study's YAML file."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import Any

from gridreg.errors import ConfigError


@dataclass(frozen=True)
class StudyFile:
    """The keys of a study's YAML file.

    Args:
        compositions: the rows, see `gridreg.ablation.rows`.
        name: in the store; default: the file's name without its ending.
        title: for people; default: the name.
        baseline: label of the row that others are compared with; default: the first row.
        scenes: names of folders below ``data``, paths, or ``builtin``.
        data: folder of the scenes, relative to the study's file; default: the environment variable GRIDREG_DATA.
        protocols: names, see `gridreg.scenes.PROTOCOLS`; default: ``dietnerf8``, for the built-in scene ``builtin8``.
        views: numbers of training views instead of protocols: ``views<N>``, for the built-in scene ``first<N>``.
        seeds: of every random number.
        presets: names; where there are several, rows are labelled with them.
        backbones: names; default: each preset's own.
        steps: iterations, events of the schedule in proportion; default: each preset's own.
        set: values of the configuration by dotted key, for every run.
        size: width of the images in pixels instead of the protocol's.
        test: indices into the test frames instead of the protocol's.
        command: a program that does each run, instead of gridreg: words with ``{seed}`` and the like in them.
        modules: Python modules that register regularizers, compositions or fields of one's own.
    """

    compositions: list[Any]
    name: str | None = None
    title: str | None = None
    baseline: str | None = None
    scenes: list[str] = dataclasses.field(default_factory=lambda: ["builtin"])
    data: str | None = None
    protocols: list[str] | None = None
    views: list[int] | None = None
    seeds: list[int] = dataclasses.field(default_factory=lambda: [0])
    presets: list[str] = dataclasses.field(default_factory=lambda: ["quick"])
    backbones: list[str] | None = None
    steps: int | None = None
    set: dict[str, Any] = dataclasses.field(default_factory=dict)
    size: int | None = None
    test: list[int] | None = None
    command: str | None = None
    modules: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        # It becomes the name of a folder.
        if self.name is not None and (
            self.name in ("", ".", "..") or not re.fullmatch(r"[^/\\]+", self.name)
        ):
            raise ConfigError(
                ("name",), f"found {self.name!r}, expected a name for a folder, without / or \\"
            )
        if self.name is not None and not self.name.isprintable():
            raise ConfigError(("name",), f"found {self.name!r}, expected a name that can be printed")
        for key in ("compositions", "scenes", "seeds", "presets", "protocols", "views", "backbones"):
            values = getattr(self, key)
            if values == []:
                raise ConfigError((key,), "found an empty list; a study without runs; expected at least one")
            if values is not None and key != "compositions" and len(set(values)) < len(values):
                raise ConfigError((key,), f"found {values}, expected each value once")
        if self.protocols is not None and self.views is not None:
            raise ConfigError(("views",), "found beside protocols; expected one of the two")
        for count in self.views or ():
            if count < 1:
                raise ConfigError(("views",), f"found {count}, expected numbers of training views from 1")
        for name, value in (("steps", self.steps), ("size", self.size)):
            if value is not None and value < 1:
                raise ConfigError((name,), f"found {value}, expected an integer of at least 1")
