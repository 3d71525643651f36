"""The plan of the source: who may import whom, how large a room may be, and words that are not used."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = sorted(path for room in ("gridreg", "backbones") for path in (ROOT / room).rglob("*.py"))
TOOLKIT = ("attach", "regularizers", "compositions")
#: What a room may import, besides itself. Arrows point one way; see docs/architecture.md.
ARROWS: dict[str, set[str]] = {
    "ground": set(),
    "ops": {"ground"},
    "toolkit": {"ops", "ground"},
    "rendering": {"toolkit", "ops", "ground"},
    "scenes": {"rendering", "toolkit", "ground"},
    "training": {"rendering", "scenes", "toolkit", "ops", "ground"},
    "export": {"training", "rendering", "scenes", "toolkit", "ops", "ground"},
    "ablation": {"training", "export", "rendering", "scenes", "toolkit", "ops", "ground"},
    "cli": {"ablation", "export", "training", "rendering", "scenes", "toolkit", "ops", "ground"},
    "adapters": {"training", "rendering", "scenes", "toolkit", "ops", "ground"},
    "backbones": {"toolkit", "ops", "ground"},
}
#: Files that everybody may import, and that import nothing of ours but each other.
GROUND = ("errors", "machine", "encodings")
#: Words that HOUSE's vocabulary replaced by the field's own.
WORDS = re.compile(r"\b(pictures?|films?|filmed|speakers?|walked|faint)\b", re.IGNORECASE)


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def room_of(module: str) -> str:
    parts = module.split(".")
    if parts[0] == "backbones":
        return "backbones"
    if len(parts) == 1 or parts[1] in TOOLKIT:
        return "toolkit"
    if parts[1] in GROUND:
        return "ground"
    return "cli" if parts[1] == "__main__" else parts[1] if parts[1] in ARROWS else "toolkit"


MODULES = {name_of(path): path for path in SOURCE}


def imports(path: Path) -> Iterator[str]:
    """Modules of ours that a file imports, at its top or later, but for those that only types need."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in MODULES else node.module


GRAPH = {
    name: {module for module in imports(path) if module in MODULES and module != name}
    for name, path in MODULES.items()
}


def lines_of(*folders: str) -> int:
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def test_arrows_point_one_way() -> None:
    against = [
        f"{name} -> {target}"
        for name, targets in GRAPH.items()
        for target in targets
        if room_of(target) not in ARROWS[room_of(name)] | {room_of(name)}
    ]
    assert not against


def test_no_two_files_import_each_other() -> None:
    assert not [(a, b) for a in GRAPH for b in GRAPH[a] if a < b and a in GRAPH[b]]


def test_there_is_no_import_circle() -> None:
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for target in sorted(GRAPH[name]):
                visit(target, (*path, name))
            done.add(name)

    for name in GRAPH:
        visit(name, ())


def test_the_toolkit_needs_four_packages() -> None:
    allowed = {"torch", "numpy", "einops", "yaml", "gridreg"} | set(sys.stdlib_module_names)
    for name, path in MODULES.items():
        if room_of(name) in ("toolkit", "ground"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                found = (
                    [alias.name for alias in node.names]
                    if isinstance(node, ast.Import)
                    else [node.module or ""]
                    if isinstance(node, ast.ImportFrom)
                    else []
                )
                assert {module.split(".")[0] for module in found} <= allowed, f"{name}: {found}"


def test_first_level() -> None:
    found = {path.name for path in (ROOT / "gridreg").iterdir()} - {"__pycache__"}
    assert len(found | {"backbones", "benchmarks"}) <= 25


def test_size_of_files() -> None:
    folders = ("gridreg", "backbones", "benchmarks", "docs", "examples")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 100
    assert not [path for path in paths if len(path.read_text(encoding="utf-8").splitlines()) > 300]


def test_there_are_few_lines_of_source_for_a_line_of_test() -> None:
    assert lines_of("tests") >= 0.83 * lines_of("gridreg", "backbones")


def docstrings(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def test_docstrings_open_with_what_is_returned_or_done() -> None:
    against = [
        f"{name}: {text.splitlines()[0]}"
        for name, path in MODULES.items()
        for text in docstrings(path)
        if re.match(r"(What|Which|How|Of|Where|Who|Whose)\b", text)
    ]
    assert not against


def test_words_of_the_field() -> None:
    against = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in [*SOURCE, *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if WORDS.search(line)
    ]
    assert not against


#: A term that a user of TensoRF, nerfacc, nerfstudio or FreeNeRF searches for, and the folder where it leads to.
TERMS = {
    "raw2alpha": "gridreg/ops",
    "TVLoss": "gridreg/regularizers",
    "early_stop": "gridreg/ops",
    "scatter_add": "gridreg/ops",
    "upsample": "backbones",
    "DataParser": "gridreg/scenes",
    "parametrize": "gridreg/attach",
    "occ_reg": "gridreg/regularizers",
}


@pytest.mark.parametrize("term", TERMS)
def test_terms_of_peers_lead_to_the_place(term: str) -> None:
    found = subprocess.run(
        ["grep", "-rl", "--include=*.py", term, "gridreg", "backbones"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert any(path.startswith(TERMS[term]) for path in found), found


def test_the_map_is_short_and_names_every_room() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 900
    rooms = sorted(path.parent.name for path in (ROOT / "gridreg").glob("*/__init__.py"))
    missing = [room for room in rooms if f"`gridreg/{room}/`" not in text]
    assert not missing
    for place in re.findall(r"`((?:gridreg|tests|docs|backbones|ops)/[\w/.]*)`", text):
        assert (ROOT / place).exists() or (ROOT / "gridreg" / place).exists(), place
