"""What stands in which table, and how it is written."""

from __future__ import annotations

import re

import numpy as np
import pytest

from gridreg.ablation.comparison import Section, compare, figure_of
from gridreg.ablation.tables import difference_text, duration, latex, markdown, mean_text, notes_of
from gridreg.errors import InputError
from tests.ablation_results import GAINS, NASTY, done, failed, psnr_of, spec, study_of

LABELS = ("few_tensorf", "tensorf", NASTY, "few_tensorf + RandomBackground")


def sections(*scenes: str, seeds: int = 3, labels: tuple[str, ...] = LABELS) -> list[Section]:
    runs = [spec(label, scene, seed) for label in labels for scene in scenes for seed in range(seeds)]
    return compare(study_of(runs), [done(run) for run in runs])


def test_rows_are_means_and_paired_differences() -> None:
    (section,) = sections("lego", "chair")
    rows = {row.label: row for row in section.rows}
    assert list(rows) == list(LABELS)
    cells = [(scene, seed) for scene in ("lego", "chair") for seed in range(3)]
    own = np.array([psnr_of(spec("tensorf", *cell)) for cell in cells])
    base = np.array([psnr_of(spec("few_tensorf", *cell)) for cell in cells])
    row = rows["tensorf"]
    assert row.metrics["psnr"].mean == pytest.approx(own.mean())
    assert row.difference is not None
    assert row.difference.estimate is not None
    assert row.difference.estimate.mean == pytest.approx((own - base).mean())
    assert row.difference.estimate.count == 6
    assert row.scenes["lego"].mean == pytest.approx(own[:3].mean())
    lego = row.scene_differences["lego"].estimate
    assert lego is not None
    assert (lego.mean, lego.count) == (pytest.approx((own - base)[:3].mean()), 3)
    assert row.seconds is not None
    assert row.seconds.mean == 371.0


def test_outcomes_tell_findings_from_noise() -> None:
    (section,) = sections("lego", "chair")
    assert [row.outcome for row in section.rows] == ["baseline", "lower", "higher", "within noise"]
    text = markdown("t", [section])
    assert "within noise" in text
    assert "**" not in text


def test_findings_that_do_not_survive_the_number_of_rows_are_marked() -> None:
    labels = ["few_tensorf", "a", *(f"x{i}" for i in range(12))]
    runs = [spec(label, seed=seed) for label in labels for seed in range(3)]
    gain = {"few_tensorf": (0, 0, 0), "a": (0.5, 0.6, 0.4)}
    results = [done(run, psnr=25 + gain.get(run.label, (-1, 1, 0.2))[run.seed]) for run in runs]
    (section,) = compare(study_of(runs), results)
    row = section.rows[1]
    assert row.difference is not None
    assert row.difference.verdict == "higher"
    assert row.adjusted_p is not None
    assert row.adjusted_p == pytest.approx(13 * (row.difference.p_value or 0))
    assert row.outcome == "higher, uncorrected"
    assert difference_text(row).endswith("△")


def test_one_pair_has_no_interval_and_says_so() -> None:
    (section,) = sections("lego", seeds=1)
    row = section.rows[1]
    assert row.outcome == "one pair"
    assert "[" not in difference_text(row)
    assert "±" not in mean_text(row.metrics["psnr"])
    assert "one pair" in notes_of(row)


def test_builtin_scene_has_tables_of_its_own() -> None:
    first, second = sections("builtin", "lego", "chair")
    assert [first.setting.builtin, second.setting.builtin] == [False, True]
    assert set(first.scenes) == {"lego", "chair"}
    assert second.scenes == ("builtin",)
    assert "not a published benchmark" in second.setting.title
    assert all(set(row.scenes) <= {"lego", "chair"} for row in first.rows)
    assert first.rows[0].metrics["psnr"].count == 6


def test_builtin_scene_is_known_by_its_record_where_it_is_given_as_a_folder() -> None:
    runs = [spec("few_tensorf", "own", seed, protocol="builtin8") for seed in range(2)]
    waiting = failed(runs[1], "died")
    (section,) = compare(study_of(runs), [done(runs[0], builtin=True), waiting])
    assert section.setting.builtin
    assert section.rows[0].failed == 1


def test_other_views_are_another_table() -> None:
    runs = [spec("few_tensorf", seed=s, views=v, protocol=f"views{v}") for v in (3, 10) for s in range(2)]
    found = compare(study_of(runs), [done(run) for run in runs])
    assert [section.setting.views for section in found] == [3, 10]
    assert all(section.rows[0].done == 2 for section in found)


def test_rows_of_another_backbone_have_their_own_baseline_or_none() -> None:
    runs = [spec(label, seed=s) for label in ("few_tensorf", "tensorf") for s in range(3)]
    runs += [spec("freenerf", seed=s, backbone="mlp", preset="freenerf") for s in range(3)]
    runs += [spec("tensorf", seed=s, backbone="cp") for s in range(3)]
    (section,) = compare(study_of(runs), [done(run) for run in runs])
    names = [row.name for row in section.rows]
    assert names == ["few_tensorf", "tensorf (quick, vm)", "freenerf", "tensorf (quick, cp)"]
    assert [row.outcome for row in section.rows] == ["baseline", "lower", "no pair", "no pair"]


