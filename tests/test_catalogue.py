"""The catalogue page is what the docstrings say, and every regularizer has a complete row."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

import gridreg
from gridreg.base import REGISTRY, Regularizer
from tests.programs import ROOT, module_at


@pytest.fixture(scope="module")
def catalogue() -> ModuleType:
    return module_at(ROOT / "docs" / "make_catalogue.py")


def own_classes() -> list[type[Regularizer]]:
    return [cls for cls in REGISTRY.values() if cls.__module__.startswith("gridreg.")]


def test_the_page_is_up_to_date(catalogue: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    status = catalogue.main(["--check"])
    assert status == 0, capsys.readouterr().out
    assert "up to date" in capsys.readouterr().out


@pytest.mark.parametrize("cls", own_classes(), ids=lambda cls: cls.__name__)
def test_every_regularizer_has_a_complete_row(catalogue: ModuleType, cls: type[Regularizer]) -> None:
    row = catalogue.row_of(cls)
    cells = row.replace("\\|", "").strip("| ").split(" | ")
    assert len(cells) == 4
    assert cells[2].count("$") == 2
    assert all(cell.strip() for cell in cells)
    assert row in catalogue.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("FrequencyMask", "F"),
        ("FourierLowPass", "P"),
        ("OcclusionLoss", "L"),
        ("TotalVariation", "L"),
        ("SampleSpaceAnnealing", "S"),
        ("RandomBackground", "D"),
        ("WeightDecay", "O"),
        ("DistanceGradientScaling", "F"),
    ],
)
def test_kinds(catalogue: ModuleType, name: str, kind: str) -> None:
    assert catalogue.kind_of(REGISTRY[name]) == kind


def test_a_stale_page_is_found_and_rewritten(
    catalogue: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "catalogue.md"
    monkeypatch.setattr(catalogue, "PAGE", page)
    assert catalogue.main(["--check"]) == 1
    page.write_text("old", encoding="utf-8")
    assert catalogue.main(["--check"]) == 1
    assert page.read_text(encoding="utf-8") == "old"
    assert catalogue.main([]) == 0
    assert catalogue.main(["--check"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["catalogue.md"]


def test_a_docstring_without_a_source_is_refused(catalogue: ModuleType) -> None:
    @dataclass(frozen=True)
    class Nameless(gridreg.Regularizer):
        """Does nothing.

        Formula: ``0``
        """

    assert catalogue.entry_of(Nameless, "Formula") == "``0``"
    with pytest.raises(SystemExit, match="Nameless: its docstring has no line 'Source"):
        catalogue.entry_of(Nameless, "Source")
