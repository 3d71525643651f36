"""Charts: names that do not overlap, places that mean what they say, colours of the reader's preference."""

from __future__ import annotations

import io
import re
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gridreg.ablation.charts import curves, over_views, styles
from gridreg.ablation.comparison import Section, compare
from gridreg.ablation.forest_plot import forest_plot, heat_map
from gridreg.ablation.mask_images import colour_scale, mask_schedules
from gridreg.ablation.records import RunResult
from gridreg.export.html import encode
from gridreg.export.line_chart import Series, _end_labels, line_chart
from tests.ablation_results import done, opened, spec, study_of
from tests.test_ablation_report import decoded

GREY, BLUE = (0, 0), (1, 0)


@given(st.lists(st.floats(0, 30), min_size=1, max_size=12))
def test_names_keep_their_distance_and_order(ends: list[float]) -> None:
    series = [Series(str(number), GREY, [(0.0, end)]) for number, end in enumerate(ends)]
    found = _end_labels(series, 0.0, 30.0, 220.0)
    assert sorted(number for number, _ in found) == list(range(len(ends)))
    assert [ends[number] for number, _ in found] == sorted(ends)
    places = [place for _, place in found]
    assert all(b - a >= 14.0 - 1e-9 for a, b in pairwise(places))
    assert all(place <= 220.0 for place in places)


def test_names_with_room_stay_where_their_lines_end() -> None:
    series = [Series(str(end), GREY, [(0.0, 0.0), (1.0, end)]) for end in (10.0, 2.0, 5.0)]
    assert _end_labels(series, 0.0, 10.0, 100.0) == [(1, 20.0), (2, 50.0), (0, 100.0)]


def test_rows_are_told_by_colour_then_by_dash() -> None:
    runs = [spec("few_tensorf"), *(spec(f"x{index}") for index in range(18))]
    (own,) = compare(study_of(runs), [])
    found = list(styles(own.rows).values())
    assert found[0] == GREY
    assert len(set(found)) == 19
    assert {dash for _, dash in found[:7]} == {0}
    assert all(1 <= hue <= 6 for hue, _ in found[1:])


def chart_of(series: list[Series], **more: object) -> ElementTree.Element:
    text = line_chart("t", series, x_label="x", y_label="y", **more)  # type: ignore[arg-type]
    return parsed(text)


def parsed(text: str) -> ElementTree.Element:
    # A page of HTML knows the prefix.
    return ElementTree.fromstring(
        str(text).replace("<svg ", '<svg xmlns:xlink="x" ', 1).replace("xlink:href", "href")
    )


def groups_of(chart: ElementTree.Element, name: str) -> list[ElementTree.Element]:
    return [group for group in chart.iter("g") if group.attrib.get("data-series") == name]


