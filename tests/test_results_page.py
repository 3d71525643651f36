"""The page of results is what the stored runs say, and its verdicts follow their rule."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gridreg.ablation.study import load_study
from tests.programs import ROOT, module_at

stored = module_at(ROOT / "benchmarks" / "stored.py")


@pytest.fixture(scope="module")
def results() -> ModuleType:
    return module_at(ROOT / "docs" / "make_results.py")


@pytest.fixture(scope="module")
def tables(results: ModuleType) -> ModuleType:
    return sys.modules["results_tables"]


def store(
    folder: Path, run: str, scene: str, seed: int, psnr: float, study: str = "quality", **more: Any
) -> None:
    """Store a run as `benchmarks/quality.py` does, as far as the page reads it."""
    record = {
        "scene": scene, "protocol": "dietnerf8", "run": run, "changes": [], "seed": seed, "uses_alpha": False,
        "mean": {"psnr": psnr, "ssim_gaussian": 0.9}, "seconds": {"train": 120.0}, "command": ["quality.py"],
        "versions": {"threads": 2}, **more,
    }  # fmt: skip
    count = len(stored.load(study, folder))
    stored.save(study, f"{scene}-{run}-seed{seed}-{count}", record, folder)


def test_the_page_is_up_to_date(results: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert results.main(["--check"]) == 0, capsys.readouterr().out


def test_figures_are_means_over_seeds_of_whole_runs(tables: ModuleType, tmp_path: Path) -> None:
    store(tmp_path, "tensorf", "lego", 0, 24.0)
    store(tmp_path, "tensorf", "lego", 1, 25.0)
    # Shortened and changed runs are others.
    shortened = ["quality.py", "--steps", "9"]
    store(tmp_path, "tensorf", "lego", 2, 10.0, command=shortened, steps=9)
    store(tmp_path, "tensorf", "lego", 2, 11.0, command=[*shortened, "--backend", "torch"], steps=9)
    store(tmp_path, "tensorf", "lego", 3, 10.0, changes=["train.rays=9"])
    runs = tables.Results(tmp_path)
    found = runs.mean("lego", "dietnerf8", "tensorf --steps 9", tables.psnr)
    assert (found.mean, found.count) == (10.0, 1)
    page = runs.few_shot("dietnerf8")
    row = next(line for line in page.splitlines() if line.startswith("| TensoRF |"))
    assert "| 24.50 ± 6.35 (2 seeds) | 23.83 | 0.900 | 2.0; 2 | – |" in row


def test_gains_are_paired(tables: ModuleType, tmp_path: Path) -> None:
    for seed, (few, plain) in enumerate([(26.0, 24.0), (27.0, 24.5)]):
        store(tmp_path, "few_tensorf", "lego", seed, few)
        store(tmp_path, "tensorf", "lego", seed, plain)
    store(tmp_path, "tensorf", "chair", 0, 99.0)
    found = tables.Results(tmp_path).gains_of(("lego", "chair"), "dietnerf8", "few_tensorf", "tensorf")
    assert found == {("lego", 0): 2.0, ("lego", 1): 2.5}
    store(tmp_path, "tensorf", "lego", 1, 30.0, protocol="views50")
    more = tables.Results(tmp_path)
    assert more.gains_of(("lego",), "views50", "tensorf", "tensorf", "dietnerf8") == {("lego", 1): 5.5}
    text = more.claims()
    assert "| +3.05 | +2.25 [−0.93, +5.43] (2) | in sign in every pair, too few to be sure |" in text


def test_targets_are_reached_by_the_mean_of_seeds(tables: ModuleType, tmp_path: Path) -> None:
    for seed, (lego, chair) in enumerate([(27.4, 29.9), (27.7, 30.0)]):
        store(tmp_path, "best", "lego", seed, lego)
        store(tmp_path, "best", "chair", seed, chair)
    text = tables.Results(tmp_path).targets()
    rows = [line for line in text.splitlines() if "`best`" in line]
    assert rows[0].startswith("| `best`, lego | 27.5 | 27.55 ±")
    assert rows[0].endswith("(2 seeds) | yes |")
    assert rows[1].startswith("| `best`, chair | 30.0 | 29.95 ±")
    assert rows[1].endswith("(2 seeds) | no |")
    assert "| `few_tensorf_finetuned`, lego | 25.7 | – | – |" in text


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        ([], "not measured"),
        ([1.0], "one pair: no verdict"),
        ([1.0, 1.1, 1.2], "holds"),
        ([0.8, 0.85, 0.9], "holds in sign, but is smaller"),
        ([0.2, 0.5, -0.3], "within noise, below the claim"),
        ([0.2, 0.6, -0.3], "within noise"),
        ([-1.0, -1.1, -1.2], "the opposite"),
        ([0.1, 3.0], "in sign in every pair, too few to be sure"),
        ([-0.1, -3.0], "the opposite in every pair, too few to be sure"),
    ],
)
def test_verdicts(tables: ModuleType, gains: list[float], said: str) -> None:
    assert tables.verdict(gains, 1.2) == said


def test_remedies_stand_by_what_their_pairs_say(tables: ModuleType, tmp_path: Path) -> None:
    head = tables.Results(tmp_path).remedies(True)
    assert len(head.splitlines()) == 2
    more = {"protocol": "dietnerf8-validation", "baseline": "best"}
    for scene, level, bare in (("lego", 29.0, 27.0), ("chair", 30.0, 29.5)):
        each = {"study": "best_each", "steps": 1600, **more}
        store(tmp_path, "best", scene, 0, level, label="best", **each)
        store(tmp_path, "best", scene, 1, bare, label="no carving", **each)
        store(tmp_path, "best", scene, 0, bare, label="no carving", **each)
        # One pair gains and one loses, so nothing is said to help.
        store(tmp_path, "best", scene, 0, 29.5, label="no L1", **each)
    store(tmp_path, "best", "lego", 0, 29.0, "best_more", label="best", steps=3000, **more)
    store(tmp_path, "best", "lego", 0, 28.25, "best_more", label="low-pass", steps=1000, **more)
    helped, others = (tables.Results(tmp_path).remedies(helped).splitlines()[2:] for helped in (True, False))
    assert helped == [
        "| visual hull of the alpha as a start | +1.25 (2; one seed) | +0.50 to +2.00 | yes | `best_each`, 1,600 |",
    ]
    assert others == [
        "| L1 of density | 0.00 (2; one seed) | −0.50 to +0.50 | yes | `best_each`, 1,600 |",
        "| low-pass | −0.75 (1; one seed) |  |  | `best_more`, 1,000 |",
    ]


def test_remedies_name_rows_of_shipped_studies(
    tables: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for scene in ("lego", "chair"):
        (tmp_path / "nerf_synthetic" / scene).mkdir(parents=True)
    monkeypatch.setenv("GRIDREG_DATA", str(tmp_path))
    listed = tables.ROWS["remedies"]
    assert len({remedy["name"] for remedy in listed}) == len(listed)
    for remedy in listed:
        assert set(remedy) <= {"name", "study", "row", "left_out", "kept"}
        study = load_study(ROOT / "examples" / "studies" / f"{remedy['study']}.yaml")
        assert remedy["row"] in study.labels
        assert remedy["row"] != study.baseline


def test_ensembles_stand_beside_their_members(tables: ModuleType, tmp_path: Path) -> None:
    members = [{"seed": seed, "mean": {"psnr": psnr}} for seed, psnr in ((0, 28.0), (2, 29.0))]
    store(tmp_path, "best", "lego", 0, 29.25, "ensembles", members=members)
    rows = tables.Results(tmp_path).ensembles().splitlines()[2:]
    assert rows == ["| `best`, lego | 28.00, 29.00 | 29.25 | +0.75 | 0.900 |"]


def test_the_readme_has_six_rows_with_published_figures(
    results: ModuleType, tables: ModuleType, tmp_path: Path
) -> None:
    store(tmp_path, "best", "chair", 0, 30.0)
    front = tables.Results(tmp_path).front()
    rows = front.splitlines()[2:]
    assert len(rows) <= 6
    assert "| `best` | – |  | – | 30.00 (one seed) |  | 2.0; 2 |" in rows
    assert "| `tensorf` | – | 23.83 | – | – | 23.45 | – |" in rows
    text = f"Before.\n{results.BEGIN}\nold\n{results.END}\nAfter.\n"
    renewed = results.between(text, f"\n{front}\n", results.BEGIN, results.END)
    assert renewed == f"Before.\n{results.BEGIN}\n{front}\n{results.END}\nAfter.\n"
    with pytest.raises(ValueError, match="found no table between"):
        results.between("Nothing.", front, results.BEGIN, results.END)


def test_gains_over_tensorf(tables: ModuleType, tmp_path: Path) -> None:
    for seed, (ours, plain) in enumerate([(28.0, 27.0), (29.0, 27.5)]):
        store(tmp_path, "best", "lego", seed, ours)
        store(tmp_path, "tensorf", "lego", seed, plain)
    store(tmp_path, "best", "lego", 2, 40.0)
    store(tmp_path, "human", "subject_b", 0, 32.0, protocol="human8")
    store(tmp_path, "tensorf", "subject_b", 0, 32.5, protocol="human8")
    rows = tables.Results(tmp_path).gains().splitlines()
    assert rows[0].startswith("| gain over `tensorf` (dB) | lego, `dietnerf8` | chair, `dietnerf8` |")
    assert rows[2:] == [
        "| `best` | +1.25 (2 seeds) | – | – | – | – | – |",
        "| `human` | – | – | – | – | – | −0.50 (one seed) |",
    ]


def test_times_by_processor(tables: ModuleType, tmp_path: Path) -> None:
    for number, (preset, cpu, scene, seconds) in enumerate(
        (
            ("best", "One", "lego", 231.6),
            ("best", "One", "chair", 197.2),
            ("best", "One", "lego", 90.0),
            ("best", "Other", "lego", 163.4),
            ("best-long", "One", "lego", 650.0),
        )
    ):
        record = {
            "scene": scene, "preset": preset, "versions": {"cpu": cpu}, "seconds": {"train": seconds},
            "command": "schedule", "seed": 0, "threads": 2, "arguments": {"set": [], "steps": None},
        }  # fmt: skip
        if cpu == "Other":
            record["stolen"] = 0.281
        stored.save("speed", str(number), record, tmp_path)
    # Shortened, changed, with one thread, or another command.
    for name, change in {
        "a": {"arguments": {"set": [], "steps": 9}}, "b": {"arguments": {"set": ["x=1"], "steps": None}},
        "c": {"threads": 1}, "d": {"command": "memory"},
    }.items():  # fmt: skip
        stored.save("speed", name, {**record, "seconds": {"train": 1.0}, **change}, tmp_path)
    assert tables.Results(tmp_path).times().splitlines()[2:] == [
        "| `best`, One | 90; 232 | 197 |",
        "| `best`, Other | 163 (28% stolen) | – |",
        "| `best-long`, One | 650 | – |",
    ]


def test_times_are_medians_over_seeds(tables: ModuleType, tmp_path: Path) -> None:
    for seed, (seconds, threads) in enumerate([(60.0, 2), (600.0, 1), (90.0, 1)]):
        store(tmp_path, "best", "lego", seed, 28.0, seconds={"train": seconds}, versions={"threads": threads})
    text = tables.Results(tmp_path).few_shot("dietnerf8")
    assert "| `best` | 28.00 ± 0.00 (3 seeds) |  | 0.900 | 1.5; 1/2 |" in text


def test_paths_are_compared_at_equal_steps_and_seeds(tables: ModuleType, tmp_path: Path) -> None:
    assert tables.Results(tmp_path).beside_plain() == "not measured"
    plain = ["quality.py", "--steps", "150", "--backend", "torch"]
    for seed, (slow, fast) in enumerate([(24.0, 24.5), (25.0, 24.5)]):
        store(tmp_path, "quick", "lego", seed, slow, steps=150, command=plain)
        store(tmp_path, "quick", "lego", seed, fast, steps=150, command=plain[:3])
    # Without a partner of as many steps.
    store(tmp_path, "quick", "lego", 0, 27.0, steps=1200)
    assert tables.Results(tmp_path).beside_plain() == "0.00 [−6.35, +6.35] dB (2 pairs)"


def test_gains_on_fields_of_others_are_paired_by_seed_and_image(tables: ModuleType, tmp_path: Path) -> None:
    foreign = sys.modules["results_foreign"]
    for seed, gain in enumerate((1.0, 2.0, 3.0)):
        record = {
            "scene": "lego",
            "field": "kplanes",
            "composition": "background+smooth:0.01",
            "split": "test",
            "seed": seed,
            "psnr": {"bare": [20.0, 22.0], "attached": [20.0 + 2 * gain, 22.0]},
            "step_seconds": {"bare": 0.1, "attached": 0.1 + 0.001 * seed},
        }
        stored.save("foreign", f"seed{seed}", record, tmp_path)
    stored.save("foreign", "cost", {"field": "kplanes", "split": "cost", "percent": 0.44}, tmp_path)
    rows = foreign.foreign(tmp_path).splitlines()[2:]
    words = "`ExpectedBackground` α, `TotalVariation` 0.01"
    # 2.484 is Student's t of two degrees of freedom at 97.5 %, by the root of three.
    assert rows == [
        f"| K-Planes | {words} | lego | 21.00 | +2.00 [−0.48, +4.48] (3 seeds) | 3 of 6 | +1 % |  |",
        "| **K-Planes** |  | together |  | +2.00 [−0.48, +4.48] (3 pairs) |  |  | +0.4 % |",
    ]
    assert "+2.00 [−0.48, +4.48] on K-Planes" in foreign.sentence(tmp_path)
