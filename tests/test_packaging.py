"""The package as an index and its users see it."""

from __future__ import annotations

import re
import subprocess
import sys
import types
from typing import Any

import pytest

from tests.programs import ROOT, module_at

PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_classifiers_name_the_versions_of_python_and_types() -> None:
    named = set(re.findall(r'"Programming Language :: Python :: (3\.\d+)"', PROJECT))
    assert named == {"3.10", "3.11", "3.12", "3.13"}
    assert 'requires-python = ">=3.10"' in PROJECT
    assert "Typing :: Typed" in PROJECT
    assert (ROOT / "gridreg" / "py.typed").is_file()


def test_links_of_the_readme_work_without_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of hatchling, which is there only while the package is built.
    name = "hatchling.metadata.plugin.interface"
    parts = [name.rsplit(".", count)[0] for count in (3, 2, 1, 0)]
    modules: Any = {part: types.ModuleType(part) for part in parts}
    modules[name].MetadataHookInterface = object
    for part, module in modules.items():
        monkeypatch.setitem(sys.modules, part, module)
    absolute = module_at(ROOT / "hatch_build.py").absolute
    assert "](docs/" in README
    there = absolute(README, "https://host/name")
    assert "](https://host/name/raw/main/docs/images/reconstruction.webp)" in there
    assert "](https://host/name/blob/main/docs/own-field.md)" in there
    for text in (there, absolute(README, "")):
        assert all("://" in place for place in re.findall(r"\]\(([^)]+)\)", text))
        assert "gridreg.apply(" in text


def test_versions_refuses_what_it_does_not_know() -> None:
    done = subprocess.run([ROOT / ".ci" / "versions", "ancient"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == ".ci/versions: found 'ancient', expected oldest, newest or toolkit\n"


def test_every_dependency_has_a_lowest_version_that_can_be_tested() -> None:
    for table in ("dependencies", "train"):
        block = re.search(rf"^{table} = \[\n(.*?)^\]", PROJECT, re.S | re.M)
        assert block is not None
        for line in re.findall(r'^ *"(.*)",$', block[1], re.M):
            assert re.fullmatch(r"[A-Za-z0-9-]+>=[0-9.]+", line), line
