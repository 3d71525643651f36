"""Charts: round ticks, labels that do not overlap, places that mean what they say."""

from __future__ import annotations

import io
import math
import re
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gridreg.ablation.comparison import Section, compare
from gridreg.ablation.curves import curves, over_views, styles
from gridreg.ablation.differences import forest_plot, heat_map
from gridreg.ablation.mask_pictures import mask_schedules
from gridreg.ablation.plots import Series, _apart, line_chart, series_class, ticks
from gridreg.ablation.records import RunResult
from gridreg.ablation.wipes import encode
from tests.ablation_results import done, opened, spec, study_of
from tests.test_ablation_report import decoded

finite = st.floats(-1e3, 1e3).map(lambda value: round(value, 3))


@given(finite, st.floats(0.01, 1e3), st.integers(2, 8))
def test_ticks_are_round_and_inside(low: float, span: float, count: int) -> None:
    found = ticks(low, low + span, count)
    step = span if len(found) < 2 else found[1] - found[0]
    assert all(low - 1e-6 * span <= value <= low + span + 1e-6 * span for value in found)
    assert len(found) <= count + 1
    if len(found) > 1:
        assert np.diff(found) == pytest.approx(step, rel=1e-6)
        mantissa = step / 10.0 ** math.floor(math.log10(step) + 1e-9)
        assert any(mantissa == pytest.approx(factor, rel=1e-4) for factor in (1, 2, 5, 10))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 100, [0, 20, 40, 60, 80, 100]), (-0.3, 0.3, [-0.2, 0, 0.2]), (5, 5, [5])],
)
def test_ticks_by_hand(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)


@given(st.lists(st.floats(0, 200), max_size=12))
def test_labels_keep_their_distance_and_order(places: list[float]) -> None:
    moved = _apart(sorted(places), 14.0, 220.0)
    assert all(b - a >= 14.0 - 1e-9 for a, b in pairwise(moved))
    assert all(place <= 220.0 for place in moved)


def test_labels_with_room_stay_where_they_are() -> None:
    assert _apart([10.0, 60.0, 100.0], 14.0, 220.0) == [10.0, 60.0, 100.0]


def test_series_are_told_by_colour_then_by_dash() -> None:
    found = [series_class(index) for index in range(18)]
    assert len(set(found)) == 18
    assert found[0] == "s1"
    assert all("d" not in name for name in found[:6])


def chart_of(series: list[Series], **more: object) -> ElementTree.Element:
    text = line_chart("t", series, x_label="x", y_label="y", **more)  # type: ignore[arg-type]
    return ElementTree.fromstring(text)


def path_of(chart: ElementTree.Element) -> np.ndarray:
    line = next(chart.iter("polyline"))
    return np.array([[float(n) for n in pair.split(",")] for pair in line.attrib["points"].split()])


def test_points_stand_where_their_numbers_are() -> None:
    chart = chart_of([Series("a", "s1", [(0.0, 20.0), (50.0, 24.0), (100.0, 26.0)])])
    path = path_of(chart)
    assert path[:, 0].tolist() == [0, 500, 1000]
    # The vertical axis is linear: read the scale off the ticks.
    marks = [
        t
        for t in chart.iter("text")
        if t.attrib["text-anchor" if "text-anchor" in t.attrib else "x"] == "end"
    ]
    scale = {float(str(t.text)): float(t.attrib["y"]) - 4 for t in marks}
    values = sorted(scale)
    slope = (scale[values[-1]] - scale[values[0]]) / (values[-1] - values[0])
    expected = [scale[values[0]] + slope * (value - values[0]) for value in (20.0, 24.0, 26.0)]
    assert path[:, 1] == pytest.approx(expected, abs=0.2)
    assert slope < 0


def test_logarithmic_axis_spaces_ratios_evenly() -> None:
    chart = chart_of(
        [Series("a", "s1", [(1.0, 20.0), (10.0, 24.0), (100.0, 26.0)])], log_x=True, x_ticks=(1, 10, 100)
    )
    assert path_of(chart)[:, 0] == pytest.approx([0, 500, 1000])
    texts = [str(t.text) for t in chart.iter("text")]
    assert {"1", "10", "100"} <= set(texts)


def test_far_below_the_best_is_cut_off() -> None:
    line = Series("a", "s1", [(0.0, -50.0), (1.0, 25.0)], [(0.5, -50.0), (1.0, 25.0)])
    chart = chart_of([line], y_span=10.0)
    assert len(list(chart.iter("circle"))) == 1
    # The line leaves through the frame of the inner picture, which hides it.
    assert path_of(chart)[0, 1] > 300
    assert all(float(t.attrib["y"]) < 260 for t in chart.iter("text"))


def test_a_chart_of_nothing_is_nothing() -> None:
    assert line_chart("t", [], x_label="x", y_label="y") == ""
    assert line_chart("t", [Series("a", "s1", [])], x_label="x", y_label="y") == ""


def test_one_point_is_a_dot_without_a_line() -> None:
    chart = chart_of([Series("a", "s1", [(3.0, 20.0)], [(3.0, 20.0)])])
    assert not list(chart.iter("polyline"))
    radii = [float(dot.attrib["r"]) for dot in chart.iter("circle")]
    assert len(radii) == 2
    assert radii[0] < radii[1]


