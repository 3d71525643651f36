"""The page of results is what the stored runs say, and its verdicts follow their rule."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gridreg.ablation.study import load_study
from tests.programs import ROOT, module_at


@pytest.fixture(scope="module")
def results() -> ModuleType:
    return module_at(ROOT / "docs" / "make_results.py")


@pytest.fixture(scope="module")
def claimed(results: ModuleType) -> ModuleType:
    return module_at(ROOT / "docs" / "results_claims.py")


def store(folder: Path, run: str, scene: str, seed: int, psnr: float, **more: Any) -> None:
    """A run as `benchmarks/quality.py` leaves it, as far as the page reads it."""
    record = {
        "scene": scene, "protocol": "dietnerf8", "run": run, "changes": [], "seed": seed, "uses_alpha": False,
        "mean": {"psnr": psnr, "ssim_gaussian": 0.9}, "seconds": {"train": 120.0}, "command": ["quality.py"],
        "versions": {"threads": 2}, **more,
    }  # fmt: skip
    name = f"{scene}-{run.replace(':', '+')}-seed{seed}-{len(list(folder.iterdir()))}.json"
    (folder / name).write_text(json.dumps(record))


def test_the_page_is_up_to_date(results: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert results.main(["--check"]) == 0, capsys.readouterr().out


def test_figures_are_means_over_seeds_of_whole_runs(results: ModuleType, tmp_path: Path) -> None:
    store(tmp_path, "tensorf", "lego", 0, 24.0)
    store(tmp_path, "tensorf", "lego", 1, 25.0)
    # Shortened and changed runs are others.
    shortened = ["quality.py", "--steps", "9"]
    store(tmp_path, "tensorf", "lego", 2, 10.0, command=shortened, steps=9)
    store(tmp_path, "tensorf", "lego", 2, 11.0, command=[*shortened, "--backend", "torch"], steps=9)
    store(tmp_path, "tensorf", "lego", 3, 10.0, changes=["train.rays=9"])
    runs = results.Runs(tmp_path)
    found = runs.mean("lego", "dietnerf8", "tensorf --steps 9", results.psnr)
    assert (found.mean, found.count) == (10.0, 1)
    page = results.few_shot(runs, "dietnerf8")
    row = next(line for line in page.splitlines() if line.startswith("| TensoRF |"))
    assert "| 24.50 ± 6.35 (2) | 23.83 | 0.900 | 2.0; 2 | – |" in row


def test_gains_are_paired(results: ModuleType, tmp_path: Path) -> None:
    for seed, (few, plain) in enumerate([(26.0, 24.0), (27.0, 24.5)]):
        store(tmp_path, "few_tensorf", "lego", seed, few)
        store(tmp_path, "tensorf", "lego", seed, plain)
    store(tmp_path, "tensorf", "chair", 0, 99.0)
    found = results.Runs(tmp_path).gains(("lego", "chair"), "dietnerf8", "few_tensorf", "tensorf")
    assert found == [2.0, 2.5]
    store(tmp_path, "tensorf", "lego", 1, 30.0, protocol="views50")
    assert results.Runs(tmp_path).gains(("lego",), "views50", "tensorf", "tensorf", "dietnerf8") == [5.5]
    text = results.claims(results.Runs(tmp_path))
    assert "| +3.05 | +2.25 [−0.93, +5.43] (2) | in sign in every pair, too few to be sure |" in text


def test_targets_are_reached_by_the_mean_of_seeds(results: ModuleType, tmp_path: Path) -> None:
    for seed, (lego, chair) in enumerate([(27.4, 29.9), (27.7, 30.0)]):
        store(tmp_path, "best", "lego", seed, lego)
        store(tmp_path, "best", "chair", seed, chair)
    rows = [line for line in results.targets(results.Runs(tmp_path)).splitlines() if "`best`" in line]
    assert rows[0].startswith("| `best`, lego, dietnerf8 | 27.5 | 27.55 ±")
    assert rows[0].endswith("(2) | yes |")
    assert rows[1].startswith("| `best`, chair, dietnerf8 | 30.0 | 29.95 ±")
    assert rows[1].endswith("(2) | no |")
    assert "| `few_tensorf_finetuned`, lego, dietnerf8 | 25.7 | – | – |" in results.targets(
        results.Runs(tmp_path)
    )


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
def test_verdicts(claimed: ModuleType, gains: list[float], said: str) -> None:
    assert claimed.verdict(gains, 1.2) == said


def test_studies_are_compared_with_their_baseline(results: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "best_search"
    folder.mkdir()
    more = {"baseline": "best", "protocol": "dietnerf8-validation", "steps": 1000}
    for scene, level in (("lego", 27.0), ("chair", 29.0)):
        store(folder, "best", scene, 0, level, label="best", **more)
        store(folder, "worse", scene, 0, level - 0.5, label="worse", **more)
    store(folder, "better", "lego", 0, 27.25, label="better", **more)
    text = results.study_tables(tmp_path)
    assert "## Changes to `best`" in text
    rows = [line for line in text.splitlines() if line.startswith("| ")][2:]
    assert rows == [
        "| best | 29.00 (1) | 27.00 (1) |  |  |",
        "| better | – | 27.25 (1) | +0.25 | +0.25 to +0.25 |",
        "| worse | 28.50 (1) | 26.50 (1) | −0.50 | −0.50 to −0.50 |",
    ]


def test_remedies_are_told_by_what_their_rows_say(results: ModuleType, tmp_path: Path) -> None:
    assert results.remedies(tmp_path) == ""
    more = {"protocol": "dietnerf8-validation", "baseline": "best"}
    folder = tmp_path / "best_each"
    folder.mkdir()
    for scene, level, bare in (("lego", 29.0, 27.0), ("chair", 30.0, 29.5)):
        store(folder, "best", scene, 0, level, label="best", steps=1600, **more)
        store(folder, "best", scene, 1, bare, label="no carving", steps=1600, **more)
        store(folder, "best", scene, 0, bare, label="no carving", steps=1600, **more)
    folder = tmp_path / "best_more"
    folder.mkdir()
    store(folder, "best", "lego", 0, 29.0, label="best", steps=3000, **more)
    store(folder, "best", "lego", 0, 28.25, label="low-pass", steps=1000, **more)
    assert [line for line in results.remedies(tmp_path).splitlines() if line.startswith("| ")][2:] == [
        "| visual hull of the alpha as a start | +1.25 (2) | +0.50 to +2.00 | yes | `best_each`, 1,600 |",
        "| low-pass | −0.75 (1) |  |  | `best_more`, 1,000 |",
    ]


def test_remedies_name_rows_of_shipped_studies(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for scene in ("lego", "chair"):
        (tmp_path / "nerf_synthetic" / scene).mkdir(parents=True)
    monkeypatch.setenv("GRIDREG_DATA", str(tmp_path))
    listed = module_at(ROOT / "docs" / "results_remedies.py").ALL
    assert len({remedy.name for remedy in listed}) == len(listed)
    for remedy in listed:
        assert remedy.study in {name for name, _, _ in results.STUDIES}
        study = load_study(ROOT / "examples" / "studies" / f"{remedy.study}.yaml")
        assert remedy.row in study.labels
        assert remedy.row != study.baseline


def test_ensembles_stand_beside_their_members(results: ModuleType, tmp_path: Path) -> None:
    assert results.ensembles(tmp_path) == ""
    members = [{"seed": seed, "mean": {"psnr": psnr}} for seed, psnr in ((0, 28.0), (2, 29.0))]
    store(tmp_path, "best", "lego", 0, 29.25, members=members)
    rows = [line for line in results.ensembles(tmp_path).splitlines() if line.startswith("| `best`")]
    assert rows == ["| `best`, lego, dietnerf8 | 0, 2 | 28.00, 29.00 | 29.25 | +0.75 | 0.900 |"]


def test_the_readme_has_the_same_figures(results: ModuleType, tmp_path: Path) -> None:
    runs, joined = tmp_path / "runs", tmp_path / "joined"
    runs.mkdir()
    joined.mkdir()
    store(runs, "best", "chair", 0, 30.0)
    store(joined, "best", "chair", 0, 30.5, members=[{}, {}])
    text = results.front_table(results.Runs(runs), joined)
    assert "| `best`, 1,600 iterations of 1,536 rays | – | 30.00 (1) / 0.900 / 2.0; 2 |" in text
    assert "| `tensorf`, 15,000 iterations | – | – |" in text
    assert text.endswith("| 2 seeds of `best` joined | – | 30.50 / 0.900 |\n")
    told = f"Before.\n{results.BEGIN}\nold\n{results.END}\nAfter.\n"
    renewed = results.with_front(told, results.Runs(runs))
    assert renewed.startswith(f"Before.\n{results.BEGIN}\n| run |")
    assert renewed.endswith(f"|\n{results.END}\nAfter.\n")
    assert "old" not in renewed
    with pytest.raises(ValueError, match="found no table between"):
        results.with_front("Nothing.", results.Runs(runs))


def test_the_readme_has_gains_over_tensorf(results: ModuleType, tmp_path: Path) -> None:
    for seed, (ours, plain) in enumerate([(28.0, 27.0), (29.0, 27.5)]):
        store(tmp_path, "best", "lego", seed, ours)
        store(tmp_path, "tensorf", "lego", seed, plain)
    store(tmp_path, "best", "lego", 2, 40.0)
    store(tmp_path, "human", "subject_b", 0, 32.0, protocol="human8")
    store(tmp_path, "tensorf", "subject_b", 0, 32.5, protocol="human8")
    rows = results.front_gains(results.Runs(tmp_path)).splitlines()
    assert rows[0].startswith("| gain over `tensorf`, dB (pairs) | lego, `dietnerf8` | chair, `dietnerf8` |")
    assert rows[2:] == [
        "| `best` | +1.25 (2) | – | – | – | – | – |",
        "| `human` | – | – | – | – | – | −0.50 (1) |",
    ]


def test_the_readme_has_times_by_processor(results: ModuleType, tmp_path: Path) -> None:
    for name, cpu, scene, seconds in (
        ("schedule-lego-best-seed0-2threads", "One", "lego", 231.6),
        ("schedule-chair-best-seed0-2threads", "One", "chair", 197.2),
        ("schedule-lego-best-seed0-2threads-again", "One", "lego", 90.0),
        ("schedule-lego-best-seed0-2threads-other", "Other", "lego", 163.4),
        ("schedule-lego-best-long-seed0-2threads", "One", "lego", 650.0),
        ("schedule-lego-quick-seed0-2threads", "One", "lego", 50.0),
    ):
        record = {"scene": scene, "versions": {"cpu": cpu}, "seconds": {"train": seconds}}
        if cpu == "Other":
            record["stolen"] = 0.281
        (tmp_path / f"{name}.json").write_text(json.dumps(record))
    rows = results.front_times(tmp_path).splitlines()[2:]
    assert rows == [
        "| `best`, One | 90; 232 | 197 |",
        "| `best`, Other | 163 (28% stolen) | – |",
        "| `best-long`, One | 650 | – |",
    ]


def test_times_are_medians_over_seeds(results: ModuleType, tmp_path: Path) -> None:
    for seed, (seconds, threads) in enumerate([(60.0, 2), (600.0, 1), (90.0, 1)]):
        store(tmp_path, "best", "lego", seed, 28.0, seconds={"train": seconds}, versions={"threads": threads})
    text = results.few_shot(results.Runs(tmp_path), "dietnerf8")
    assert "| `best` | 28.00 ± 0.00 (3) |  | 0.900 | 1.5; 1/2 |" in text


def test_paths_are_compared_at_equal_steps_and_seeds(results: ModuleType, tmp_path: Path) -> None:
    assert results.beside_plain(tmp_path) == ""
    plain = ["quality.py", "--steps", "150", "--backend", "torch"]
    for seed, (slow, fast) in enumerate([(24.0, 24.5), (25.0, 24.5)]):
        store(tmp_path, "quick", "lego", seed, slow, steps=150, command=plain)
        store(tmp_path, "quick", "lego", seed, fast, steps=150, command=plain[:3])
    # Without a partner of as many steps.
    store(tmp_path, "quick", "lego", 0, 27.0, steps=1200)
    text = results.beside_plain(tmp_path)
    assert "Mean difference: 0.00 [−6.35, +6.35] dB." in text
    rows = [line for line in text.splitlines() if line.startswith("| `quick`")]
    assert rows == [
        "| `quick`, lego, dietnerf8, 150 iterations | 0 | 24.00 | 24.50 | +0.50 | 120 | 120 |",
        "| `quick`, lego, dietnerf8, 150 iterations | 1 | 25.00 | 24.50 | −0.50 | 120 | 120 |",
    ]
