"""The parts of a report: findings, table cells, failures, and where the figures come from."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest
from markupsafe import escape

from gridreg.ablation.comparison import Section, compare
from gridreg.ablation.records import RunResult
from gridreg.ablation.report import findings, provenance, write_report
from gridreg.ablation.wipes import first_choice, wipe_data
from tests.ablation_results import NASTY, Results, done, failed, spec, study_of


def section(figures: dict[str, tuple[float, ...]]) -> Section:
    """One scene, a seed for each figure."""
    runs = [spec(label, seed=seed) for label, own in figures.items() for seed in range(len(own))]
    results = [done(run, psnr=figures[run.label][run.seed]) for run in runs]
    return compare(study_of(runs), results)[0]


def page_of(results: list[RunResult], folder: Path) -> str:
    study = study_of([result.spec for result in results])
    return write_report(Results(results), study, folder / "r.html").read_text()


def table_of(own: Section, folder: Path) -> str:
    """The table of a section on its page."""
    runs = [run for runs in own.results.values() for run in runs]
    (table,) = re.findall(r'<table class="sortable">.*?</table>', page_of(runs, folder), re.S)
    return str(table)


BASE = (25.0, 25.2, 24.9)


def test_findings_are_sorted_by_what_can_be_said() -> None:
    own = section(
        {
            "few_tensorf": BASE,
            "up": tuple(v + 1 + 0.01 * i for i, v in enumerate(BASE)),
            "down": tuple(v - 1 + 0.01 * i for i, v in enumerate(BASE)),
            "noise": (25.3, 25.0, 24.9),
            "single": (27.0,),
        }
    )
    assert findings(own) == {
        "better": ["up (+1.01 dB)"],
        "worse": ["down (−0.99 dB)"],
        "within noise": ["noise"],
        "cannot be told": ["single (one pair)"],
    }


def test_findings_that_many_rows_would_make_by_chance_are_no_findings() -> None:
    noise = {f"x{i}": (26.0, 24.2, 25.1) for i in range(15)}
    found = findings(section({"few_tensorf": BASE, "lucky": (25.5, 25.8, 25.3), **noise}))
    assert "better" not in found
    assert "lucky (a finding by itself, not among so many rows)" in found["within noise"]


def test_no_other_row_no_findings() -> None:
    assert findings(section({"few_tensorf": BASE})) == {}


def test_names_are_escaped_in_findings_and_tables(tmp_path: Path) -> None:
    own = section({"few_tensorf": BASE, NASTY: tuple(v + 1 for v in BASE)})
    text = page_of([run for runs in own.results.values() for run in runs], tmp_path)
    for part in (
        r'<ul class="findings">.*?</ul>',
        r'<table class="sortable">.*?</table>',
        r'class="forest".*?</p>',
    ):
        (found,) = re.findall(part, text, re.S)
        assert str(escape(NASTY)) in found, part
        assert NASTY not in found


def values_of(text: str) -> list[list[str]]:
    rows = re.findall(r"<tr.*?</tr>", text, re.S)[1:]
    return [re.findall(r'data-value="(.*?)"', row) for row in rows]


def test_cells_carry_full_figures_to_sort_by(tmp_path: Path) -> None:
    own = section({"few_tensorf": BASE, "up": tuple(v + 1 for v in BASE)})
    first, second = values_of(table_of(own, tmp_path))
    psnr = own.rows[1].metrics["psnr"].mean
    assert [float(second[1]), float(second[2])] == [psnr, pytest.approx(1.0)]
    assert float(first[2]) == 0.0
    assert (first[0], second[0]) == ("few_tensorf", "up")
    assert (first[5], second[5]) == ("3", "3")


def test_rows_without_result_sort_last(tmp_path: Path) -> None:
    runs = [spec("few_tensorf"), spec("missing")]
    page = write_report(Results([done(runs[0])]), study_of(runs), tmp_path / "r.html").read_text()
    (table,) = re.findall(r'<table class="sortable">.*?</table>', page, re.S)
    assert values_of(table)[1] == ["missing", "", "", "", "", "0"]
    assert "0 of 1" in table
    assert "no result" not in re.findall(r'class="notes">(.*?)<', table)


def test_headings_are_buttons_except_the_notes(tmp_path: Path) -> None:
    head = table_of(section({"few_tensorf": BASE}), tmp_path).split("</thead>")[0]
    assert head.count("<button") == 6
    assert head.count("<th") - head.count("<thead") == 7


def test_failures_name_run_and_reason(tmp_path: Path) -> None:
    text = page_of([failed(spec("tensorf", seed=4), "step 3: <nan>"), done(spec("few_tensorf"))], tmp_path)
    (part,) = re.findall(r'<section id="failures">.*?</section>', text, re.S)
    assert "step 3: &lt;nan&gt;" in part
    assert "lego, dietnerf8, quick vm, seed 4" in part
    assert "few_tensorf" not in part
    assert 'id="failures"' not in page_of([done(spec("few_tensorf"))], tmp_path)


def test_the_heat_map_colours_by_sign_and_size(tmp_path: Path) -> None:
    runs = [spec(label, scene) for label in ("few_tensorf", "tensorf") for scene in ("lego", "chair")]
    figures = {("tensorf", "lego"): 24.0, ("tensorf", "chair"): 26.5}
    text = page_of([done(r, psnr=figures.get((r.label, r.scene_name), 26.0)) for r in runs], tmp_path)
    cells = re.findall(r'<td class="(up|down)" style="--share:(\d+)%">(\S+)', text)
    assert cells == [("down", "55", "−2.00"), ("up", "14", "+0.50")]


def entries_of(results: list[RunResult]) -> dict[str, str]:
    return dict(provenance(study_of([result.spec for result in results]), results))


def test_provenance_tells_protocol_versions_and_machine() -> None:
    found = entries_of([done(spec("few_tensorf", seed=seed)) for seed in range(2)])
    assert found["protocol dietnerf8"] == (
        "background white; trained on 2 views: r_26 r_86; scored on 4 test views of each scene"
    )
    assert found["versions"] == "gridreg 0.1.0, torch 2.13.0"
    assert found["machine"] == "node-1, cpu A & B <CPU>, cores 2, threads 1"
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


def test_slider_begins_with_the_baseline_and_the_best() -> None:
    own = section(
        {"few_tensorf": BASE, "worse": tuple(v - 1 for v in BASE), "best": tuple(v + 1 for v in BASE)}
    )
    data = [{"images": [{"name": name} for name in ("target", "few_tensorf", "worse", "best")]}]
    assert first_choice(own, data) == ("few_tensorf", "best")
    assert first_choice(own, [{"images": [{"name": "target"}, {"name": "worse"}]}]) == ("target", "worse")
    # Runs whose folders hold no images have none to show.
    assert wipe_data([own], 10**6) == [[]]


OF_REPORT = [
    f"gridreg.ablation/{name}"
    for name in ("report.html", "report.css", "report.js", "tables.md", "tables.tex")
]
OF_RUN = [f"gridreg.export/{name}" for name in ("base.css", "head.html", "run.html", "run.css", "run.js")]


def page_file(place: str) -> str:
    package, name = place.split("/")
    return (files(package) / "page" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("place", [*OF_REPORT, *OF_RUN])
def test_parts_of_the_page_come_with_the_package(place: str) -> None:
    text = page_file(place)
    assert len(text) > 200
    assert not re.search(r"https?://", text)


def test_every_colour_exists_light_and_dark() -> None:
    text = "".join(page_file(place) for place in (*OF_REPORT, *OF_RUN) if place.endswith(".css"))
    light, dark = re.findall(r":root \{(.*?)\}", text, re.S)
    names = re.findall(r"(--[\w-]+):", light)
    assert names == re.findall(r"(--[\w-]+):", dark)
    used = set(re.findall(r"var\((--[\w-]+)\)", text)) - {"--at", "--tone", "--line", "--share"}
    assert used <= set(names)