def test_many_lines_make_a_taller_chart_and_long_names_are_cut() -> None:
    series = [
        Series(f"a composition with a long name {i}", "s1", [(0.0, 20.0), (1.0, 20.0)]) for i in range(30)
    ]
    chart = chart_of(series)
    labels = [t for t in chart.iter("text") if t.attrib.get("class") == "end s1"]
    places = sorted(float(t.attrib["y"]) for t in labels)
    assert min(np.diff(places)) >= 13.9
    assert all(len(str(t.text)) <= 21 for t in labels)
    assert labels[0].find("title") is not None


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
    text = curves(section(), rising)
    figures = re.findall(r"<figure.*?</figure>", text, re.S)
    assert len(figures) == 2
    (first, second) = ElementTree.fromstring(figures[0]).iter("polyline")
    path = np.array([[float(n) for n in pair.split(",")] for pair in first.attrib["points"].split()])
    # Seeds 0, 1, 2 look at 20, 30, 40 s: their mean is 30 s of the 411 s that few_tensorf's runs take on average.
    assert path[0, 0] == pytest.approx(1000 * 30 / 411, abs=0.2)
    assert len(path) == 2
    assert (first.attrib["class"], second.attrib["class"]) == ("s0", "s1")
    assert "held-out PSNR" in text


def test_curves_without_histories_show_nothing() -> None:
    assert curves(section(), lambda result: []) == ""


def test_forest_has_a_row_for_each_comparison() -> None:
    text = forest_plot(section())
    rows = re.findall(r'role="listitem">.*?</div>', text, re.S)
    assert len(rows) == 1
    places = [float(x) for x in re.findall(r'class="pair" cx="([\d.]+)%', rows[0])]
    assert len(places) == 6
    mean = float(re.findall(r'class="mean" cx="([\d.]+)%', rows[0])[0])
    assert mean == pytest.approx(np.mean(places), abs=0.02)
    ends = [
        float(x)
        for pair in re.findall(r'class="interval" x1="([\d.]+)%" x2="([\d.]+)%', rows[0])
        for x in pair
    ]
    assert ends[0] < mean < ends[1]
    zero = float(re.findall(r'class="zero" x1="([\d.]+)%', rows[0])[0])
    assert ends[1] < zero


def test_forest_without_pairs_is_nothing() -> None:
    runs = [spec("few_tensorf"), spec("tensorf", preset="other")]
    (own,) = compare(study_of(runs), [done(run) for run in runs])
    assert forest_plot(own) == ""
    assert heat_map(own) == ""


def test_heat_map_colours_by_sign_and_size() -> None:
    text = heat_map(section())
    cells = re.findall(r'<td class="(up|down)" style="--share:(\d+)%">(\S+)', text)
    assert len(cells) == 2
    assert {kind for kind, _, _ in cells} == {"down"}
    sizes = {float(number.replace("−", "-")): int(share) for _, share, number in cells}
    assert sizes[min(sizes)] == 55
    assert heat_map(section(scenes=("lego",))) == ""


def test_masks_are_pictures_of_channels_over_iterations() -> None:
    (own,) = [section(seeds=1, scenes=("lego",))]
    runs = [run for runs in own.results.values() for run in runs]
    rows = [{"step": step, "masks": {"density": opened(8, step / 100)}} for step in (0, 50, 100)]
    text = mask_schedules(runs, lambda result: rows)
    # Both compositions have the same masks: one picture, after the scale.
    assert text.count('class="mask"') == 1
    assert "<li>few_tensorf</li><li>tensorf</li>" in text
    source = re.findall(r'<img src="(data:[^"]+)" alt="mask', text)[0]
    picture = decoded(source)
    assert picture.shape == (8, 3, 3)
    # Channel 0 is the lowest line; half-way the lower half is open, in the end everything.
    scale = decoded(re.findall(r'<img src="(data:[^"]+)" alt="colour', text)[0])
    closed, full = scale[0, 0], scale[0, -1]
    assert np.array_equal(picture[:, 0], np.tile(closed, (8, 1)))
    assert np.array_equal(picture[4:, 1], np.tile(full, (4, 1)))
    assert np.array_equal(picture[:4, 1], np.tile(closed, (4, 1)))
    assert np.array_equal(picture[:, 2], np.tile(full, (8, 1)))
    assert mask_schedules(runs, lambda result: []) == ""


def test_views_of_one_number_make_no_chart() -> None:
    assert over_views([section()]) == ""


def test_rows_keep_their_style_and_the_baseline_is_grey() -> None:
    assert styles(section().rows) == {"few_tensorf": "s0", "tensorf": "s1"}


def test_pictures_in_the_page_are_png_or_jpeg(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (3, 2), (10, 20, 30)).save(buffer, "PNG")
    (tmp_path / "a.png").write_bytes(buffer.getvalue())
    with Image.open(tmp_path / "a.png") as image:
        assert decoded(encode(image.convert("RGB"))).tolist() == [[[10.0, 20.0, 30.0]] * 3] * 2
