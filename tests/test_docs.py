"""The pages of the documentation: their code runs and prints what they say, and they leave nothing out."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest
import tyro
import yaml

import gridreg
from backbones.decoders import DECODERS
from gridreg import compositions, finding
from gridreg import fields as field_registry
from gridreg.base import REGISTRY
from gridreg.scenes.protocols import PROTOCOLS, Listed
from gridreg.schedules import SCHEDULES
from gridreg.training import RunConfig, TrainOptions, preset_names
from gridreg.training.config import from_data

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
WRITTEN = sorted(path for path in DOCS.rglob("*.md") if "api" not in path.parts)
FAMILIES = sorted((DOCS / "families").glob("*.md"))
BLOCK = re.compile(r'^```(\w+)(?: title="(\w+)")?\n(.*?)^```$', re.S | re.M)


def text_of(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def blocks(path: Path, language: str) -> list[tuple[int, str]]:
    """Line number and content of each fenced block in a language."""
    text = path.read_text(encoding="utf-8")
    found = BLOCK.finditer(text)
    return [(text[: m.start()].count("\n") + 1, m[3]) for m in found if m[1] == language and m[2] is None]


def steps(path: Path) -> list[tuple[int, str, str]]:
    """Line number of each block of Python, the block, and what the page says that it prints."""
    text = path.read_text(encoding="utf-8")
    found: list[tuple[int, str, str]] = []
    for match in BLOCK.finditer(text):
        if match[1] == "python":
            found.append((text[: match.start()].count("\n") + 1, match[3], ""))
        elif match[2] == "prints":
            line, code, _ = found.pop()
            found.append((line, code, match[3]))
    return found


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all pages, so that the built-in scene is drawn once."""
    return tmp_path_factory.mktemp("pages")


@pytest.fixture
def untouched_registries() -> Iterator[None]:
    """What pages register is forgotten again."""
    registries: list[dict[Any, Any]] = [
        REGISTRY,
        SCHEDULES,
        compositions._COMPOSITIONS,
        field_registry._registered,
        finding._ADAPTERS,
    ]
    before = [dict(registry) for registry in registries]
    yield
    for registry, kept in zip(registries, before, strict=True):
        registry.clear()
        registry.update(kept)


@pytest.mark.parametrize(
    "path", [path for path in WRITTEN if steps(path)], ids=lambda path: str(path.relative_to(DOCS))
)
@pytest.mark.usefixtures("untouched_registries")
def test_code_prints_what_the_page_says(path: Path, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    names: dict[str, Any] = {"__name__": "__main__"}
    for line, code, expected in steps(path):
        printed = io.StringIO()
        # Blank lines in front, so that a traceback shows the page's own line numbers.
        program = compile("\n" * line + code, str(path), "exec")
        with contextlib.redirect_stdout(printed):
            exec(program, names)
        assert printed.getvalue() == expected, f"{path.name}, line {line}"


def test_pages_have_code() -> None:
    assert len([path for path in WRITTEN if steps(path)]) >= 12


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(DOCS)))
def test_commands_are_accepted(path: Path) -> None:
    install = re.search(
        r"python3 -m venv [^&]+ && \S+ install [^&]+?(?= &&)", (ROOT / "README.md").read_text()
    )
    assert install is not None
    for line, block in blocks(path, "bash"):
        for command in block.strip().splitlines():
            program, *words = shlex.split(command)
            if program == "python3":
                assert command == install[0], f"{path.name}, line {line}: not README's command"
                continue
            assert (program, words[0]) == (".venv/bin/python", "examples/few_tensorf_blender.py")
            options = tyro.cli(TrainOptions, args=words[1:])
            assert options.preset in {*preset_names(), "paper"}
            assert options.composition in {*gridreg.composition_names(), None}


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(DOCS)))
def test_yaml_is_accepted(path: Path) -> None:
    for _, block in blocks(path, "yaml"):
        data = yaml.safe_load(block)
        composition = (
            data if isinstance(data, list) else from_data(RunConfig, data, source=path.name).composition
        )
        assert isinstance(composition, list)
        assert len(gridreg.from_config(composition)) == len(composition) > 0


def own(registry: dict[str, Any]) -> list[str]:
    return [name for name, cls in registry.items() if cls.__module__.startswith("gridreg.")]


@pytest.mark.parametrize("name", own(REGISTRY))
def test_every_regularizer_has_a_section(name: str) -> None:
    found = [path.name for path in FAMILIES if f"\n## {name}\n" in path.read_text(encoding="utf-8")]
    assert len(found) == 1, f"{name}: sections in {found}; give it one in docs/families/"


def test_every_schedule_is_listed() -> None:
    page = text_of("families/schedules.md")
    assert all(f"| `{name}(" in page for name in own(SCHEDULES))


def first_cells(page: str, heading: str) -> list[str]:
    """Names in the first column of the table under a heading."""
    section = re.split(rf"^#+ {re.escape(heading)}$", text_of(page), flags=re.M)[1].split("\n#")[0]
    rows = re.findall(r"^\| (`.*?) \|", section, flags=re.M)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


