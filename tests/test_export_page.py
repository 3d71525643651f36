"""The viewer's page in a real browser: it loads, shows the object, follows its controls, logs no error."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.export.viewer import Viewer
from tests.chromium import Page, open_page
from tests.export_fields import ball_model, ring_of_views

pytest.importorskip("viser", reason="viser (extra 'viewer') is not installed")

WINDOW = (800, 480)


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with Viewer(ball_model(step=100), ring_of_views(6), port=0, size=160, refresh=0.1, quiet=True) as shown:
        yield shown


@pytest.fixture(scope="module")
def page(viewer: Viewer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with open_page(tmp_path_factory.mktemp("browser"), WINDOW) as opened:
        opened.open(viewer.url)
        # The masks are folded away, so that the panel leaves room on a telephone.
        folder = "[...document.querySelectorAll('*')].filter(e => e.childElementCount < 2 && e.textContent === 'Masks')"
        opened.until(lambda: opened.evaluate(f"{folder}.length > 0"))
        opened.evaluate(f"{folder}.pop().click()")
        yield opened


def ball(page: Page) -> np.ndarray:
    """Mean colour in the middle of the image, left of the panel."""
    height, width = WINDOW[1], WINDOW[0]
    shot = page.screenshot()[height // 2 - 20 : height // 2 + 20, width // 2 - 20 : width // 2 + 20]
    return shot.reshape(-1, 3).mean(axis=0)


def control(page: Page, label: str, selector: str) -> tuple[float, float]:
    """Middle of the control in the panel's row that holds a label."""
    place = page.until(
        lambda: page.evaluate(
            f"""(() => {{
                for (const e of document.querySelectorAll({selector!r})) {{
                    if (e.getBoundingClientRect().width === 0) continue;
                    let row = e;
                    for (let i = 0; i < 7 && row; i++, row = row.parentElement) {{
                        if (row.textContent.includes({label!r}) && row.getBoundingClientRect().height < 60) {{
                            const b = e.getBoundingClientRect();
                            return [b.x + b.width / 2, b.y + b.height / 2];
                        }}
                    }}
                }}
                return null;
            }})()"""
        )
    )
    return place[0], place[1]


def still(page: Page, label: str, selector: str) -> tuple[float, float]:
    """`control`, when it has stopped moving: menus fold out."""
    before, place = (0.0, 0.0), control(page, label, selector)
    while place != before:
        time.sleep(0.15)
        before, place = place, control(page, label, selector)
    return place


def choose(page: Page, mode: str) -> None:
    page.click(still(page, "Show", "input"))
    page.click(still(page, mode, "[role=option]"))


def close(colour: list[int]):
    """A test whether a colour is near another."""
    return lambda found: np.abs(found - colour).max() < 45


def see(page: Page, wanted) -> np.ndarray:
    """Wait until the ball has a colour."""
    page.until(lambda: wanted(ball(page)))
    return ball(page)


# The camera stands at positive x and z: the visible side is reddish.
TRAINED = close([195, 128, 165])
RED_ALONE = close([195, 0, 0])


def test_page_shows_the_object(page, viewer):
    see(page, TRAINED)
    shot = page.screenshot()
    # Nothing but background beside the ball.
    assert (shot[WINDOW[1] // 2, 20:60] > 230).all()


def test_slider_shows_the_masks_at_another_step_and_back(page, viewer):
    see(page, TRAINED)
    x, y = control(page, "At step", "[role=slider]")
    page.drag((x, y), (x - 400, y))
    see(page, RED_ALONE)
    assert viewer._panel.look.step == 0
    page.click(control(page, "As trained", "button"))
    see(page, TRAINED)
    assert viewer._panel.look.step is None
    assert control(page, "At step", "[role=slider]")[0] == pytest.approx(x, abs=2)


def test_switch_takes_a_mask_off(page, viewer):
    x, y = control(page, "At step", "[role=slider]")
    page.drag((x, y), (x - 400, y))
    see(page, RED_ALONE)
    page.click(control(page, "weight", "input[type=checkbox]"))
    see(page, TRAINED)
    page.click(control(page, "weight", "input[type=checkbox]"))
    see(page, RED_ALONE)
    page.click(control(page, "As trained", "button"))
    see(page, TRAINED)


def test_modes(page, viewer):
    choose(page, "opacity")
    see(page, close([255, 255, 255]))
    assert (page.screenshot()[WINDOW[1] // 2, 20:60] < 30).all()
    choose(page, "depth")
    # The nearest part is at the blue end of the scale.
    see(page, lambda c: c[2] > c[0] + 30 and c.min() < 120)
    choose(page, "rgb")
    see(page, TRAINED)


def test_training_is_seen_as_it_goes_on(page, viewer):
    see(page, TRAINED)
    model = ball_model(step=100)
    with torch.no_grad():
        model.field.weight[0, 0] = 0.0
    page.until(lambda: viewer.wants_update)
    viewer.update(model)
    see(page, close([0, 128, 165]))
    viewer.update(ball_model(step=100))
    see(page, TRAINED)


def test_snapshot_is_saved(page, viewer, tmp_path):
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.click(control(page, "Snapshot", "button"))
    saved: list[Path] = page.until(lambda: list(tmp_path.glob("gridreg_rgb_*.png")))
    time.sleep(0.3)
    with Image.open(saved[0]) as image:
        assert image.width == 160
        assert TRAINED(np.asarray(image.convert("RGB"))[image.height // 2, 80].astype(float))


def test_dragging_turns_the_camera(page, viewer):
    see(page, TRAINED)
    before = next(iter(viewer._screens.values())).client.camera.position.copy()
    page.drag((200, 420), (300, 420))
    page.until(
        lambda: np.abs(next(iter(viewer._screens.values())).client.camera.position - before).max() > 0.3
    )
    assert not TRAINED(see(page, lambda c: not TRAINED(c)))


def test_page_has_logged_no_error(page):
    assert page.problems == []
