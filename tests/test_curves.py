"""The history of a run: its rows, its file, and the pictures drawn from it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gridreg
from gridreg.errors import InputError
from gridreg.training.curves import History, draw_curves, draw_masks


def picture(path: Path) -> np.ndarray:
    """RGB (H, W, 3) in 0..255 of a PNG that was drawn."""
    image = iio.imread(path)
    assert image.shape[0] > 100
    assert image.shape[1] > 100
    return image[..., :3].astype(int)


def near(image: np.ndarray, colour: tuple[int, int, int], tolerance: int = 12) -> np.ndarray:
    return (np.abs(image - np.array(colour)) <= tolerance).all(-1)


BLUE, ORANGE = (31, 119, 180), (255, 127, 14)
YELLOW, PURPLE = (253, 231, 36), (68, 1, 84)


def test_record_keeps_means_over_steps():
    history = History(every=5)
    values = np.random.default_rng(0).uniform(size=23)
    for step, value in enumerate(values, start=1):
        history.record(step, {"loss": value, "psnr": 2 * value})
    assert [row["step"] for row in history.rows] == [5, 10, 15, 20]
    expected = values[:20].reshape(4, 5).mean(1)
    assert [row["loss"] for row in history.rows] == pytest.approx(expected, abs=1e-15)
    assert [row["psnr"] for row in history.rows] == pytest.approx(2 * expected, abs=1e-15)


def test_a_value_that_is_not_there_at_every_step():
    history = History(every=2)
    history.record(1, {"loss": 1.0})
    history.record(2, {"loss": 3.0, "occlusion": 8.0})
    assert history.rows == [{"step": 2, "loss": 2.0, "occlusion": 8.0}]


@settings(max_examples=30, deadline=None)
@given(every=st.integers(1, 7), stop=st.integers(0, 30))
def test_a_resumed_history_has_the_same_rows(every, stop):
    values = np.random.default_rng(1).uniform(size=30).tolist()
    straight, first, second = History(every), History(every), History()
    for step, value in enumerate(values, start=1):
        straight.record(step, {"loss": value})
        if step <= stop:
            first.record(step, {"loss": value})
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    for step, value in enumerate(values[stop:], start=stop + 1):
        second.record(step, {"loss": value})
    assert second.rows == straight.rows
    assert second.state_dict() == straight.state_dict()


def test_json_lines_come_back(tmp_path):
    history = History()
    history.add(1, {"psnr": math.inf, "loss": 1e-300})
    history.add(2, masks={"density": [1, 0.5, 0.0], "decoder.0": np.ones(2)})
    history.save(tmp_path / "history.jsonl")
    lines = (tmp_path / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]
    assert "Infinity" not in lines[0]
    assert History.load(tmp_path / "history.jsonl").rows == history.rows


@pytest.mark.parametrize("line", ["{", "[1]", "5", '{"psnr": 1}', '{"step": 1, "psnr": []}', '{"step": "x"}'])
def test_a_damaged_line_is_named(tmp_path, line):
    path = tmp_path / "history.jsonl"
    path.write_text('{"step": 1}\n' + line + "\n")
    with pytest.raises(InputError, match=r"history\.jsonl:2: not a row of a history"):
        History.load(path)


def test_a_missing_history(tmp_path):
    with pytest.raises(InputError, match="history not found"):
        History.load(tmp_path / "none.jsonl")


def test_every_must_be_positive():
    with pytest.raises(InputError, match="every: found 0"):
        History(every=0)


def test_curves_show_each_series_where_it_belongs(tmp_path):
    history = History()
    for step in range(1, 201):
        history.add(step, {"psnr": 10 + step / 20, "loss": 1 / step, "mse": 0.5 / step, "seconds": step})
    for step in (100, 200):
        history.add(step, {"test_psnr": 8 + step / 20})
    draw_curves(history.rows, tmp_path / "curves.png", title="lego, dietnerf8", events=(50,))
    image = picture(tmp_path / "curves.png")
    half = len(image) // 2
    for colour in (BLUE, ORANGE):
        assert near(image[:half], colour).sum() > 100
        assert near(image[half:], colour).sum() > 100
    # The rising PSNR: its left end lies lower in the picture than its right end.
    rows, columns = np.nonzero(near(image[:half, 150:], BLUE))
    assert (
        rows[columns < np.quantile(columns, 0.2)].mean()
        > rows[columns > np.quantile(columns, 0.8)].mean() + 50
    )


@pytest.mark.parametrize(
    "rows",
    [
        [],
        [{"step": 1}],
        [{"step": 1, "psnr": math.inf, "loss": 0.0, "penalty": -1.0}],
        [{"step": 1, "psnr": math.nan, "loss": math.nan}, {"step": 2, "psnr": 20.0}],
        [{"step": 5, "a$b$ name": 1.0, "_hidden": 2.0}],
    ],
)
def test_curves_of_little_or_odd_data_are_drawn(tmp_path, rows):
    draw_curves(rows, tmp_path / "curves.png", title="a$_scene")
    assert picture(tmp_path / "curves.png").std() > 1


def test_masks_open_to_the_upper_right(tmp_path):
    history = History()
    for step in range(0, 1000, 20):
        mask = gridreg.frequency_mask(48, step, 900)
        history.add(step, masks={"density": mask.tolist(), "closed": [0.0] * 4})
        history.add(step, {"loss": 1.0})
    draw_masks(history.rows, tmp_path / "masks.png")
    image = picture(tmp_path / "masks.png")
    upper, lower = image[: len(image) // 2], image[len(image) // 2 :]
    left, right = np.array_split(upper[:, : int(0.85 * upper.shape[1])], 2, axis=1)
    assert near(right, YELLOW).sum() > 2 * near(left, YELLOW).sum() > 0
    assert near(left, PURPLE).sum() > 2 * near(right, PURPLE).sum()
    body = lower[:, : int(0.85 * lower.shape[1])]
    assert near(body, YELLOW).sum() == 0
    assert near(body, PURPLE).sum() > 10_000


def test_masks_of_one_row_of_equal_steps_and_of_changing_length(tmp_path):
    for rows in (
        [{"step": 3, "masks": {"density": [1.0, 0.0]}}],
        [{"step": s, "masks": {"density": [1.0]}} for s in (3, 3, 5)],
        [{"step": s, "masks": {"density": [1.0] * s}} for s in (1, 2, 3)],
    ):
        draw_masks(rows, tmp_path / "masks.png", title="5$")
        assert near(picture(tmp_path / "masks.png"), YELLOW).sum() > 1000


def test_masks_without_a_mask(tmp_path):
    with pytest.raises(InputError, match="no row has a mask"):
        draw_masks([{"step": 1, "loss": 2.0}], tmp_path / "masks.png")
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_place_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"none/curves\.png: cannot write here") as caught:
        draw_curves([], tmp_path / "none" / "curves.png")
    assert "\n" not in str(caught.value)
