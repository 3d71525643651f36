"""`gridreg reconstruct`: photographs in, everything out, and going on where it stopped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gridreg.cli import main
from gridreg.cli.runs import photographs_of
from gridreg.export.page import write_page
from gridreg.scenes import builtin_photographs

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_photographs(tmp_path_factory.getbasetemp() / "scenes", count=6, size=400)


def test_photographs_become_a_page(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A mesh takes its time, and there is none after six steps.
    monkeypatch.setattr(
        "gridreg.cli.train.draw_run", lambda run, mesh, video: [write_page(run.out, run.scene)]
    )
    out = tmp_path / "out"
    words = ["reconstruct", str(made / "photographs"), str(out), "--steps", "6", "--longest-edge", "80"]
    words += ["--preset", "cp_quick"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "6 of 6 photographs placed by markers" in said.err
    assert "6 of 6 images have cameras" in said.out
    assert {"scene", "checkpoint", "metrics.json", "index.html"} <= {path.name for path in out.iterdir()}
    content = json.loads((out / "scene/transforms.json").read_text())
    assert content["gridreg"]["unit"] == "metre"
    assert all(frame["w"] == frame["h"] == 80 for frame in content["frames"])
    before = (out / "scene/transforms.json").stat().st_mtime_ns, (out / "metrics.json").stat().st_mtime_ns
    assert main(words) == 0
    assert "scene: is there already and is used as it is" in capsys.readouterr().out
    assert (out / "scene/transforms.json").stat().st_mtime_ns == before[0]
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["steps"] == 6
    # Of so few none is held out, and everything that shows the score says so.
    assert (len(metrics["train_views"]), metrics["test_views"], metrics["trained_on"]) == (6, 1, 1)
    assert "1 of 1 test views are trained on" in said.err
    assert "mean of 1 test view (1 of them trained on)" in said.out
    assert main(["eval", str(out), "--out", str(tmp_path / "again")]) == 0
    assert "mean of 1 test view (1 of them trained on)" in capsys.readouterr().out
    for folder in (out, tmp_path / "again"):
        page = (folder / "index.html").read_text()
        assert "Views that were trained on" in page
        assert "One view that was trained on" in page


def test_photographs_are_held_out_where_that_is_wanted_or_there_are_enough(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = []
    monkeypatch.setattr("gridreg.cli.train.run", lambda options: chosen.append(options.protocol) or 0)
    scene = tmp_path / "out/scene"
    assert main(["reconstruct", str(made / "photographs"), str(tmp_path / "out"), "--hold-out"]) == 0
    content = json.loads((scene / "transforms.json").read_text())
    for count in (23, 24):
        frames = [dict(content["frames"][0], file_path=f"images/{i}.jpg") for i in range(count)]
        for frame in frames:
            (scene / frame["file_path"]).touch()
        (scene / "transforms.json").write_text(json.dumps(content | {"frames": frames}))
        assert main(["reconstruct", "unused", str(tmp_path / "out")]) == 0
    assert chosen == ["holdout8", "all", "holdout8"]


def test_bad_input_comes_before_the_work(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photographs, out = str(made / "photographs"), str(tmp_path / "out")
    assert main(["reconstruct", photographs, out, "--preset", "quik"]) == 2
    assert "'quik'" in capsys.readouterr().err
    assert main(["reconstruct", str(tmp_path / "none"), out]) == 2
    assert "none: no such folder of images" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_word_builtin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    asked: list[Path] = []
    monkeypatch.setattr(
        "gridreg.cli.runs.builtin_photographs", lambda folder: asked.append(folder) or Path("made")
    )
    assert photographs_of(Path("builtin")) == Path("made/photographs")
    assert asked == [Path("outputs")]
    assert photographs_of(Path("mine")) == Path("mine")
    (tmp_path / "builtin").mkdir()
    assert photographs_of(Path("builtin")) == Path("builtin")