def test_every_preset_of_a_study_has_its_own_baseline() -> None:
    runs = [
        spec(f"{label} [{preset}]", seed=s, preset=preset)
        for label in ("none", "tv")
        for preset in ("quick", "cp_quick")
        for s in range(3)
    ]
    (section,) = compare(study_of(runs, "none [quick]"), [done(run) for run in runs])
    assert [row.is_baseline for row in section.rows] == [True, True, False, False]
    assert [row.difference.estimate.count for row in section.rows[2:] if row.difference.estimate] == [3, 3]


def test_runs_that_use_alpha_are_flagged() -> None:
    (section,) = sections("lego")
    assert [row.uses_alpha for row in section.rows] == [True, False, False, False]
    flagged = [line for line in markdown("t", [section]).splitlines() if line.endswith("α |")]
    assert len(flagged) == 1
    assert flagged[0].startswith("| few\\_tensorf |")


def test_missing_and_failed_runs_are_counted() -> None:
    runs = [spec(label, seed=seed) for label in ("few_tensorf", "tensorf", "none") for seed in range(3)]
    results = [done(run) for run in runs[:5]] + [failed(runs[5], "died")]
    (section,) = compare(study_of(runs), results)
    counts = [(row.done, row.failed, row.expected) for row in section.rows]
    assert counts == [(3, 0, 3), (2, 1, 3), (0, 0, 3)]
    assert [row.outcome for row in section.rows] == ["baseline", "lower", "no result"]
    assert "2 of 3" in markdown("t", [section])
    assert "1 failed" in markdown("t", [section])


def test_a_study_without_results_gives_empty_rows() -> None:
    runs = [spec("few_tensorf"), spec("tensorf")]
    (section,) = compare(study_of(runs), [])
    assert [row.outcome for row in section.rows] == ["baseline", "no result"]
    assert markdown("t", [section]).count("–") >= 6


def test_two_runs_under_one_name_are_refused() -> None:
    one, other = spec("few_tensorf"), spec("few_tensorf", config={"train": {"carve": False}})
    with pytest.raises(InputError, match="two different runs are called 'few_tensorf"):
        compare(study_of([one]), [done(one), done(other)])


def test_what_is_not_finite_is_no_figure() -> None:
    run = spec("few_tensorf")
    record = done(run, mean={"psnr": "inf", "ssim_gaussian": 1.0})
    assert figure_of(record, "psnr") is None
    assert figure_of(record, "ssim_gaussian") == 1.0
    assert figure_of(record, "lpips") is None
    assert figure_of(failed(run, "x"), "psnr") is None


def cells(line: str) -> list[str]:
    """Cells of a Markdown row: at bars that no backslash stands before."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_markdown_is_rectangular_whatever_the_labels() -> None:
    text = markdown("An <example>", sections("lego", "chair"))
    tables = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(tables) == 2
    for table in tables:
        assert len({len(cells(line)) for line in table}) == 1
        assert len(table) == 2 + len(LABELS)
    assert "<b>" not in text
    assert "# An &lt;example&gt;" in text


def test_latex_is_balanced_whatever_the_labels() -> None:
    text = latex("An <example> & more", sections("lego", "chair"))
    assert text.count(r"\begin{table}") == text.count(r"\end{table}") == 2
    bare = re.sub(r"\\[\\{}$&#%_]", "", text)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    for block in re.findall(r"\\toprule\n(.*?)\\bottomrule", text, re.S):
        rows = [line for line in block.splitlines() if line.endswith(r"\\")]
        assert len({len(re.findall(r"(?<!\\)&", row)) for row in rows}) == 1
        assert len(rows) == 1 + len(LABELS)
    assert text.isascii(), sorted({c for c in text if not c.isascii()})
    assert r"\textbf" not in text


def test_figures_by_scene_are_full() -> None:
    builtin = [s for s in sections("builtin", "lego", "chair") if s.setting.builtin]
    assert [s.scenes for s in builtin] == [("builtin",)]
    (own,) = [s for s in sections("builtin", "lego", "chair") if not s.setting.builtin]
    assert tuple(row.label for row in own.rows) == LABELS
    assert set(LABELS) <= set(GAINS)
    tensorf = next(row for row in own.rows if row.label == "tensorf")
    assert tensorf.scenes["lego"].mean == np.mean([psnr_of(spec("tensorf", seed=s)) for s in range(3)])
    estimate = tensorf.scene_differences["lego"].estimate
    assert estimate is not None
    assert estimate.count == 3


@pytest.mark.parametrize(("seconds", "text"), [(0.04, "0.0 s"), (59.96, "1:00 min"), (3599.7, "1:00:00 h")])
def test_durations_carry_over(seconds: float, text: str) -> None:
    assert duration(seconds) == text
