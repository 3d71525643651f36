"""The options of a training command, and the configuration they amount to."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from gridreg.errors import InputError
from gridreg.fields import import_modules
from gridreg.machine import DeviceName
from gridreg.training.config import assignments, from_yaml, override
from gridreg.training.files import one_writer
from gridreg.training.presets import load_preset, preset_names
from gridreg.training.settings import RunConfig

# In --help without "(default: None)": the text of each option says what holds without it.
_Folder = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")]
_File = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
_Name = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
_Number = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]

_MOST_STEPS, _MOST_THREADS = 10**9, 4096


@dataclass
class TrainOptions:
    """Reconstruct a scene from a few photographs with known cameras, score it and save it."""

    scene: _Folder = None
    """Scene folder (Blender, transforms.json, COLMAP, LLFF); without one, the built-in scene."""
    protocol: _Name = None
    """Views by name: dietnerf8 (default for Blender), holdout8 (default for one list), gs8, fewtensorf8, zerorf4,
    zerorf6, human8, human50, builtin8, views<N>, first<N>, spread<N>, human<N>, splatfields<N> ..."""
    size: _Number = None
    """Width of the images in pixels; must divide what is stored; default: the protocol's."""
    opaque: bool = False
    """Take images without alpha as opaque, also beside others that have it."""
    preset: str = "quick"
    """Field, schedule and regularizers by name: quick, best, best-long, human, tensorf, few_tensorf, few_tensorf_10k,
    few_tensorf_finetuned, cp, cp_quick, freenerf, freenerf_quick, fourierf, sanerf, few; `paper` is few_tensorf;
    `gridreg show presets` says what each is."""
    composition: _Name = None
    """Another composition of regularizers on the field and schedule: none, tensorf, few_tensorf, few_tensorf_printed,
    few_tensorf_fixed, few_tensorf_authors, freenerf, fourierf, sanerf; default: the preset's."""
    config: _File = None
    """YAML file whose values replace the preset's, such as the config.yaml of an earlier run."""
    backbone: _Name = None
    """Field by name: vm, cp, mlp, or one of yours; default: the preset's."""
    out: _Folder = None
    """Output folder; default: outputs/SCENE-PRESET, numbered if that holds a run."""
    resume: bool = False
    """Go on from the checkpoint in the output folder."""
    steps: _Number = None
    """Iterations; the schedule's events move in proportion; default: the preset's."""
    seed: _Number = None
    """Of every random number; default: 0."""
    threads: _Number = None
    """Processor threads; default: all cores. Results are the same for the same number."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE", help_behavior_hint="")] = ()
    """Any other value of the configuration, such as train.rays=2048; `gridreg show config` lists the keys."""
    mesh: bool = True
    """Write mesh.ply."""
    video: bool = True
    """Write turntable.mp4 (a forward-facing scene: spiral.mp4)."""
    view: bool = False
    """Show the field in the browser while it is trained (extra `viewer`)."""
    tensorboard: bool = False
    """Write the figures for TensorBoard as well, into tensorboard/ (extra `tensorboard`)."""
    host: str = "127.0.0.1"
    """Address that the viewer listens on; the default is reached from this machine only."""
    port: int = 8080
    """Port that the viewer listens on; 0: any free one."""


def configure(options: TrainOptions) -> RunConfig:
    """The configuration: preset, then the YAML file, then the command line.

    Raises:
        InputError: for unknown names and values out of range.
    """
    preset = "few_tensorf" if options.preset == "paper" else options.preset
    config = load_preset(preset)
    if options.config is not None:
        config = from_yaml(options.config, RunConfig, base=config)
    changes: dict[str, Any] = {}
    for name in ("protocol", "backbone", "seed", "composition", "size"):
        value = getattr(options, name)
        if value is not None:
            changes[name] = value
    if options.scene is not None:
        changes["scene"] = str(options.scene)
    if options.opaque:
        changes["opaque"] = True
    if options.backbone is not None and options.backbone != config.backbone:
        # The options of one field mean nothing to another, nor do the names of its sites.
        like = _preset_of(options.backbone, preset)
        changes["field"] = like.field if like else {}
        if like is not None:
            changes.setdefault("composition", like.composition)
    config = override(config, {**changes, **assignments(options.set)})
    import_modules(
        config.modules,
        str(options.config or "command line"),
        beside=None if options.config is None else options.config.parent,
    )
    if config.scene is not None:
        # Whoever looks at the run later may stand in another folder.
        config = replace(config, scene=os.path.abspath(config.scene))
    if options.steps is not None:
        if not 1 <= options.steps <= _MOST_STEPS:
            found = options.steps if abs(options.steps) < 1 << 63 else "a longer one"
            bound = "at least 1" if options.steps < 1 else f"at most {_MOST_STEPS:,}"
            raise InputError(f"--steps: found {found}, expected a number of {bound}")
        config = replace(config, train=config.train.scaled(options.steps))
    if options.threads is not None:
        if not 1 <= options.threads <= _MOST_THREADS:
            raise InputError(f"--threads: found {options.threads}, expected 1 to {_MOST_THREADS}")
        torch.set_num_threads(options.threads)
    return config


def _preset_of(backbone: str, like: str) -> RunConfig | None:
    """A preset made for a backbone: the one that goes with a preset (``cp_quick`` with ``quick``), else the first."""
    found = {name: load_preset(name) for name in preset_names()}
    names = [name for name in found if found[name].backbone == backbone]
    names.sort(key=lambda name: not name.endswith(f"_{like}"))
    return found[names[0]] if names else None


def _is_taken(folder: Path) -> bool:
    """Whether a folder holds a run, or one that has only begun."""
    if (folder / "checkpoint").exists() or not folder.is_dir():
        return folder.exists()
    try:
        with one_writer(folder):
            return False
    except InputError:
        return True


def output_folder(options: TrainOptions, config: RunConfig) -> Path:
    """Output folder of the run: as told, or a folder of its own below ``outputs``."""
    if options.out is not None:
        return options.out
    if options.resume:
        raise InputError("--resume: expected the run's folder with --out")
    scene = "builtin" if config.scene is None else Path(config.scene).resolve().name
    base = Path("outputs") / f"{scene}-{config.preset or 'run'}"
    number, found = 1, base
    while _is_taken(found):
        number += 1
        found = base.with_name(f"{base.name}-{number}")
    return found
