"""The pages of the documentation: their code runs and prints what they say, and they leave nothing out."""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import io
import re
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import tyro
import yaml

import gridreg
from backbones.decoders import DECODERS
from gridreg import fields as field_registry
from gridreg.attach import _resolve as finding
from gridreg.base import REGISTRY
from gridreg.cli import COMMANDS
from gridreg.cli.main import options_of
from gridreg.compositions import named as compositions
from gridreg.scenes.protocols import PROTOCOLS, Listed
from gridreg.schedules import SCHEDULES
from gridreg.training import RunConfig, TrainOptions, preset_names
from gridreg.training.typed_data import from_data

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
# A benchmark writes the page of results.
WRITTEN = sorted(p for p in DOCS.rglob("*.md") if "api" not in p.parts and p.name != "results.md")
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


def check_command(words: list[str], where: str) -> None:
    """Whether the command line accepts these words."""
    name, *rest = words
    if name == "--tyro-print-completion":
        assert rest in (["bash"], ["zsh"]), where
        return
    assert name in COMMANDS, where
    options = tyro.cli(options_of(name), args=rest)
    if name == "train":
        assert options.preset in {*preset_names(), "paper"}, where
        assert options.composition in {*gridreg.composition_names(), None}, where


@pytest.mark.parametrize("path", [*WRITTEN, ROOT / "README.md"], ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_are_accepted(path: Path) -> None:
    install = re.search(
        r"python3 -m venv [^&]+ && \S+ install [^&]+?(?= &&)", (ROOT / "README.md").read_text()
    )
    assert install is not None
    for line, block in blocks(path, "bash"):
        if "python3 -m venv" in block and path.name == "README.md":
            continue
        for command in block.strip().splitlines():
            program, *words = shlex.split(command)
            if program == "python3":
                expected = (
                    install[0].replace("[train]", "[photos]") if path.name == "photographs.md" else install[0]
                )
                assert command == expected, f"{path.name}, line {line}: not README's command"
                continue
            where = f"{path.name}, line {line}"
            if program == ".venv/bin/gridreg":
                check_command(words, where)
                continue
            assert (program, words[0]) == (".venv/bin/python", "examples/few_tensorf_blender.py"), where
            check_command(["train", *words[1:]], where)


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


def test_commands_are_listed() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| (.*) \|$", text_of("command-line.md"), flags=re.M)
    assert dict(rows) == {name: command.about for name, command in COMMANDS.items()}
    assert [name for name, _ in rows] == list(COMMANDS)
    page = text_of("command-line.md")
    shown = set(re.findall(r"gridreg ([a-z][a-z-]*)", page))
    assert shown >= set(COMMANDS)


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
    if protocol.name not in ("holdout8", "all"):
        assert test == ("all" if protocol.test.stride == 1 else f"every {protocol.test.stride}th")


ROOMS = (
    "gridreg",
    "gridreg.rendering",
    "gridreg.scenes",
    "gridreg.training",
    "gridreg.export",
    "gridreg.cli",
)


def documented(directive: str) -> Iterator[object]:
    """What a line `::: name` of the reference shows: an object, or what a module defines."""
    with contextlib.suppress(ModuleNotFoundError):
        module = importlib.import_module(directive)
        imports = (n for n in ast.parse(inspect.getsource(module)).body if isinstance(n, ast.ImportFrom))
        imported = {alias.asname or alias.name for line in imports for alias in line.names}
        yield from (value for name, value in vars(module).items() if name not in imported)
        return
    module_name, _, name = directive.rpartition(".")
    yield getattr(importlib.import_module(module_name), name)


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_in_the_reference(room: str) -> None:
    reference = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md"))
    directives = re.findall(r"^::: (\S+)$", reference, flags=re.M)
    shown = {id(value) for directive in directives for value in documented(directive)}
    package = importlib.import_module(room)
    own = {n: v for n, v in vars(package).items() if n[0] != "_" and not isinstance(v, ModuleType)}
    names = getattr(package, "__all__", own)
    assert len(names) > 2
    missing = [name for name in names if id(getattr(package, name)) not in shown]
    assert not missing, f"{room}: {missing} are nowhere in docs/api/"
