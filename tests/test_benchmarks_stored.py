"""Stored figures: one file of JSON lines a study, and nothing lost by two programs that write at once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gridreg.errors import InputError
from tests.programs import ROOT, module_at

stored = module_at(ROOT / "benchmarks" / "stored.py")


def test_records_come_back_by_name_and_bit_for_bit(tmp_path: Path) -> None:
    assert stored.load("study", tmp_path) == []
    assert stored.find("study", "a", tmp_path) is None
    # A line separator of Unicode inside a text is no end of a line.
    records = {"b": {"value": 0.1 + 0.2, "text": "α\u2028"}, "a": {"value": 1e-300}}
    for name, record in records.items():
        stored.save("study", name, record, tmp_path)
    assert stored.load("study", tmp_path) == [{"name": name, **records[name]} for name in ("a", "b")]
    stored.save("study", "a", {"value": 2}, tmp_path)
    assert stored.find("study", "a", tmp_path) == {"name": "a", "value": 2}
    assert len(stored.load("study", tmp_path)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["study.jsonl"]


def test_a_number_that_json_does_not_know_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    stored.save("study", "a", {"value": 1}, tmp_path)
    with pytest.raises(ValueError, match="JSON"):
        stored.save("study", "b", {"value": float("nan")}, tmp_path)
    assert stored.load("study", tmp_path) == [{"name": "a", "value": 1}]


@pytest.mark.parametrize("line", ["{", "[1]", "{}", "3"])
def test_a_line_that_is_no_record_is_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "study.jsonl").write_text(f'{{"name": "a"}}\n{line}\n')
    with pytest.raises(InputError, match=r"study\.jsonl:2: found no record"):
        stored.load("study", tmp_path)


def test_two_programs_write_at_once(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; import stored\n"
        "for k in range(15): stored.save('study', f'{sys.argv[1]}{k}', {'k': k}, Path(sys.argv[2]))"
    )
    paths = f"{ROOT}:{ROOT / 'benchmarks'}"
    running = [
        subprocess.Popen(
            [sys.executable, "-c", program, name, str(tmp_path)], env={"PYTHONPATH": paths, "PATH": ""}
        )
        for name in "ab"
    ]
    assert [process.wait(timeout=100) for process in running] == [0, 0]
    assert {record["name"] for record in stored.load("study", tmp_path)} == {
        f"{name}{k}" for name in "ab" for k in range(15)
    }


def test_every_stored_record_of_the_project_can_be_read() -> None:
    files = sorted(stored.RESULTS.iterdir())
    assert {path.suffix for path in files} == {".jsonl"}
    for path in files:
        names = [record["name"] for record in stored.load(path.stem)]
        assert names == sorted(set(names))
        assert len(names) == sum(
            1 for line in path.read_text(encoding="utf-8").split("\n") if json.loads(line or "0")
        )
