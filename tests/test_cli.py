"""The command line as a newcomer meets it: help, versions, completion, and every command on a small run."""

from __future__ import annotations

import ast
import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.cli import COMMANDS, main, run_cli
from gridreg.cli.main import options_of, overview
from gridreg.errors import InputError
from gridreg.export import read_mesh
from gridreg.scenes import builtin_scene
from gridreg.training import load_run
from gridreg.training.files import one_writer

SMALL = [
    *("--steps", "60", "--no-video", "--no-mesh", "--set"),
    *(
        "train.rays=128",
        "train.voxels_start=4096",
        "train.voxels_end=8000",
        "train.resample_at=[30]",
        "train.learning_rate_grid=0.1",
    ),
    *("train.occupancy_resolution=24", "field.density_components=4", "field.appearance_components=4"),
]


def lines_of(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small built-in scene and a run on it, made by the command line itself."""
    folder = tmp_path_factory.mktemp("desk")
    scene = builtin_scene(folder, size=32)
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert main(["train", "--scene", str(scene), "--out", "run", *SMALL]) == 0
    finally:
        os.chdir(before)
    return folder


@pytest.fixture(autouse=True)
def _at_the_desk(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)


# --- the overview


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_overview_names_every_command(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^  {name} +\S", text, flags=re.M) for name in COMMANDS)
    assert text.strip() == overview()


def test_overview_loads_no_room() -> None:
    code = (
        "import sys; from gridreg.cli import main; main(['--help']); main(['--version']);"
        "print([m for m in sys.modules if m.startswith('gridreg.')], 'matplotlib' in sys.modules)"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    loaded = printed.splitlines()[-1]
    assert loaded.endswith("False")
    assert not re.search(r"gridreg\.(scenes|rendering|training|export|ablation)", loaded)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == main(["-V"]) == 0
    assert re.fullmatch(r"(gridreg \d+\.\d+\.\d+\S*\n){2}", capsys.readouterr().out)


def test_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gridreg", "nonsense"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1


def test_unknown_command_suggests_the_near_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trian"]) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: command: found 'trian'")
    assert "did you mean 'train'?" in text
    assert len(lines_of(text)) == 1


@pytest.mark.parametrize("name", COMMANDS)
def test_help_names_every_option_with_its_meaning(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as status:
        main([name, "--help"])
    assert status.value.code == 0
    text = capsys.readouterr().out
    assert f"gridreg {name}" in text
    if options_of(name).__module__.startswith("gridreg.cli"):
        assert "None" not in text
    for field in fields(options_of(name)):
        option = f"--{field.name.replace('_', '-')}"
        # Positional ones have their names in capitals.
        assert option in text or field.name.rstrip("s").upper() in text.upper(), field.name


def test_every_option_is_documented() -> None:
    for name in COMMANDS:
        cls = options_of(name)
        assert cls.__doc__
        source = Path(sys.modules[cls.__module__].__file__ or "").read_text(encoding="utf-8")
        body = next(
            node.body
            for node in ast.parse(source).body
            if isinstance(node, ast.ClassDef) and node.name == cls.__name__
        )
        explained = {
            first.target.id
            for first, second in pairwise(body)
            if isinstance(first, ast.AnnAssign)
            and isinstance(first.target, ast.Name)
            and isinstance(second, ast.Expr)
            and isinstance(second.value, ast.Constant)
        }
        assert explained == {field.name for field in fields(cls)}, name


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as status:
        main(["--tyro-print-completion", shell])
    assert not status.value.code
    script = capsys.readouterr().out
    assert all(name in script for name in COMMANDS)
    assert "--min-component" in script
    assert "--protocol" in script


# --- how a program ends


def raising(error: BaseException) -> int:
    raise error


def test_exit_status_of_bad_input_and_of_interruption(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(lambda: 3) == 3
    assert run_cli(lambda: raising(InputError("scene: found none"))) == 2
    assert capsys.readouterr().err == "error: scene: found none\n"
    assert run_cli(lambda: raising(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "stopped\n"
    with pytest.raises(ValueError, match="a defect"):
        run_cli(lambda: raising(ValueError("a defect")))


def test_a_reader_that_has_seen_enough() -> None:
    command = f"'{sys.executable}' -m gridreg --help | head -n 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 1


# --- the commands


def test_train_says_where_things_are(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = desk / "run"
    assert {"config.yaml", "checkpoint", "metrics.json", "test.png", "curves.png"} <= {
        path.name for path in out.iterdir()
    }
    record = json.loads((out / "metrics.json").read_text())
    assert record["protocol"] == "builtin8"
    assert record["command"][0] == "gridreg"
    assert main(["train", "--scene", "lighthouse_32", "--out", "run", *SMALL]) == 2
    text = capsys.readouterr().err
    assert "holds a run already" in text


def test_eval_gives_the_same_score(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "run", "--out", "again"]) == 0
    first = json.loads((desk / "run/metrics.json").read_text())
    second = json.loads((desk / "again/metrics.json").read_text())
    assert second["mean"] == pytest.approx(first["mean"], abs=1e-6)
    assert second["images"].keys() == first["images"].keys()
    printed = lines_of(capsys.readouterr().out)
    assert f"PSNR {first['mean']['psnr']:.2f} dB" in printed[-1]
    assert len(printed) == first["test_views"] + 1
    assert (desk / "again/test/r_0_compare.png").is_file()
    assert (desk / "again/test.png").is_file()
    assert "photograph of r_0" in (desk / "again/index.html").read_text()
    # The checkpoint itself may be named, too.
    assert main(["eval", "run/checkpoint", "--scene", "lighthouse_32"]) == 0


def test_mesh_and_its_comparison(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mesh", "run", "--resolution", "40"]) == 0
    printed = capsys.readouterr().out
    assert re.match(r"run/mesh\.ply: \d+ vertices, \d+ faces, watertight, volume \d", printed)
    mesh = read_mesh(desk / "run/mesh.ply")
    assert mesh.watertight
    assert mesh.volume > 0
    assert main(["mesh", "run", "--resolution", "24", "--no-colours", "--out", "plain.obj"]) == 0
    capsys.readouterr()
    assert (
        main(["compare-mesh", "run/mesh.ply", "plain.obj", "--samples", "2000", "--out", "figures.json"]) == 0
    )
    assert capsys.readouterr().out.startswith("Chamfer distance")
    assert 0 < json.loads((desk / "figures.json").read_text())["chamfer_relative"] < 0.1
    assert main(["compare-mesh", "run/mesh.ply", "builtin", "--samples", "2000"]) == 0
    assert "Normal consistency" in capsys.readouterr().out
    box = ["--crop", "-1.5", "-1.5", "0", "1.5", "1.5", "1.5"]
    assert main(["mesh", "run", "--resolution", "24", "--out", "upper.ply", *box]) == 0
    assert "units of the scene's files, whose length is not known" in capsys.readouterr().out
    assert read_mesh(desk / "upper.ply").vertices[:, 2].min() >= -1e-6
    assert main(["mesh", "run", "--base", "5"]) == 2
    assert "not one on the sheet" in capsys.readouterr().err


def test_page_of_a_run(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Training, and a score with a folder, have made one.
    assert 'id="score"' in (desk / "run/index.html").read_text()
    (desk / "run/index.html").unlink()
    assert main(["page", "run"]) == 0
    assert re.match(r"run/index\.html: \d+\.\d MB\n", capsys.readouterr().out)
    text = (desk / "run/index.html").read_text()
    assert text.count('alt="photograph ') - text.count('alt="photograph of') == 8
    assert main(["page", "nowhere"]) == 2


def test_render_films_and_frames(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "run", "--frames", "3", "--width", "24", "--out", "frames"]) == 0
    assert "frames: 3 frames of 24x24" in capsys.readouterr().out
    pictures = sorted((desk / "frames").iterdir())
    assert len(pictures) == 3
    with Image.open(pictures[0]) as picture:
        assert picture.size == (24, 24)
    words = ["render", "run", "run", "--path", "train", "--modes", "rgb", "opacity"]
    assert main([*words, "--frames", "2", "--width", "16", "--out", "two"]) == 0
    with Image.open(sorted((desk / "two").iterdir())[0]) as picture:
        two = np.asarray(picture)
    assert two.shape == (16, 64, 3)
    # The same run twice, side by side.
    assert np.array_equal(two[:, :32], two[:, 32:])
    assert main(["render", "run", "--frames", "2", "--width", "16", "--path", "spiral"]) == 0
    assert (desk / "run/spiral.mp4").stat().st_size > 500


def test_render_without_its_scene_follows_the_box(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "lighthouse_32").rename(desk / "elsewhere")
    try:
        words = ["render", "run", "--frames", "1", "--width", "16", "--out"]
        assert main([*words, "lost"]) == 0
        assert "not there any more" in capsys.readouterr().err
        assert main(["eval", "run"]) == 2
        assert "say with --scene where it lies now" in capsys.readouterr().err
        assert main([*words, "found", "--scene", "elsewhere"]) == 0
    finally:
        (desk / "elsewhere").rename(desk / "lighthouse_32")


def test_masks_that_are_not_open_yet_stay_closed(desk: Path) -> None:
    mask = "composition:\n  - {name: FixedMask, site: density, visible_ratio: 0.25}\n"
    (desk / "masked.yaml").write_text(mask)
    words = ["--scene", "lighthouse_32", "--config", "masked.yaml", "--out", "closed"]
    assert main(["train", *words, *SMALL]) == 0
    run = load_run("closed")
    x = run.field.bounds.mean(dim=0) + 0.2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    masked = run.field.density(x)
    assert run.handle.current_step == run.step == 60
    run.handle.remove()
    assert not torch.equal(run.field.density(x), masked)


def test_bench_lists_and_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench"]) == 0
    assert re.search(r"^quality +\S", capsys.readouterr().out, flags=re.M)
    assert main(["bench", "nonsense"]) == 2
    assert "found 'nonsense', expected one of" in capsys.readouterr().err
    # A checkout that one stands in, when gridreg is installed without benchmarks.
    monkeypatch.setattr("gridreg.__file__", str(tmp_path / "site-packages" / "gridreg" / "__init__.py"))
    monkeypatch.chdir(tmp_path)
    assert main(["bench"]) == 2
    text = capsys.readouterr().err
    assert "without its benchmarks" in text
    assert len(lines_of(text)) == 1
    (tmp_path / "gridreg").mkdir()
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "pyproject.toml").write_text("")
    program = '"""Adds up.\n\nMore."""\nimport sys\nassert __name__ == "__main__"\n'
    program += "print(sum(map(int, sys.argv[1:])))\nsys.exit(7)\n"
    (tmp_path / "benchmarks/adds.py").write_text(program)
    (tmp_path / "benchmarks/quiet.py").write_text("value = __name__ == '__main__'\n")
    (tmp_path / "benchmarks/shared.py").write_text("value = 1\n")
    before = sys.argv[:]
    assert main(["bench"]) == 0
    printed = capsys.readouterr().out
    assert "adds   Adds up." in printed
    assert "shared" not in printed
    assert main(["bench", "adds", "2", "3"]) == 7
    assert capsys.readouterr().out == "5\n"
    assert main(["bench", "quiet"]) == 0
    assert sys.argv == before


def test_view_serves_until_it_is_stopped(desk: Path) -> None:
    pytest.importorskip("viser")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "gridreg", "view", "run", "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=desk) as served:
        assert served.stderr is not None
        said = served.stderr.readline()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as page:
            assert page.status == 200
        served.send_signal(signal.SIGINT)
        rest = served.stderr.read()
        assert served.wait(timeout=30) == 0
    assert said == f"viewer: http://127.0.0.1:{port} (reached from this machine only)\n"
    assert "Traceback" not in rest


# --- output that cannot be written, names that a terminal would obey, wrong options

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    (folder / "a.obj").write_text(MESH)
    command = f"{sys.executable} -m gridreg compare-mesh a.obj a.obj --samples 10 {line}"
    return subprocess.run(
        ["bash", "-c", command], cwd=folder, capture_output=True, text=True, env=ENVIRONMENT
    )


ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}


@pytest.mark.parametrize(("line", "status"), [("", 0), (">&-", 0), (">&- 2>&-", 0), ("| true", 0)])
def test_closed_output_is_no_traceback(line: str, status: int, tmp_path: Path) -> None:
    done = shell(line, tmp_path)
    assert (done.returncode, done.stderr) == (status, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device")
def test_a_full_disk_behind_the_output_is_one_line(tmp_path: Path) -> None:
    done = shell(">/dev/full", tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: standard output: cannot write: No space left on device\n"


def test_names_are_escaped_where_they_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    def program() -> int:
        print("title \x1b]0;owned\a of \udcff\r, \x1b[1mbold\x1b[0m and ü³─")
        return 0

    assert run_cli(program) == 0
    assert capsys.readouterr().out == "title \\x1b]0;owned\\x07 of \\udcff\\r, \x1b[1mbold\x1b[0m and ü³─\n"
    assert main(["train", "--scene", "a\nb\x1b[2J"]) == 2
    text = capsys.readouterr().err
    assert len(text.splitlines()) == 1
    assert "a\\nb\\x1b[2J" in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["train", "--stepz", "3"],
            "--stepz, 3; did you mean --steps?; see gridreg train --help",
        ),
        (["train", "--steps", "abc"], "--steps"),
        (["eval"], "RUN"),
        (["render", "run", "--modes", "rbg"], "Expected one of ('rgb', 'depth', 'opacity', 'deviation')"),
    ],
)
def test_a_wrong_option_is_one_line(
    words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert expected in line


def test_a_second_run_in_one_folder_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with one_writer(tmp_path):
        scene = next(Path().glob("*/transforms_train.json")).parent
        words = ["train", "--scene", str(scene), "--out", str(tmp_path), *SMALL]
        child = subprocess.run(
            [sys.executable, "-m", "gridreg", *words],
            capture_output=True,
            text=True,
            env=ENVIRONMENT,
            check=False,
        )
    assert child.returncode == 2
    assert "another run is writing here" in child.stderr


def test_the_backend_of_a_notebook_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    code = "import sys; from gridreg.cli import run_cli; "
    code += "sys.exit(run_cli(lambda: int(__import__('matplotlib') is None)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
