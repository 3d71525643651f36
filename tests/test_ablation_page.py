"""The report in a real browser: no error, the table sorts, the slider moves, narrow and dark it still reads."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from gridreg.ablation.report import write_report
from tests.ablation_results import NASTY, example
from tests.chromium import Page, open_page

WIDTHS = (360, 760, 1280, 1920)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    store, study = example(tmp_path_factory.mktemp("store"))
    return write_report(store, study, tmp_path_factory.mktemp("out") / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with open_page(tmp_path_factory.mktemp("browser"), (1000, 700)) as opened:
        yield opened


@pytest.fixture
def page(browser: Page, address: str) -> Page:
    show(browser, 1000)
    browser.open("about:blank")
    browser.open(address)
    return browser


def show(page: Page, width: int, *, dark: bool = False) -> None:
    page.call(
        "Emulation.setDeviceMetricsOverride", width=width, height=700, deviceScaleFactor=1, mobile=False
    )
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.call("Emulation.setEmulatedMedia", features=[scheme])


def middle(page: Page, selector: str) -> tuple[float, float]:
    """The middle of an element, scrolled into the window."""
    x, y = page.evaluate(
        f"""(() => {{
            const e = document.querySelector({selector!r});
            e.scrollIntoView({{block: "center"}});
            const b = e.getBoundingClientRect();
            return [b.x + b.width / 2, b.y + b.height / 2];
        }})()"""
    )
    return x, y


def column(page: Page, index: int) -> list[str]:
    found: list[str] = page.evaluate(
        "[...document.querySelector('table.sortable').tBodies[0].rows]"
        f".map((row) => row.cells[{index}].dataset.value)"
    )
    return found


def sort_of(page: Page, index: int) -> str | None:
    order: str | None = page.evaluate(
        f"document.querySelector('table.sortable').tHead.rows[0].cells[{index}].getAttribute('aria-sort')"
    )
    return order


def test_table_sorts_by_click(page: Page) -> None:
    before = column(page, 0)
    assert sort_of(page, 1) is None
    heading = "table.sortable th:nth-child(2) button"
    page.click(middle(page, heading))
    falling = [float(value) for value in column(page, 1)]
    assert falling == sorted(falling, reverse=True)
    assert sort_of(page, 1) == "descending"
    assert column(page, 0) != before
    page.click(middle(page, heading))
    assert [float(value) for value in column(page, 1)] == falling[::-1]
    assert sort_of(page, 1) == "ascending"
    page.click(middle(page, "table.sortable th:first-child button"))
    assert column(page, 0)[0] == "few_tensorf"
    assert (sort_of(page, 0), sort_of(page, 1)) == ("ascending", None)


def test_table_sorts_by_keyboard(page: Page) -> None:
    page.evaluate("document.querySelector('table.sortable th:nth-child(3) button').focus()")
    page.call(
        "Input.dispatchKeyEvent", type="keyDown", key=" ", code="Space", windowsVirtualKeyCode=32, text=" "
    )
    page.call("Input.dispatchKeyEvent", type="keyUp", key=" ", code="Space", windowsVirtualKeyCode=32)
    assert sort_of(page, 2) == "descending"
    differences = [float(value) for value in column(page, 2)]
    assert differences == sorted(differences, reverse=True)
    # The baseline counts as 0.
    assert 0.0 in differences


def stage(page: Page) -> np.ndarray:
    """What is seen of the slider, ``(H, W, 3)``."""
    middle(page, ".stage")
    time.sleep(0.15)
    x, y, width, height = page.evaluate(
        "(() => { const b = document.querySelector('.stage').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    shot = page.screenshot()
    return shot[max(0, int(y)) : int(y + height), int(x) : int(x + width)].astype(int)


def choose(page: Page, name: str, value: str) -> None:
    page.evaluate(
        f"(() => {{ const s = document.querySelector('.wipe [name={name}]'); s.value = {value!r};"
        " s.dispatchEvent(new Event('change')); })()"
    )


def blue_share(picture: np.ndarray) -> float:
    """Share of the disc that shows tensorf's blue instead of orange."""
    blue = (picture[..., 2] > picture[..., 0] + 60).sum()
    orange = (picture[..., 0] > picture[..., 2] + 60).sum()
    return float(blue / max(1, blue + orange))


def test_slider_wipes_between_two_compositions(page: Page) -> None:
    choose(page, "left", "tensorf")
    choose(page, "right", "target")
    assert blue_share(stage(page)) == pytest.approx(0.5, abs=0.08)
    x, y = middle(page, ".stage input")
    width = page.evaluate("document.querySelector('.stage').clientWidth")
    page.drag((x, y), (x + 0.45 * width, y))
    assert blue_share(stage(page)) > 0.95
    x, y = middle(page, ".stage input")
    page.drag((x + 0.45 * width, y), (x - 0.45 * width, y))
    assert blue_share(stage(page)) < 0.05