def test_tables_list_what_there_is() -> None:
    assert sorted(first_cells("training.md", "Presets")) == preset_names()
    assert sorted(first_cells("families/compositions.md", "Compositions")) == gridreg.composition_names()
    assert sorted(first_cells("backbones.md", "Decoders")) == sorted(DECODERS)
    assert sorted(first_cells("protocols.md", "Protocols")) == sorted(PROTOCOLS)
    options = [field.name for field in fields(TrainOptions)]
    switches = {"mesh": "--no-mesh", "video": "--no-video"}
    listed = first_cells("training.md", "Options")
    assert [switches.get(name, f"--{name}") for name in options] == [
        name for name in listed if name[:2] == "--" and "=" not in name
    ]


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS.keys())
def test_rows_of_protocols(protocol: Any) -> None:
    row = next(
        row for row in text_of("protocols.md").splitlines() if re.match(rf"\|.*`{protocol.name}`.* \|", row)
    )
    _, training, test, size, background, _ = (cell.strip() for cell in row.strip("|").split("|"))
    if isinstance(protocol.train, Listed):
        assert training == " ".join(map(str, protocol.train.indices))
    assert size == ("as stored" if protocol.halve_at is None else f"halved if {protocol.halve_at} wide")
    assert background == protocol.background
    if protocol.name != "holdout8":
        assert test == ("all" if protocol.test.stride == 1 else f"every {protocol.test.stride}th")


ROOMS = ("gridreg", "gridreg.rendering", "gridreg.scenes", "gridreg.training", "gridreg.export")


def documented(directive: str) -> Iterator[object]:
    """What a line `::: name` of the reference shows: an object, or what a module exports or defines."""
    with contextlib.suppress(ModuleNotFoundError):
        module = importlib.import_module(directive)
        for name, value in vars(module).items():
            if name in module.__all__ or getattr(value, "__module__", None) == directive:
                yield value
        return
    module_name, _, name = directive.rpartition(".")
    yield getattr(importlib.import_module(module_name), name)


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_in_the_reference(room: str) -> None:
    reference = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md"))
    directives = re.findall(r"^::: (\S+)$", reference, flags=re.M)
    shown = {id(value) for directive in directives for value in documented(directive)}
    package = importlib.import_module(room)
    assert len(package.__all__) > 5
    missing = [name for name in package.__all__ if id(getattr(package, name)) not in shown]
    assert not missing, f"{room}: {missing} are nowhere in docs/api/"


# --- the pictures


@pytest.fixture
def make_pictures(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script that draws them."""
    monkeypatch.syspath_prepend(DOCS)
    yield importlib.import_module("make_pictures")
    for name in [name for name in sys.modules if name == "make_pictures" or name.split(".")[0] == "drawing"]:
        del sys.modules[name]


def test_pictures_are_up_to_date(make_pictures: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    status = make_pictures.main(["--check"])
    assert status == 0, capsys.readouterr().out


def test_stale_pictures_are_noticed_and_written_anew(
    make_pictures: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = '<svg><path d="M10 20.5L{} 7"/></svg>'
    monkeypatch.setattr(make_pictures, "pictures", lambda: {"a": line.format(30), "b": line.format(40)})
    assert make_pictures.main([], tmp_path) == 0
    assert make_pictures.main(["--check"], tmp_path) == 0
    # Rounding is forgiven, a different value, a missing or a left-over file is not.
    (tmp_path / "a.svg").write_text(line.format(30.1))
    assert make_pictures.main(["--check"], tmp_path) == 0
    (tmp_path / "a.svg").write_text(line.format(31))
    (tmp_path / "b.svg").unlink()
    (tmp_path / "c.svg").write_text(line.format(1))
    assert make_pictures.main(["--check"], tmp_path) == 1
    assert "stale: a.svg, b.svg, c.svg;" in capsys.readouterr().out
    assert make_pictures.main([], tmp_path) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.svg", "b.svg"]
    assert make_pictures.main(["--check"], tmp_path) == 0


def test_pictures_are_small_and_whole() -> None:
    files = sorted((DOCS / "pictures").glob("*"))
    assert {path.suffix for path in files} == {".svg"}
    assert sum(path.stat().st_size for path in files) < 200_000
    for path in files:
        root = ElementTree.parse(path).getroot()
        width, height = (float(root.attrib[name]) for name in ("width", "height"))
        assert root.attrib["viewBox"] == f"0 0 {width:g} {height:g}"
        for text in root.iter("{http://www.w3.org/2000/svg}text"):
            assert 0 <= float(text.attrib["x"]) <= width
            assert 0 <= float(text.attrib["y"]) <= height


def test_pages_show_every_picture_with_a_description() -> None:
    shown = set()
    for path in WRITTEN:
        for text, target in re.findall(r"!\[(.*?)\]\((.*?)\)", path.read_text(encoding="utf-8")):
            assert len(text.split()) >= 5, f"{path.name}: {target} needs a description"
            shown.add((path.parent / target).resolve())
    assert shown == set((DOCS / "pictures").resolve().glob("*.svg"))


# --- the site's own code


def module_at(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pictures_go_inline(tmp_path: Path) -> None:
    hooks = module_at(DOCS / "web" / "hooks.py")
    (tmp_path / "pictures").mkdir()
    drawn = (
        '<svg xmlns="http://www.w3.org/2000/svg" class="gr"><style>.gr { color: red }</style><path/></svg>\n'
    )
    (tmp_path / "pictures" / "a.svg").write_text(drawn)
    page = '<p><img alt="a &lt; b" src="../pictures/a.svg" /> <img alt="" src="other.png" /></p>'
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