def path_of(chart: ElementTree.Element, name: str = "a") -> np.ndarray:
    """Points of a line, pixels."""
    lines = [group.find("path") for group in groups_of(chart, name)]
    (line,) = [line for line in lines if line is not None]
    return np.array(re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", line.attrib["d"]), dtype=float)


def dots_of(chart: ElementTree.Element, name: str = "a") -> np.ndarray:
    uses = [use for group in groups_of(chart, name) for use in group.iter("use")]
    return np.array([[float(use.attrib["x"]), float(use.attrib["y"])] for use in uses]).reshape(-1, 2)


def texts_of(chart: ElementTree.Element) -> dict[str, ElementTree.Element]:
    return {str(text.text): text for text in chart.iter("text")}


def scale_of(chart: ElementTree.Element, axis: str, anchor: str) -> dict[float, float]:
    """Places of the ticks along an axis, by their numbers."""
    return {
        float(text): float(element.attrib[axis])
        for text, element in texts_of(chart).items()
        if f"text-anchor: {anchor}" in element.attrib["style"] and re.fullmatch(r"[\d.]+", text)
    }


def test_points_stand_where_their_numbers_are() -> None:
    chart = chart_of([Series("a", BLUE, [(0.0, 20.0), (50.0, 24.0), (100.0, 26.0)])])
    path = path_of(chart)
    for column, (axis, anchor), values in (
        (0, ("x", "middle"), (0, 50, 100)),
        (1, ("y", "end"), (20, 24, 26)),
    ):
        scale = scale_of(chart, axis, anchor)
        slope, place = np.polyfit(list(scale), list(scale.values()), 1)
        # Texts stand a little below the middle of their line.
        shift = 4.6 if axis == "y" else 0.0
        assert path[:, column] == pytest.approx(slope * np.array(values) + place - shift, abs=0.3)
        assert (slope > 0) == (axis == "x")
        assert np.allclose(np.asarray(list(scale)) / 10, np.round(np.asarray(list(scale)) / 10, 1))


def test_a_logarithmic_axis_spaces_ratios_evenly() -> None:
    chart = chart_of([Series("a", BLUE, [(1.0, 20.0), (10.0, 24.0), (100.0, 26.0)])], x_ticks=(1, 10, 100))
    assert np.diff(path_of(chart)[:, 0], n=2) == pytest.approx(0, abs=0.05)
    assert set(scale_of(chart, "x", "middle")) == {1, 10, 100}


def test_far_below_the_best_is_cut_off() -> None:
    line = Series("a", BLUE, [(0.0, -50.0), (1.0, 25.0)], [(0.5, -50.0), (1.0, 25.0)])
    chart = chart_of([line], y_span=10.0)
    assert len(dots_of(chart)) == 1
    # The line leaves through the frame, which clips it.
    assert path_of(chart)[0, 1] > 260
    clipped = groups_of(chart, "a")[0].find("path")
    assert clipped is not None
    assert clipped.attrib["clip-path"].startswith("url(#")
    assert all(float(text.attrib["y"]) < 268 for text in chart.iter("text"))


def test_a_chart_of_nothing_is_nothing() -> None:
    assert line_chart("t", [], x_label="x", y_label="y") == ""
    assert line_chart("t", [Series("a", BLUE, [])], x_label="x", y_label="y") == ""


def test_one_point_is_a_dot_without_a_line() -> None:
    chart = chart_of([Series("a", BLUE, [(3.0, 20.0)], [(3.0, 20.0)])])
    assert all(group.find("path") is None for group in groups_of(chart, "a"))
    assert len(dots_of(chart)) == 2


def test_many_lines_make_a_taller_chart_and_long_names_are_cut() -> None:
    names = [f"a composition with a long name {i}" for i in range(30)]
    chart = chart_of([Series(name, BLUE, [(0.0, 20.0), (1.0, 20.0)]) for name in names])
    labels = [
        text for group in chart.iter("g") if "data-series" in group.attrib for text in group.iter("text")
    ]
    places = sorted(float(label.attrib["y"]) for label in labels)
    assert len(places) == 30
    assert min(np.diff(places)) >= 13.9
    assert all(len(str(label.text)) <= 20 for label in labels)
    # The whole name is the tooltip.
    assert {title.text for title in chart.iter("title")} == set(names)


def test_names_are_text_whatever_stands_in_them() -> None:
    name = "<b> & $x_1$ 0.255123"
    chart = chart_of([Series(name, BLUE, [(0.0, 20.0), (1.0, 20.0)])])
    assert name in texts_of(chart)
    assert len(path_of(chart, name)) == 2


def test_charts_are_slim_and_follow_the_style_of_the_page() -> None:
    series = [Series("a", GREY, [(0.0, 20.0), (1.0, 21.0)]), Series("b", (2, 1), [(0.0, 20.0), (1.0, 22.0)])]
    text = line_chart("t", series, x_label="x", y_label="y")
    assert text == line_chart("t", series, x_label="x", y_label="y")
    assert not re.search(r"#[0-9a-fA-F]{6}[;\"]|https?:|<metadata|<style|font-family", text)
    assert {"var(--s0)", "var(--s2)", "var(--soft)", "var(--rule)"} <= set(re.findall(r"var\(--\w+\)", text))
    assert "stroke-dasharray" in text
    assert len(text) < 5000


def section(seeds: int = 3, scenes: tuple[str, ...] = ("lego", "chair")) -> Section:
    runs = [spec(label, s, n) for label in ("few_tensorf", "tensorf") for s in scenes for n in range(seeds)]
    return compare(study_of(runs), [done(run, Path(f"run{i}")) for i, run in enumerate(runs)])[0]


def rising(result: RunResult) -> list[dict[str, object]]:
    """A history whose looks come later with every seed."""
    shift = 10.0 * result.spec.seed
    return [
        {"step": 100, "psnr": 15.0, "test_psnr": 18.0 + result.spec.seed, "seconds": 20.0 + shift},
        {"step": 200, "psnr": 17.0},
        {"step": 200, "test_psnr": 22.0 + result.spec.seed, "seconds": 40.0 + shift},
        {"step": 300, "test_psnr": "inf", "seconds": 60.0},
    ]


def test_curves_are_means_over_seeds() -> None:
    found = curves(section(), rising)
    assert found is not None
    assert [scene for scene, _ in found["charts"]] == ["lego", "chair"]
    chart = parsed(found["charts"][0][1])
    path, scale = path_of(chart, "few_tensorf"), scale_of(chart, "x", "middle")
    slope, place = np.polyfit(list(scale), list(scale.values()), 1)
    # Seeds 0, 1, 2 look at 20, 30, 40 s: their mean is 30 s.
    assert (path[:, 0] - place) / slope == pytest.approx([30, 50], abs=0.5)
    # Its runs take 411 s on average.
    assert (dots_of(chart, "few_tensorf")[0, 0] - place) / slope == pytest.approx(411, abs=2)
    assert found["held_out"]
    assert found["y_label"] == "held-out PSNR (dB)"


def test_curves_without_histories_show_nothing() -> None:
    assert curves(section(), lambda result: []) is None


def test_the_forest_has_a_row_for_each_comparison() -> None:
    forest = forest_plot(section())
    assert forest is not None
    (row,) = forest.rows
    assert row.difference is not None
    assert row.difference.estimate is not None
    found = row.difference.estimate
    places = [forest.across(value) for value in row.difference.pairs.values()]
    assert len(places) == 6
    assert forest.across(found.mean) == pytest.approx(np.mean(places), abs=0.02)
    assert 0 < forest.across(found.low) < forest.across(found.mean) < forest.across(found.high)
    assert forest.across(found.high) < forest.across(0) < 100
    assert len(forest.ticks) >= 2
    assert np.diff(forest.ticks) == pytest.approx(forest.ticks[1] - forest.ticks[0])
    # What lies beyond is at the end.
    assert (forest.across(-1e3), forest.across(1e3)) == (0, 100)


def test_a_forest_without_pairs_is_nothing() -> None:
    runs = [spec("few_tensorf"), spec("tensorf", preset="other")]
    (own,) = compare(study_of(runs), [done(run) for run in runs])
    assert forest_plot(own) is None
    assert heat_map(own)[0] == []


def test_the_heat_map_has_rows_where_there_are_several_scenes() -> None:
    rows, largest = heat_map(section())
    assert [row.label for row in rows] == ["few_tensorf", "tensorf"]
    estimates = [d.estimate for d in rows[1].scene_differences.values()]
    assert largest == max(abs(e.mean) for e in estimates if e is not None)
    assert heat_map(section(scenes=("lego",)))[0] == []


def test_masks_are_images_of_channels_over_iterations() -> None:
    (own,) = [section(seeds=1, scenes=("lego",))]
    runs = [run for runs in own.results.values() for run in runs]
    rows = [{"step": step, "masks": {"density": opened(8, step / 100)}} for step in (0, 50, 100)]
    (group,) = mask_schedules(runs, lambda result: rows)
    # Both compositions have the same masks.
    assert group["labels"] == ["few_tensorf", "tensorf"]
    (site,) = group["sites"]
    assert (site["site"], site["channels"], site["step"]) == ("density", 8, 100)
    image = decoded(site["src"])
    assert image.shape == (8, 3, 3)
    # Channel 0 is the lowest line; half-way the lower half is open, in the end everything.
    scale = decoded(colour_scale())
    closed, full = scale[0, 0], scale[0, -1]
    assert np.array_equal(image[:, 0], np.tile(closed, (8, 1)))
    assert np.array_equal(image[4:, 1], np.tile(full, (4, 1)))
    assert np.array_equal(image[:4, 1], np.tile(closed, (4, 1)))
    assert np.array_equal(image[:, 2], np.tile(full, (8, 1)))
    assert mask_schedules(runs, lambda result: []) == []


def test_views_of_one_number_make_no_chart() -> None:
    assert over_views([section()]) == []


def test_rows_keep_their_style_and_the_baseline_is_grey() -> None:
    assert styles(section().rows) == {"few_tensorf": GREY, "tensorf": BLUE}


def test_pictures_in_the_page_are_png_or_jpeg(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (3, 2), (10, 20, 30)).save(buffer, "PNG")
    (tmp_path / "a.png").write_bytes(buffer.getvalue())
    with Image.open(tmp_path / "a.png") as image:
        assert decoded(encode(image.convert("RGB"))).tolist() == [[[10.0, 20.0, 30.0]] * 3] * 2
