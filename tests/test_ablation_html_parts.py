"""The text of a report: findings, table cells, failures, and where the figures come from."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest

from gridreg.ablation.comparison import Section, compare
from gridreg.ablation.html_parts import escaped, failures, findings, provenance, sortable_table, wipe
from gridreg.ablation.records import RunResult
from gridreg.ablation.wipes import wipe_data
from tests.ablation_results import NASTY, done, failed, spec, study_of


def section(figures: dict[str, tuple[float, ...]]) -> Section:
    """One scene, a seed for each figure."""
    runs = [spec(label, seed=seed) for label, own in figures.items() for seed in range(len(own))]
    results = [done(run, psnr=figures[run.label][run.seed]) for run in runs]
    return compare(study_of(runs), results)[0]


def lines_of(text: str) -> dict[str, str]:
    """Findings by their heading, without markup."""
    found = re.findall(r"<li class=\"\w+\"><b>(.*?)</b> (.*?)</li>", text)
    return {head: re.sub("<.*?>", "", body) for head, body in found}


BASE = (25.0, 25.2, 24.9)


def test_findings_are_sorted_by_what_can_be_said() -> None:
    text = findings(
        section(
            {
                "few_tensorf": BASE,
                "up": tuple(v + 1 + 0.01 * i for i, v in enumerate(BASE)),
                "down": tuple(v - 1 + 0.01 * i for i, v in enumerate(BASE)),
                "noise": (25.3, 25.0, 24.9),
                "single": (27.0,),
            }
        )
    )
    assert lines_of(text) == {
        "better": "up (+1.01 dB)",
        "worse": "down (−0.99 dB)",
        "within noise": "noise",
        "cannot be told": "single (one pair)",
    }


def test_findings_that_many_rows_would_make_by_chance_are_no_findings() -> None:
    noise = {f"x{i}": (26.0, 24.2, 25.1) for i in range(15)}
    lines = lines_of(findings(section({"few_tensorf": BASE, "lucky": (25.5, 25.8, 25.3), **noise})))
    assert "better" not in lines
    assert "lucky (a finding by itself, not among so many rows)" in lines["within noise"]


def test_no_other_row_no_findings() -> None:
    assert findings(section({"few_tensorf": BASE})) == ""


def test_names_are_escaped_in_findings_and_tables() -> None:
    own = section({"few_tensorf": BASE, NASTY: tuple(v + 1 for v in BASE)})
    for text in (findings(own), sortable_table(own)):
        assert escaped(NASTY) in text
        assert NASTY not in text


def values_of(text: str) -> list[list[str]]:
    rows = re.findall(r"<tr.*?</tr>", text, re.S)[1:]
    return [re.findall(r'data-value="(.*?)"', row) for row in rows]


def test_cells_carry_full_figures_to_sort_by() -> None:
    own = section({"few_tensorf": BASE, "up": tuple(v + 1 for v in BASE)})
    first, second = values_of(sortable_table(own))
    psnr = own.rows[1].metrics["psnr"].mean
    assert [float(second[1]), float(second[2])] == [psnr, pytest.approx(1.0)]
    assert float(first[2]) == 0.0
    assert (first[0], second[0]) == ("few_tensorf", "up")
    assert (first[5], second[5]) == ("3", "3")


def test_rows_without_result_sort_last() -> None:
    runs = [spec("few_tensorf"), spec("missing")]
    (own,) = compare(study_of(runs), [done(runs[0])])
    table = sortable_table(own)
    assert values_of(table)[1] == ["missing", "", "", "", "", "0"]
    assert "0 of 1" in table
    assert "no result" not in re.findall(r'class="notes">(.*?)<', table)


def test_headings_are_buttons_except_the_notes() -> None:
    head = sortable_table(section({"few_tensorf": BASE})).split("</thead>")[0]
    assert head.count("<button") == 6
    assert head.count("<th") - head.count("<thead") == 7


def test_failures_name_run_and_reason() -> None:
    text = failures(
        [failed(spec("tensorf", seed=4), "step 3: <nan>"), done(spec("none"))], ["a.jsonl: cannot & will not"]
    )
    assert "step 3: &lt;nan&gt;" in text
    assert "lego, dietnerf8, quick vm, seed 4" in text
    assert "a.jsonl: cannot &amp; will not" in text
    assert "none" not in text
    assert failures([done(spec("none"))], []) == ""
    assert "<table" not in failures([], ["a problem"])


def entries_of(results: list[RunResult]) -> dict[str, str]:
    text = provenance(study_of([result.spec for result in results]), results)
    return dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))


def test_provenance_tells_protocol_versions_and_machine() -> None:
    found = entries_of([done(spec("few_tensorf", seed=seed)) for seed in range(2)])
    assert found["protocol dietnerf8"] == (
        "background white; trained on 2 views: r_26 r_86; scored on 4 test views of each scene"
    )
    assert found["versions"] == "gridreg 0.1.0, torch 2.13.0"
    assert found["machine"] == "node-1, cpu A &amp; B &lt;CPU&gt;, cores 2, threads 1"
    assert found["runs"] == "2 finished, 11:00 min in all"
    assert found["psnr"].startswith("dB; mean over images")


def test_several_machines_and_versions_are_all_named() -> None:
    one, other = done(spec("few_tensorf")), done(spec("tensorf"))
    assert other.metrics is not None
    other.metrics["versions"] = {"gridreg": "0.2.0", "threads": 8}
    found = entries_of([one, other])
    assert found["versions 2"] == "gridreg 0.2.0"
    assert found["machine 2"] == "node-1, threads 8"


def test_a_protocol_that_is_not_known_here_is_said() -> None:
    found = entries_of([done(spec("few_tensorf", protocol="theirs"))])
    assert found["protocol theirs"].startswith("not known here; trained on 2 views")


def test_slider_begins_with_the_baseline_and_the_best(tmp_path: Path) -> None:
    own = section(
        {"few_tensorf": BASE, "worse": tuple(v - 1 for v in BASE), "best": tuple(v + 1 for v in BASE)}
    )
    data = [{"images": [{"name": name} for name in ("target", "few_tensorf", "worse", "best")]}]
    text = wipe(3, own, data)
    assert 'data-section="3" data-left="few_tensorf" data-right="best"' in text
    without = wipe(0, own, [{"images": [{"name": "target"}, {"name": "worse"}]}])
    assert 'data-left="target" data-right="worse"' in without
    assert wipe(0, own, []) == ""
    # Runs whose folders hold no pictures have none to show.
    assert wipe_data([own], 10**6) == [[]]


@pytest.mark.parametrize("name", ["report.html", "report.css", "report.js"])
def test_parts_of_the_page_come_with_the_package(name: str) -> None:
    text = (files("gridreg.ablation") / "page" / name).read_text(encoding="utf-8")
    assert len(text) > 500
    assert not re.search(r"https?://", text)


def test_every_colour_exists_light_and_dark() -> None:
    text = (files("gridreg.ablation") / "page" / "report.css").read_text(encoding="utf-8")
    light, dark = re.findall(r":root \{(.*?)\}", text, re.S)
    names = re.findall(r"(--[\w-]+):", light)
    assert names == re.findall(r"(--[\w-]+):", dark)
    used = set(re.findall(r"var\((--[\w-]+)\)", text)) - {"--at", "--tone", "--line", "--share"}
    assert used <= set(names)
