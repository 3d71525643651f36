"""The studies that are shipped: each loads, its rows are what they say, and their regularizers find their places."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

import gridreg
from gridreg.ablation.records import RunSpec, Study
from gridreg.ablation.study import load_study
from gridreg.fields import make_field

STUDIES = Path(__file__).parent.parent / "examples" / "studies"
PATHS = sorted(STUDIES.glob("*.yaml"))
SCENES = ("lego", "chair", "drums", "ficus", "mic", "ship", "materials", "hotdog")

ROWS = {
    "table1": [
        "tensorf", "none", "few_tensorf", "few_tensorf_printed", "few_tensorf_authors", "freenerf on VM", "fourierf",
        "sanerf", "few_tensorf_10k", "freenerf",
    ],
    "table2": ["tensorf", "few_tensorf", "few_tensorf_10k", "freenerf, 15k", "freenerf, 50k"],
    "table3": ["tensorf", "few_tensorf", "fixed ratio 0.8"],
    "figure3": ["tensorf", "few_tensorf"],
    "masks_by_site": ["no masks", "density", "appearance", "encodings", "all"],
    "end_of_schedule": ["no masks", *(f"masks, until={u}" for u in (0.1, 0.2, 0.5, 0.7, 0.9, 1.0))],
    "block_size": ["no masks", *(f"masks, block={b}" for b in (1, 3, 5, 8, 16))],
    "encoding_order": ["no masks", "octave by octave", "sines first", "coordinate by coordinate"],
    "occlusion_range": [
        "no occlusion loss", *(f"occlusion, samples={s}" for s in (5, 10, 20, 40)),
        "FreeNeRF's, weight 0.01, samples=20", "occlusion, distance=0.1", "occlusion, distance=0.3",
    ],
    "printed_mask": ["few_tensorf", "few_tensorf_printed", "few_tensorf_authors", "no masks"],
    "few_tensorf_pieces": ["neither", "masks alone", "occlusion loss alone", "both"],
    "best_pieces": [
        "all pieces and masks", "no masks", "no occlusion loss", "no L1", "no total variation", "no distortion",
        "no random background",
    ],
    "best_more": [
        "best", "total variation 0.008", "distortion 0.01", "occlusion loss 0.01", "low-pass", "24 and 72 components",
        "dropout", "initial opacity 0.5", "half the step", "to 200 cubed", "cheaper iterations",
        "cheaper, mean of the last fifth",
    ],
    "best_each": [
        "best", "no small pieces", "no distortion", "no occlusion loss", "no L1", "no mean of the last fifth",
        "pixels with replacement", "white background", "no total variation",
        "slower learning as in TensoRF", "no carving", "no pools and all gradients",
    ],
    "best_leave_one_out": [
        "best", "no distortion", "no occlusion loss", "no L1", "no L1 and no occlusion loss", "no total variation",
        "white background",
        "no carving", "no mean of the last fifth", "slower learning as in TensoRF",
    ],
    "finetuned_search": [
        "as it is", "no masks", "masks until 0.2", "masks on encodings alone", "total variation in every iteration",
        "total variation 0.002", "total variation 0.006", "total variation 0.002 and masks until 0.2",
    ],
    "finetuned_full": [
        "as it is", "masks until 0.5", "faster learning", "total variation 0.004", "no orthogonality",
        "random background",
        "random background and total variation 0.004", "random background and features alone in the network",
        "random background and carving", "random background, carving and total variation 0.004",
        "random background, carving and faster learning",
        "random background, carving and features alone in the network",
        "random background, carving, features alone in the network, masks until 0.2",
        "random background, carving, features alone in the network, no orthogonality",
    ],
    "best_views": [
        "best", "no direction", "direction without octaves", "features without octaves", "dropout of the direction",
        "no small pieces",
    ],
    "best_lean": [
        "best", "hidden layers of 64", "24 components of appearance",
        "hidden layers of 64 and 24 components of appearance", "pools of 0.05", "pools of 0.1",
    ],
    "best_others": [
        "best", "opacity entropy 0.001", "ray entropy 0.001", "weight decay 0.01",
        "later resampling", "earlier resampling", "rates are not reset", "spatial annealing",
        "twice as many rays in half as many iterations", "four octaves of the direction",
    ],
    "best_precision": ["float32", "bfloat16"],
    "best_draws": ["with replacement", "every pixel once"],
    "best_shorter": [
        "3,000 iterations", "2,300 iterations", "1,536 rays in 1,800 iterations", "2,048 rays in 1,600 iterations",
        "1,536 rays in 1,600 iterations",
    ],
    "best_faster": ["best", "hidden layers of 64", "steps of 1.5 cells"],
    "best_unseen": [
        "best", "depth smoothness 0.001", "depth smoothness as in RegNeRF", "divergence of neighbours",
        "space annealing", "gradients by distance",
    ],
    "few_pieces": [
        "few", "all gradients near cameras", "no smooth depth", "no occlusion loss", "occlusion loss 0.01",
        "total variation as in quick",
        "total variation 0.3", "sample space annealing",
    ],
    "best_components": ["best", "24 components of appearance"],
    "best_background": ["drawn backgrounds", "backgrounds in expectation"],
    "best_full": ["best", "distortion 0.01", "learning rate of grids 0.04", "total variation 0.006"],
    "best_opaque": [
        "best without alpha", "no occlusion loss", "no L1", "no distortion", "occlusion loss 0.01",
    ],
    "best_cells": [
        "best", "cells of 240", "cells of 320", "spherical harmonics", "rates fall to 0.3",
        "rates fall to 0.3 mean of the last half", "rates stay mean of the last half",
    ],
    "occlusion_near": [
        "none", "20 samples from the box", "0.625 from the near plane", "20 samples until the box shrinks",
    ],
    "human_search": [
        "best", "total variation 0.01", "total variation 0.04", "no distortion", "24 components to 200 cubed",
    ],
    "best_search": [
        "best", "learning rate falls to a hundredth", "distortion 0.01", "learning rate of grids 0.04", "L1 five times",
        "distortion 0.001", "no view dependence", "entropy of opacity", "learning rate constant", "initial opacity 0.5",
        "entropy along rays", "total variation 0.001", "half the step", "low-pass", "2048 rays", "grids decay",
        "72 components", "dropout", "annealed blur", "total variation 0.01",
    ],
    "best_rates": [
        "grids 0.02, network 0.001", "grids 0.04, network 0.001", "grids 0.08, network 0.001",
        "grids 0.04, network 0.003", "grids 0.04, distortion 0.01", "grids 0.06, network 0.002, distortion 0.003",
    ],
    "builtin_pieces": ["quick", "no masks", "no total variation", "no random backgrounds"],
    "smoke": ["no masks", "quick", "quick - RandomBackground"],
}  # fmt: skip


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folders of scenes; reading a study does not look into them."""
    for scene in SCENES:
        (tmp_path / "nerf_synthetic" / scene).mkdir(parents=True)
    for subject in ("subject_a", "subject_b"):
        (tmp_path / "human" / subject).mkdir(parents=True)
    (tmp_path / "real" / "fox").mkdir(parents=True)
    monkeypatch.setenv("GRIDREG_DATA", str(tmp_path))
    return tmp_path