def test_slider_obeys_the_keyboard(page: Page) -> None:
    page.evaluate("document.querySelector('.stage input').focus()")
    page.press("ArrowRight")
    assert page.evaluate("document.querySelector('.stage').style.getPropertyValue('--at')") == "51%"
    page.press("Home")
    clip = page.evaluate("getComputedStyle(document.querySelector('.stage .top')).clipPath")
    assert clip.startswith("inset(0px calc(100%") or clip == "inset(0px 100% 0px 0px)"


def test_slider_names_what_is_seen(page: Page) -> None:
    def tags() -> list[str]:
        found: list[str] = page.evaluate("[...document.querySelectorAll('.wipe')][0].innerText.split('\\n')")
        return found

    assert any(line.startswith("few_tensorf") and line.endswith("dB") for line in tags())
    choose(page, "left", NASTY)
    assert any(line.startswith(NASTY.split(" ")[0]) for line in tags())
    assert NASTY in page.evaluate("document.querySelector('.stage .top').alt")
    before = page.evaluate("document.querySelector('.stage .top').src")
    choose(page, "view", "r_24")
    assert page.evaluate("document.querySelector('.stage .top').src") != before
    choose(page, "scene", "chair")
    assert page.evaluate("document.querySelector('.stage .top').alt").startswith("chair, r_24")
    left, right = (
        page.evaluate(f"document.querySelector('.wipe [name={side}]').value") for side in ("left", "right")
    )
    page.click(middle(page, ".wipe button"))
    assert page.evaluate("document.querySelector('.wipe [name=left]').value") == right
    assert page.evaluate("document.querySelector('.wipe [name=right]').value") == left


@pytest.mark.parametrize("width", WIDTHS)
def test_no_width_needs_sideways_scrolling(page: Page, width: int) -> None:
    show(page, width)
    widths = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert widths[0] <= widths[1]
    # Whatever is wider has a region of its own that scrolls.
    outside = page.evaluate(
        """[...document.querySelectorAll("main *")].filter((e) => !e.closest(".scroll, svg, pre") &&
            e.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
            .map((e) => e.outerHTML.slice(0, 80))"""
    )
    assert outside == []


def test_wide_tables_scroll_by_themselves_on_a_phone(page: Page) -> None:
    show(page, 360)
    inner, seen = page.evaluate(
        "(() => { const e = document.querySelector('.scroll'); return [e.scrollWidth, e.clientWidth]; })()"
    )
    assert inner > seen
    page.evaluate("document.querySelector('.scroll').scrollLeft = 200")
    left = page.evaluate("document.querySelector('table.sortable tbody th').getBoundingClientRect().left")
    assert 0 <= left < 40


def test_dark_follows_the_readers_preference(page: Page) -> None:
    def brightness() -> float:
        time.sleep(0.1)
        return float(page.screenshot().mean())

    page.evaluate("scrollTo(0, 0)")
    assert brightness() > 220
    show(page, 1000, dark=True)
    assert brightness() < 60


def contrast(first: str, second: str) -> float:
    """WCAG's contrast of two colours ``rgb(r, g, b)``."""

    def luminance(colour: str) -> float:
        numbers = np.array([float(n) for n in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
        linear = np.where(numbers <= 0.04045, numbers / 12.92, ((numbers + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    dark, light = sorted((luminance(first), luminance(second)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("dark", [False, True])
def test_text_and_lines_stand_out(page: Page, dark: bool) -> None:
    show(page, 1000, dark=dark)
    card = page.evaluate("getComputedStyle(document.querySelector('main > section')).backgroundColor")
    for selector, least in (("main", 7.0), (".note", 4.5), (".legend line", 3.0), (".findings .down b", 4.5)):
        key = "stroke" if "line" in selector else "color"
        colours = page.evaluate(
            f"[...document.querySelectorAll({selector!r})].map((e) => getComputedStyle(e)[{key!r}])"
        )
        assert colours
        for colour in colours:
            assert contrast(colour, card) >= least, f"{selector}: {colour} on {card}"


def test_a_line_stands_out_under_the_pointer(page: Page) -> None:
    x, y = middle(page, ".legend li:nth-child(2)")
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    lit = page.evaluate("[...document.querySelectorAll('.curves.fade g.lit')].map((e) => e.dataset.series)")
    assert set(lit) == {"tensorf"}


def test_controls_have_names(page: Page) -> None:
    nameless = page.evaluate(
        """[...document.querySelectorAll("input, select, button, [role=region]")].filter((e) =>
            !e.getAttribute("aria-label") && !e.closest("label") && !e.textContent.trim()).length"""
    )
    assert nameless == 0
    assert page.evaluate("[...document.images].filter((e) => !e.alt && e.src).length") == 0


def test_page_has_logged_no_error(page: Page) -> None:
    assert page.problems == []
