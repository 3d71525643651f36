"""The site around the pages: diagrams drawn by the code, what happens to them, and readable docstrings."""

from __future__ import annotations

import importlib
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
import yaml

from gridreg.base import REGISTRY
from tests.chromium import open_page
from tests.programs import module_at

DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture
def make_diagrams(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script that draws them."""
    monkeypatch.syspath_prepend(DOCS)
    yield importlib.import_module("make_diagrams")
    for name in [name for name in sys.modules if name == "make_diagrams" or name.split(".")[0] == "drawing"]:
        del sys.modules[name]


def test_diagrams_are_up_to_date(make_diagrams: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    status = make_diagrams.main(["--check"])
    assert status == 0, capsys.readouterr().out


def test_stale_diagrams_are_noticed_and_written_anew(
    make_diagrams: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = '<svg><path d="M10 20.5L{} 7"/></svg>'
    monkeypatch.setattr(make_diagrams, "diagrams", lambda: {"a": line.format(30), "b": line.format(40)})
    assert make_diagrams.main([], tmp_path) == 0
    assert make_diagrams.main(["--check"], tmp_path) == 0
    # Rounding is forgiven, a different value, a missing or a left-over file is not.
    (tmp_path / "a.svg").write_text(line.format(30.1))
    assert make_diagrams.main(["--check"], tmp_path) == 0
    (tmp_path / "a.svg").write_text(line.format(31))
    (tmp_path / "b.svg").unlink()
    (tmp_path / "c.svg").write_text(line.format(1))
    assert make_diagrams.main(["--check"], tmp_path) == 1
    assert "stale: a.svg, b.svg, c.svg;" in capsys.readouterr().out
    assert make_diagrams.main([], tmp_path) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.svg", "b.svg"]
    assert make_diagrams.main(["--check"], tmp_path) == 0


def test_diagrams_are_small_and_whole() -> None:
    files = sorted((DOCS / "diagrams").glob("*"))
    assert {path.suffix for path in files} == {".svg"}
    assert sum(path.stat().st_size for path in files) < 200_000
    for path in files:
        root = ElementTree.parse(path).getroot()
        width, height = (float(root.attrib[name]) for name in ("width", "height"))
        assert root.attrib["viewBox"] == f"0 0 {width:g} {height:g}"
        for text in root.iter("{http://www.w3.org/2000/svg}text"):
            assert 0 <= float(text.attrib["x"]) <= width
            assert 0 <= float(text.attrib["y"]) <= height


def test_pages_show_every_diagram_with_a_description() -> None:
    shown = set()
    for path in {*DOCS.rglob("*.md")} - {DOCS / "results.md"}:
        for text, target in re.findall(r"!\[(.*?)\]\((.*?)\)", path.read_text(encoding="utf-8")):
            assert len(text.split()) >= 5, f"{path.name}: {target} needs a description"
            shown.add((path.parent / target).resolve())
    files = [("diagrams", "*.svg"), ("images", "*.webp"), ("photographs", "*.jpg")]
    assert shown == {path for folder, kind in files for path in (DOCS / folder).resolve().glob(kind)}


# --- the site's own code


def test_results_enter_the_menu_once_they_are_there(tmp_path: Path) -> None:
    hooks = module_at(DOCS / "web" / "hooks.py")
    config = {"docs_dir": str(tmp_path), "nav": [{"Start": "index.md"}, {"Reference": "api.md"}]}
    assert [list(entry) for entry in hooks.on_config(dict(config))["nav"]] == [["Start"], ["Reference"]]
    (tmp_path / "results.md").write_text("# Results\n")
    assert [list(entry) for entry in hooks.on_config(config)["nav"]] == [
        ["Start"],
        ["Results"],
        ["Reference"],
    ]


def test_diagrams_go_inline(tmp_path: Path) -> None:
    hooks = module_at(DOCS / "web" / "hooks.py")
    (tmp_path / "diagrams").mkdir()
    drawn = (
        '<svg xmlns="http://www.w3.org/2000/svg" class="gr"><style>.gr { color: red }</style><path/></svg>\n'
    )
    (tmp_path / "diagrams" / "a.svg").write_text(drawn)
    page = '<p><img alt="a &lt; b" src="../diagrams/a.svg" /> <img alt="" src="other.png" /></p>'
    inlined = hooks.on_page_content(page, {"docs_dir": str(tmp_path)}, page=None, files=None)
    assert inlined == (
        '<p><svg role="img" aria-label="a &lt; b" class="gr"><path/></svg> <img alt="" src="other.png" /></p>'
    )


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ('<a href="https://example.org">a link is not fetched</a>', 0),
        ('<script src="assets/a.js"></script><link rel="stylesheet" href="a.css">', 0),
        ('<script defer src="https://example.org/a.js"></script>', 1),
        ('<link rel="preconnect" href="//example.org">', 1),
        ('<img alt="" src="http://example.org/a.png">', 1),
        ("@import 'https://example.org/a.css'; a { background: url(https://example.org/a.png) }", 2),
        ("a { background: url(data:image/svg+xml;charset=utf-8,<svg/>) }", 0),
    ],
)
def test_fetches_from_elsewhere_are_found(text: str, count: int) -> None:
    assert len(module_at(DOCS / "web" / "hooks.py").foreign(text)) == count


def test_docstrings_are_made_readable() -> None:
    pytest.importorskip("griffe", reason="griffe, of the docs extra, is not installed")
    readable = module_at(DOCS / "web" / "docstrings.py").readable
    text = """What :func:`~gridreg.apply` does.

Args:
    near, far: of the ray,
    world units.
    *rest: others.

Formula: ``a``
Unit: none

Example:
    >>> 1
    1

>>> 2
2"""
    assert (
        readable(text)
        == """What `gridreg.apply` does.

Args:
    near: of the ray,
        world units.
    far: of the ray,
        world units.
    *rest: others.

* **Formula** ``a``
* **Unit** none

Examples:
    >>> 1
    1

Examples:
    >>> 2
    2"""
    )


def test_formulas_become_mathml_and_stay_in_their_cell() -> None:
    pytest.importorskip("latex2mathml", reason="latex2mathml, of the docs extra, is not installed")
    hooks = module_at(DOCS / "web" / "hooks.py")
    text = hooks.on_page_content(
        r'<td><span class="arithmatex">\(\frac{a}{b} &lt; 1\)</span></td>', {"docs_dir": str(DOCS)}, page=None
    )
    assert "<math" in text
    assert "<mfrac><mrow><mi>a</mi></mrow><mrow><mi>b</mi></mrow></mfrac>" in text
    assert "arithmatex" not in text


def test_every_formula_is_of_a_regularizer_and_can_be_set() -> None:
    converter = pytest.importorskip("latex2mathml.converter", reason="latex2mathml is not installed")
    formulas = yaml.safe_load((DOCS / "formulas.yaml").read_text(encoding="utf-8"))
    assert formulas.keys() == {n for n, cls in REGISTRY.items() if cls.__module__.startswith("gridreg.")}
    for formula in formulas.values():
        assert "\\" not in ElementTree.tostring(ElementTree.fromstring(converter.convert(formula)), "unicode")


def test_search_works_from_disk(tmp_path: Path) -> None:
    """The site as ``mkdocs build`` has left it; .ci/run builds it first."""
    site = DOCS.parent / "site"
    if not (site / "search" / "search_index.js").is_file():
        pytest.skip("no site: mkdocs build makes it")
    with open_page(tmp_path, (1280, 900)) as tab:
        tab.open(f"file://{site / 'index.html'}")
        tab.evaluate("document.querySelector('.md-search__input').focus()")
        tab.call("Input.insertText", text="occlusion")
        tab.call("Input.dispatchKeyEvent", type="keyUp", key="n", code="KeyN")
        tab.until(lambda: tab.evaluate("document.querySelectorAll('.md-search-result__item').length > 3"))
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        tab.open(f"file://{site / 'catalogue.html'}")
        assert tab.evaluate(
            "document.querySelector('table').scrollWidth <= document.querySelector('article').clientWidth"
        )
        assert tab.evaluate("document.querySelectorAll('td math').length") >= 30
        # A line of code of 100 characters is not cut.
        tab.open(f"file://{site / 'own-field.html'}")
        code = "[...document.querySelectorAll('pre > code')].filter(c => c.querySelector('.k, .kn'))"
        widths = f"{code}.map(c => c.scrollWidth - c.clientWidth)"
        assert max(tab.evaluate(widths)) <= 0
        assert not tab.problems


def test_images_are_those_that_were_made(capsys: pytest.CaptureFixture[str]) -> None:
    status = module_at(DOCS / "make_images.py").main(["--check"])
    assert status == 0, capsys.readouterr().out


def test_wrong_images_are_noticed(tmp_path: Path) -> None:
    make_images = module_at(DOCS / "make_images.py")
    shutil.copytree(DOCS / "images", tmp_path / "images")
    assert make_images.problems(tmp_path / "images") == []
    (tmp_path / "images" / "mesh.webp").write_bytes(bytes(300_000))
    (tmp_path / "images" / "stages.webp").unlink()
    (tmp_path / "images" / "old.webp").write_bytes(b"")
    assert make_images.problems(tmp_path / "images") == [
        "old.webp: left over",
        "stages.webp: missing",
        "mesh.webp: another file than was made",
        "mesh.webp: 300000 bytes",
    ]
