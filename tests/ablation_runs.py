"""Studies and results that cost little, for the tests of ablations."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from gridreg.ablation.records import RunSpec, Study
from gridreg.ablation.study import study_from_text

# Without pools and faint gradients: draws from the bits of numbers would make last digits of other processes larger.
TINY = """
size: 32
test: [0, 9]
set:
  train.steps: 6
  train.rays: 64
  train.voxels_start: 1000
  train.voxels_end: 3375
  train.resample_at: [3]
  train.occupancy_at: [2]
  train.occupancy_every: 0
  train.filter_rays_at: []
  train.occupancy_resolution: 12
  train.carve: false
  train.merge_weight: 0.0
  train.stochastic_rounding: 0.0
  field.width: 8
  field.density_components: 4
  field.appearance_components: 4
"""


def study_text(more: str = "", rows: str = "[none, tensorf]", seeds: str = "[0]") -> str:
    """A study of the built-in scene that takes a fraction of a second a run."""
    return f"{TINY}seeds: {seeds}\ncompositions: {rows}\n{textwrap.dedent(more)}"


def tiny_study(rows: str = "[none, tensorf]", seeds: str = "[0]", name: str = "tiny") -> Study:
    return study_from_text(study_text(rows=rows, seeds=seeds), name=name)


def spec(label: str = "none", seed: int = 0, **changes: Any) -> RunSpec:
    """A run that nobody has to do."""
    values: dict[str, Any] = {
        "label": label,
        "scene": None,
        "protocol": "builtin8",
        "views": 8,
        "seed": seed,
        "preset": "quick",
        "backbone": "vm",
        "config": {"composition": [{"name": label}], "seed": seed, "train": {"steps": 100}},
    }
    return RunSpec(**{**values, **changes})


def study_of(*runs: RunSpec, name: str = "study", baseline: str = "") -> Study:
    return Study(name, name.title(), baseline or runs[0].label, runs, "source: text\n")


def metrics(psnr: float = 20.0, train: float = 3.0) -> dict[str, Any]:
    """What a run leaves, in short."""
    return {
        "mean": {"psnr": psnr, "ssim_gaussian": 0.5},
        "images": {"r_0": {"psnr": psnr, "ssim_gaussian": 0.5}},
        "seconds": {"train": train, "test": 1.0},
        "steps": 100,
        "versions": {"threads": 1, "gridreg": "0", "torch": "2"},
    }


def write_study(folder: Path, more: str = "", **options: str) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(study_text(more, **options), encoding="utf-8")
    return path


def assert_same_numbers(found: dict[str, Any], expected: dict[str, Any], bound: float = 1e-3) -> None:
    """Metrics of images computed by different processes.

    Kernels that two processes compile at the same moment may round differently, so numbers across processes are equal
    up to ``bound`` (dB, or unitless) where nobody has compiled them before.
    """
    assert found.keys() == expected.keys()
    for key, value in found.items():
        if isinstance(value, dict):
            assert_same_numbers(value, expected[key], bound)
        else:
            assert abs(value - expected[key]) <= bound, (key, value, expected[key])
