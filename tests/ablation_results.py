"""Results of a study that nobody trained, with all the files of a run, for tests of tables and reports."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gridreg.ablation.records import RunResult, RunSpec, Study
from gridreg.rendering import Rendered
from gridreg.training.curves import History
from gridreg.training.evaluate import Scored
from gridreg.training.outputs import save_scored
from gridreg.training.record import metrics_record

NASTY = "masks <b>\"bold\"</b> & 'co' | $x_1$ \\ {y}"
GAINS = {
    "few_tensorf": 0.0,
    "tensorf": -1.2,
    NASTY: 0.45,
    "few_tensorf + RandomBackground": 0.03,
    "none": -2.6,
}
LEVELS = {"lego": 25.0, "chair": 27.5, "builtin": 31.0}
VIEWS = ("r_0", "r_8", "r_16", "r_24")


@dataclass
class Results:
    """Stands in for a store."""

    found: list[RunResult] = field(default_factory=list)

    def results(self, study: Study) -> list[RunResult]:
        """What is known of the study's runs."""
        return self.found


def spec(label: str, scene: str = "lego", seed: int = 0, **more: Any) -> RunSpec:
    """A run; ``builtin`` is the built-in scene."""
    own = scene == "builtin"
    values: dict[str, Any] = {
        "label": label,
        "scene": None if own else f"scenes/{scene}",
        "protocol": "builtin8" if own else "dietnerf8",
        "views": 8,
        "seed": seed,
        "preset": "quick",
        "backbone": "vm",
        "config": {"composition": label, "train": {"carve": label == "few_tensorf", "steps": 1200}},
    }
    return RunSpec(**{**values, **more})


def psnr_of(run: RunSpec) -> float:
    """A figure that scatters with the seed in the same way for all, and a little by itself."""
    own = np.random.default_rng([run.seed, len(run.label), len(run.scene_name)]).normal()
    level = LEVELS.get(run.scene_name, 24.0) + GAINS.get(run.label, 0.0)
    return level + 0.4 * math.cos(run.seed) + 0.1 * own


def done(run: RunSpec, folder: Path = Path("nowhere"), psnr: float | None = None, **more: Any) -> RunResult:
    """A finished run, without files."""
    level = psnr_of(run) if psnr is None else psnr
    views = {
        name: {"psnr": level + shift, "ssim_gaussian": 0.9 - 0.01 * shift, "ssim_uniform": 0.88}
        for name, shift in zip(VIEWS, (-0.5, 0.5, -0.2, 0.2), strict=True)
    }
    record = metrics_record(
        views,
        scene=run.scene_name,
        protocol=run.protocol,
        builtin=run.scene is None,
        seed=run.seed,
        steps=1200,
        seconds={"setup": 1.0, "train": 300.0 + 10 * len(run.label) + run.seed, "test": 20.0},
        config=run.config,
        train_views=["r_26", "r_86"],
        uses_alpha=bool(run.config["train"]["carve"]),
    )
    record["versions"] = {
        "gridreg": "0.1.0",
        "torch": "2.13.0",
        "cpu": "A & B <CPU>",
        "cores": 2,
        "threads": 1,
    }
    return RunResult(run, "done", {**record, **more}, "", folder, 330.0, "node-1")


def failed(run: RunSpec, reason: str) -> RunResult:
    """A run that came to nothing."""
    return RunResult(run, "failed", None, reason, Path("nowhere"), 0.0, "node-2")


def study_of(runs: Sequence[RunSpec], baseline: str = "few_tensorf", **more: Any) -> Study:
    """A study of these runs."""
    source = 'name: example\n# <script>alert("no")</script>\nrows: [few_tensorf, tensorf]\n'
    return replace(Study("example", "An <example> & more", baseline, tuple(runs), source), **more)


def write_files(result: RunResult, size: int = 48) -> None:
    """Renders, comparisons and history of a finished run, as training leaves them."""
    views = result.folder / "test"
    views.mkdir(parents=True)
    x = torch.linspace(0, 1, size)
    for number, name in enumerate(VIEWS):
        disc = ((x - 0.5) ** 2 + (x[:, None] - 0.3 - 0.1 * number) ** 2 < 0.06)[..., None]
        target = torch.where(disc, torch.tensor([0.9, 0.5, 0.1]), torch.tensor(1.0))
        shade = (
            torch.tensor([0.1, 0.5, 0.9]) if result.spec.label == "tensorf" else torch.tensor([0.8, 0.4, 0.2])
        )
        image = torch.where(disc, shade, torch.tensor(1.0))
        save_scored(views, Scored(name, Rendered(image, image[..., 0], image[..., 0]), target, {}))
    final = result.metrics["mean"]["psnr"] if result.metrics else 0.0
    save_history(result.folder / "history.jsonl", final, masked=result.spec.label not in ("tensorf", "none"))


def save_history(path: Path, final: float, *, masked: bool, looks: bool = True) -> None:
    """Curves that rise to the final value, and masks that open."""
    history = History()
    for step in range(60, 1201, 60):
        level = final - 9 * math.exp(-step / 250)
        history.add(step, {"psnr": level + 0.5 * math.sin(step), "loss": 0.01})
        if looks and step % 240 == 0:
            history.add(step, {"test_psnr": level, "seconds": step / 4.0})
        if masked:
            share = min(1.0, step / 900)
            history.add(step, masks={"density": opened(16, share), "encoding.<direction>": opened(12, share)})
    history.save(path)


def opened(channels: int, share: float) -> list[float]:
    """A mask of which a share is open."""
    return [min(1.0, max(0.0, share * channels - channel)) for channel in range(channels)]


def example(folder: Path, seeds: int = 3, labels: Mapping[str, float] = GAINS) -> tuple[Results, Study]:
    """A study with two published scenes and the built-in one, one failed run and one that is still to come."""
    runs = [
        spec(label, scene, seed)
        for label in labels
        for scene in ("lego", "chair", "builtin")
        for seed in range(seeds)
    ]
    found = [done(run, folder / f"run-{index}") for index, run in enumerate(runs)]
    for result in found:
        write_files(result)
    found[-1] = failed(runs[-1], "step 40: the loss is <nan> & no more")
    return Results(found[:-2] + found[-1:]), study_of(runs)
