"""Studies as YAML: which rows to compare, on which scenes, protocols or view counts, and seeds.

    title: What do the masks do?
    scenes: [lego, chair]           # below `data`, paths, or `builtin`; default: builtin
    data: ../data                   # default: the environment variable GRIDREG_DATA
    views: [3, 8]                   # or protocols: [dietnerf8]
    seeds: [0, 1, 2]
    presets: [quick]
    set: {train.rays: 512}          # any value of RunConfig, for every run
    baseline: none
    compositions:
      - none                                                   # by name, or `preset` for the preset's own
      - {name: quick, remove: [OcclusionLoss]}                 # changed
      - {label: own, regularizers: [{name: RandomBackground}]} # inline
      - {leave_one_out: quick}                                 # generators
      - {one_at_a_time: quick, on: none}

`gridreg.ablation.rows` holds the grammar of the rows.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import gridreg
from gridreg.ablation.own_command import words_of
from gridreg.ablation.records import RunSpec, Study
from gridreg.ablation.rows import StudyRow, expand_rows
from gridreg.ablation.study_file import StudyFile
from gridreg.errors import ConfigError
from gridreg.fields import field_names, import_modules, make_field
from gridreg.scenes.files import read_text
from gridreg.scenes.protocols import Every, Listed, Protocol, get_protocol
from gridreg.training.config import override
from gridreg.training.options import TrainOptions, configure
from gridreg.training.presets import load_preset
from gridreg.training.run import regularizers_of
from gridreg.training.settings import RunConfig
from gridreg.training.strict_yaml import parse_yaml
from gridreg.training.typed_data import from_data, to_data

DATA_VARIABLE = "GRIDREG_DATA"
BUILTIN_FRAMES = 18
_MOST_RUNS = 100_000
_EDGE = 8


def load_study(path: str | os.PathLike[str]) -> Study:
    """Read a study.

    Raises:
        InputError: one line that names file, line and key of what is wrong: unknown keys with the nearest valid one,
            unknown compositions, scenes, protocols, presets or fields, a study without runs.
    """
    file = Path(path)
    text = read_text(file, "study")
    return study_from_text(text, source=str(file), name=file.stem, folder=file.parent)


def study_from_text(
    text: str, *, source: str = "study", name: str = "study", folder: Path | None = None
) -> Study:
    """A study from its YAML text.

    Args:
        text: the YAML.
        source: names it in errors.
        name: used where the text gives none.
        folder: that ``data`` is relative to; default: the current one.

    Raises:
        InputError: as `load_study`.

    Example:
        >>> study = study_from_text("compositions: [none, tensorf]\\nseeds: [0, 1]")
        >>> [(run.label, run.seed) for run in study.runs]
        [('none', 0), ('none', 1), ('tensorf', 0), ('tensorf', 1)]
    """
    document = parse_yaml(text, source)
    file = from_data(StudyFile, document)
    import_modules(file.modules, source, beside=folder)

    rows: list[StudyRow] = []
    for index, entry in enumerate(file.compositions):
        with document.locating("compositions", index):
            rows += expand_rows(entry)
    with document.locating():
        scenes = [_scene_folder(scene, file, folder or Path()) for scene in file.scenes]
        _refuse_same_names(scenes)
        runs = tuple(_runs(file, rows, scenes))
    labels = list(dict.fromkeys(run.label for run in runs))
    with document.locating():
        baseline = _baseline(file, labels)
    study_name = file.name or re.sub(r"[^\w.-]+", "-", name)
    return Study(study_name, file.title or study_name, baseline, runs, text, tuple(file.modules))


def _runs(file: StudyFile, rows: Sequence[StudyRow], scenes: Sequence[Path | None]) -> list[RunSpec]:
    """Every run, row by row."""
    if len(rows) * len(scenes) * len(file.seeds) > _MOST_RUNS:
        raise ConfigError(
            ("compositions",), f"found {len(rows)} rows, expected a study of at most {_MOST_RUNS} runs"
        )
    runs: list[RunSpec] = []
    seen: dict[str, str] = {}
    fitting: set[str] = set()
    for row in rows:
        presets = [row.preset] if row.preset else file.presets
        for preset in presets:
            own = _backbone_of(preset, "compositions" if row.preset else "presets")
            backbones = [row.backbone] if row.backbone else (file.backbones or [own])
            for backbone in backbones:
                marks = [preset] * (len(presets) > 1) + [backbone] * (len(backbones) > 1)
                label = f"{row.label} [{', '.join(marks)}]" if marks else row.label
                config = _config(file, row, preset, backbone)
                content = str(to_data(config))
                if seen.setdefault(label, content) != content:
                    raise ConfigError(
                        ("compositions",), f"two rows are called {label!r}; give one another label"
                    )
                fit = str((config.backbone, config.field, config.composition))
                # A program of somebody's has a field of its own.
                if fit not in fitting and file.command is None:
                    fitting.add(fit)
                    check_fits(label, config)
                runs += _row_runs(file, label, config, scenes)
    unique = {(run.label, run.hash): run for run in runs}
    return list(unique.values())


def _row_runs(file: StudyFile, label: str, config: RunConfig, scenes: Sequence[Path | None]) -> list[RunSpec]:
    test = None if file.test is None else tuple(file.test)
    command = () if file.command is None else words_of(file.command)
    return [
        run_of(
            label,
            dataclasses.replace(
                config,
                scene=None if scene is None else str(scene),
                protocol=protocol.name,
                seed=seed,
                modules=tuple(file.modules),
            ),
            views=_view_count(protocol),
            size=file.size,
            test=test,
            command=command,
        )
        for scene in scenes
        for protocol in _protocols(file, scene)
        for seed in file.seeds
    ]


def run_of(label: str, config: RunConfig, *, views: int = 0, **others: Any) -> RunSpec:
    """The run of a configuration with scene and protocol; ``others`` as in `RunSpec`."""
    return RunSpec(
        label,
        config.scene,
        str(config.protocol),
        views,
        config.seed,
        config.preset,
        config.backbone,
        to_data(config),
        **others,
    )


def check_fits(label: str, config: RunConfig) -> None:
    """Attach the composition to a small field of this configuration, before hours of runs depend on it.

    Raises:
        ConfigError: with the name of the row, if it cannot be attached.
    """
    bounds, generator = torch.tensor([[-1.0] * 3, [1.0] * 3]), torch.Generator().manual_seed(0)
    try:
        field = make_field(config.backbone, bounds, (_EDGE,) * 3, generator=generator, **config.field)
        with gridreg.apply(field, *regularizers_of(config), total_steps=config.train.steps):
            pass
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(("compositions",), f"row {label!r} with preset {config.preset}: {error}") from error


def _backbone_of(preset: str, key: str) -> str:
    try:
        return load_preset(preset).backbone
    except ConfigError as error:
        raise ConfigError((key,), error.problem) from None


def _config(file: StudyFile, row: StudyRow, preset: str, backbone: str) -> RunConfig:
    """Preset, then field, composition, the study's values, the row's values, and the number of steps."""
    if backbone not in field_names():
        key = "compositions" if row.backbone else "backbones"
        raise ConfigError(
            (key,), f"found the backbone {backbone!r}, expected one of {', '.join(field_names())}"
        )
    config = configure(TrainOptions(preset=preset, backbone=backbone))
    config = dataclasses.replace(config, composition=row.composition(config.composition))
    for key, changes in (("set", file.set), ("compositions", row.set)):
        for fixed in ("scene", "protocol", "seed", "preset", "backbone"):
            if fixed in changes:
                raise ConfigError(
                    (key,), f"found {fixed!r}; expected the study's own key for it, not a value to set"
                )
        try:
            config = override(config, changes)
        except ConfigError as error:
            problem = error.problem if key == "set" else f"{error.problem} (row {row.label!r})"
            raise ConfigError((key, *error.path), problem) from None
    steps = row.steps or file.steps
    return config if steps is None else dataclasses.replace(config, train=config.train.scaled(steps))


def _protocols(file: StudyFile, scene: Path | None) -> list[Protocol]:
    if file.views is None:
        names = file.protocols or ["builtin8" if scene is None else "dietnerf8"]
        try:
            return [get_protocol(name) for name in names]
        except ConfigError as error:
            raise ConfigError(("protocols",), error.problem) from None
    if scene is None and max(file.views) > BUILTIN_FRAMES:
        raise ConfigError(
            ("views",),
            f"found {max(file.views)}, but the built-in scene has {BUILTIN_FRAMES} training frames; "
            "expected fewer, or scenes of your own",
        )
    # The built-in scene's frames are in an order made for taking the first ones.
    return [get_protocol(f"{'first' if scene is None else 'views'}{count}") for count in file.views]


def _view_count(protocol: Protocol) -> int:
    if isinstance(protocol.train, Every):
        return 0
    return len(protocol.train.indices) if isinstance(protocol.train, Listed) else protocol.train.count


def _scene_folder(name: str, file: StudyFile, folder: Path) -> Path | None:
    """The folder of a scene, or None for the built-in one."""
    if name == "builtin":
        return None
    # Unlike their like in pathlib, these functions take any name, however odd.
    data = folder / os.path.expanduser(file.data) if file.data else None
    if data is None and os.environ.get(DATA_VARIABLE):
        data = Path(os.environ[DATA_VARIABLE])
    places = [data / name] if data is not None else []
    if data is None or len(Path(name).parts) > 1:
        places += [folder / os.path.expanduser(name)]
    for place in places:
        if os.path.isdir(place):
            return place.resolve()
    hint = "" if data is not None else f"; the folder of scenes is given with data: or in {DATA_VARIABLE}"
    beside = places[0].parent
    near = sorted(p.name for p in beside.iterdir() if p.is_dir())[:20] if os.path.isdir(beside) else []
    known = f" there are {', '.join(near)}" if near else ""
    looked = " or ".join(str(place) for place in places)
    raise ConfigError(
        ("scenes",), f"found {name!r}, but there is no folder {looked}{hint};{known or ' expected a scene'}"
    )


def _refuse_same_names(scenes: Sequence[Path | None]) -> None:
    names = [scene.name for scene in scenes if scene is not None]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or "builtin" in names:
        raise ConfigError(
            ("scenes",), f"two folders are called {(twice or ['builtin'])[0]!r}; rename one, results go by it"
        )


def _baseline(file: StudyFile, labels: Sequence[str]) -> str:
    if file.baseline is None:
        return labels[0]
    fitting = [label for label in labels if label == file.baseline or label.startswith(f"{file.baseline} [")]
    if not fitting:
        raise ConfigError(
            ("baseline",), f"found {file.baseline!r}, expected one of the rows {', '.join(labels)}"
        )
    return fitting[0]