def of(name: str) -> Study:
    return load_study(STUDIES / f"{name}.yaml")


def row(study: Study, label: str) -> RunSpec:
    return next(run for run in study.runs if run.label == label)


def masks(run: RunSpec) -> dict[str, Any]:
    """Frequency masks of a run by site."""
    found = [r for r in run.config["composition"] if r["name"] == "FrequencyMask"]
    return {r["site"] if isinstance(r["site"], str) else json.dumps(r["site"]): r for r in found}


def test_every_study_is_listed_here() -> None:
    assert {path.stem for path in PATHS} == set(ROWS)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_rows_and_runs(path: Path) -> None:
    study = load_study(path)
    assert list(study.labels) == ROWS[path.stem]
    assert study.baseline in study.labels
    assert study.title != study.name == path.stem
    # Every row is another run, and every row has the same number of them.
    assert len({run.hash for run in study.runs}) == len(study.runs)
    assert len({len([run for run in study.runs if run.label == label]) for label in study.labels}) == 1


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_regularizers_fit_the_field(path: Path) -> None:
    """Applied to a small field of the run's kind, so that no row dies at its first step."""
    done = set()
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    for run in load_study(path).runs:
        config = run.config
        key = json.dumps(
            [config[part] for part in ("backbone", "field", "composition", "train")], sort_keys=True
        )
        if key in done:
            continue
        done.add(key)
        generator = torch.Generator().manual_seed(0)
        field = make_field(config["backbone"], bounds, (8, 8, 8), generator=generator, **config["field"])
        regularizers = gridreg.from_config(config["composition"])
        with gridreg.apply(field, *regularizers, total_steps=config["train"]["steps"]) as handle:
            handle.step(config["train"]["steps"] // 10)
            assert len(handle.regularizers) == len(config["composition"])
    assert len(done) >= len(set(ROWS[path.stem])) - 2


def test_table_1_is_all_compositions_on_eight_views() -> None:
    study = of("table1")
    named = {run.label.removesuffix(" on VM") for run in study.runs}
    # The fixed masks are those of table 3.
    assert named - {"few_tensorf_10k"} == set(gridreg.composition_names()) - {"few_tensorf_fixed"}
    assert {run.scene_name for run in study.runs} == set(SCENES)
    assert {(run.protocol, run.views) for run in study.runs} == {("dietnerf8", 8)}
    assert len(study.runs) == 10 * 8 * 3
    assert (row(study, "freenerf").backbone, row(study, "freenerf on VM").backbone) == ("mlp", "vm")


def test_table_2_has_the_papers_numbers_of_iterations() -> None:
    steps = {run.label: run.config["train"]["steps"] for run in of("table2").runs}
    assert list(steps.values()) == [15_000, 15_000, 10_000, 15_000, 50_000]
    assert all(max(run.config["train"]["evaluate_at"]) < steps[run.label] for run in of("table2").runs)


def test_table_3_is_bodies_from_50_and_8_images() -> None:
    study = of("table3")
    assert {(run.scene_name, run.protocol, run.views) for run in study.runs} == {
        (f"subject_{letter}", f"human{views}", views) for letter in "ab" for views in (8, 50)
    }
    fixed = [r for r in row(study, "fixed ratio 0.8").config["composition"] if r["name"] == "FixedMask"]
    assert {r["site"] for r in fixed} == set(masks(row(study, "few_tensorf")))
    assert {r["visible_ratio"] for r in fixed} == {0.8}
    assert not masks(row(study, "fixed ratio 0.8"))


def test_figure_3_has_three_numbers_of_views() -> None:
    assert sorted({run.views for run in of("figure3").runs}) == [3, 10, 100]


def test_masks_by_site_differ_in_the_masks_alone() -> None:
    study = of("masks_by_site")
    encodings = {f"encoding.{part}" for part in ("features", "direction", "position")}
    expected = {
        "no masks": set(),
        "density": {"density"},
        "appearance": {"appearance"},
        "encodings": encodings,
        "all": {"density", "appearance", *encodings},
    }
    rest = []
    for label, sites in expected.items():
        run = row(study, label)
        assert set(masks(run)) == sites
        assert {mask["until"] for mask in masks(run).values()} <= {0.2}
        others = [r for r in run.config["composition"] if r["name"] != "FrequencyMask"]
        rest.append(json.dumps([sorted(others, key=json.dumps), run.config["train"], run.config["field"]]))
    assert len(set(rest)) == 1
    assert {(run.scene_name, run.seed) for run in study.runs} == {
        (s, n) for s in ("lego", "chair") for n in range(3)
    }
    assert {run.preset for run in study.runs} == {"quick"}
    assert len(study.runs) == 30


@pytest.mark.parametrize(
    ("name", "argument", "values"),
    [("end_of_schedule", "until", [0.1, 0.2, 0.5, 0.7, 0.9, 1.0]), ("block_size", "block", [1, 3, 5, 8, 16])],
)
def test_sweeps_set_their_argument(name: str, argument: str, values: list[float]) -> None:
    study = of(name)
    for value in values:
        found = masks(row(study, f"masks, {argument}={value}"))
        assert set(found) == {"density", "appearance"}
        assert {mask[argument] for mask in found.values()} == {value}


def test_occlusion_is_a_count_or_a_length() -> None:
    study = of("occlusion_range")
    for label in study.labels[1:]:
        (loss,) = [r for r in row(study, label).config["composition"] if r["name"] == "OcclusionLoss"]
        kind, _, value = label.rpartition("=")
        wanted = {"samples": None, "distance": None, kind.split()[-1]: float(value)}
        assert {key: loss[key] for key in wanted} == wanted
    assert not [r for r in row(study, study.baseline).config["composition"] if r["name"] == "OcclusionLoss"]


def test_orders_of_encodings_open_what_they_say() -> None:
    """Half-way, the mask of the direction's columns: low frequencies, or every sine, or some axes."""
    study = of("encoding_order")
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    opened = {}
    for label in study.labels[1:]:
        config = row(study, label).config
        field = make_field(
            "vm", bounds, (8, 8, 8), generator=torch.Generator().manual_seed(0), **config["field"]
        )
        handle = gridreg.apply(field, *gridreg.from_config(config["composition"]), total_steps=1000)
        handle.step(250)
        direction, position = handle.masks().values()
        # The columns of the first weight: 135 for the features, then direction and position.
        assert direction.shape == position.shape == (213,)
        assert (direction[:135] == 1).all()
        assert (direction[174:] == 1).all()
        assert (position[:174] == 1).all()
        assert torch.equal(direction[135:174], position[174:])
        opened[label] = position[174:]
    # x y z, then for each of 6 octaves three sines and three cosines.
    bands = opened["octave by octave"][3:].reshape(6, 2, 3)
    assert (bands[:3] == 1).all()
    assert (bands[4:] == 0).all()
    waves = opened["sines first"][3:].reshape(6, 2, 3)
    assert (waves[:, 0] == 1).all()
    assert (waves[1:, 1] == 0).all()
    axes = opened["coordinate by coordinate"].reshape(13, 3)
    assert (axes[:, :2] == 1).all()
    assert (axes[:, 2] == 0.5).all()


def test_printed_masks_are_a_variant_alone() -> None:
    study = of("printed_mask")
    variants = {label: {m["variant"] for m in masks(row(study, label)).values()} for label in study.labels}
    assert variants == {
        "few_tensorf": {"block"},
        "few_tensorf_printed": {"printed"},
        "few_tensorf_authors": {"authors"},
        "no masks": set(),
    }


def test_page_lists_the_studies() -> None:
    page = (STUDIES.parent.parent / "docs" / "ablation-report.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+)\.yaml` \|", page, re.M)) == set(ROWS)


def test_smoke_is_small_and_of_the_built_in_scene() -> None:
    study = of("smoke")
    assert {run.scene for run in study.runs} == {None}
    assert max(run.config["train"]["steps"] for run in study.runs) <= 100
    assert all(run.size == 40 for run in study.runs)
