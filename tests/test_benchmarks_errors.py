"""The image of a view, of what runs make of it, and of their errors."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from gridreg.cli import run_cli
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training.images import save_png, to_uint8
from gridreg.training.outputs import error_map
from tests.programs import ROOT, module_at


@pytest.fixture(scope="module")
def program():
    return module_at(ROOT / "benchmarks" / "error_images.py")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A scene, and the folders of two runs: one is the target itself, the other is black."""
    folder = tmp_path_factory.mktemp("kept")
    path = builtin_scene(tmp_path_factory.mktemp("data"), size=32)
    scene = load_scene(path, "builtin8", test=[0, 1, 2])
    for run, factor in (("good", 1.0), ("black", 0.0)):
        test = folder / f"{path.name}-builtin8-{run}-seed0" / "test"
        test.mkdir(parents=True)
        images = {}
        for place, name in enumerate(scene.test.names):
            rgba = scene.test.rgba[place]
            target = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * scene.background
            save_png(test / f"{name}.png", to_uint8(factor * target))
            images[name] = {"psnr": float(place)}
        (test.parent / "metrics.json").write_text(json.dumps({"images": images}))
    return path, folder, scene


def call(program, monkeypatch, path: Path, folder: Path, into: Path, *more: str) -> int:
    words = [
        "--data",
        str(path.parent),
        "--scene",
        path.name,
        "--kept",
        str(folder),
        "--protocol",
        "builtin8",
    ]
    monkeypatch.setattr(sys, "argv", ["error_images.py", *words, "--into", str(into), "--size", "96", *more])
    return run_cli(program.main)


def test_the_median_view_with_its_target_renders_and_errors(program, kept, monkeypatch, tmp_path, capsys):
    path, folder, scene = kept
    assert call(program, monkeypatch, path, folder, tmp_path, "--runs", "good", "black") == 0
    middle = scene.test.names[1]
    found = imageio.imread(tmp_path / f"{path.name}-{middle}.png")
    assert str(tmp_path / f"{path.name}-{middle}.png") in capsys.readouterr().out
    half = found.shape[0] // 2
    # Pixels of 3 by 3, with gaps of 4 between images.
    target, good, black = (found[half - 96 : half : 3, x : x + 96 : 3] for x in (0, 100, 200))
    np.testing.assert_array_equal(target, good)
    assert black.max() == 0
    of_good, of_black = (found[2 * half - 96 :: 3, x : x + 96 : 3] for x in (100, 200))
    rgba = scene.test.rgba[1]
    exact = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * scene.background
    np.testing.assert_array_equal(of_black, error_map(0 * exact, exact))
    # Eight bits a channel are all that is left of the good one's errors.
    assert int(of_good.max()) <= int(error_map(exact, exact).max()) + 4


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--runs", "none"], "found no finished run"),
        (["--runs", "good", "--size", "32"], "--size: found 32, expected at least 64"),
        (["--runs", "good", "--view", "r_99"], "--view: found 'r_99', expected one of"),
    ],
)
def test_what_is_missing_is_named(program, kept, monkeypatch, tmp_path, capsys, more, message):
    path, folder, _ = kept
    assert call(program, monkeypatch, path, folder, tmp_path, *more) == 2
    assert message in capsys.readouterr().err
