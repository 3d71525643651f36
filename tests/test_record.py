"""What metrics.json says of a run, and of the machine."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.training.files import write_json
from gridreg.training.metrics import image_metrics
from gridreg.training.record import metrics_record, summary
from gridreg.training.versions import cpu_model, package_version, versions


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(30, 40, 3, generator=generator)
    return (target + 0.2 * torch.rand(30, 40, 3, generator=generator)).clamp(0, 1), target


def record(pair: tuple[Tensor, Tensor], **changes: object) -> dict[str, object]:
    image, target = pair
    views = {"r_0": image_metrics(image, target), "r_8": image_metrics(target, target)}
    options: dict[str, object] = {
        "scene": "lego",
        "protocol": "dietnerf8",
        "builtin": False,
        "seed": 3,
        "steps": 100,
        "seconds": {"train": 1.5, "test": 0.25},
        "config": {"until": math.inf, "resample_at": (2, 3)},
        "command": ["few_tensorf_blender.py", "--steps", "100"],
    }
    return metrics_record(views, **{**options, **changes})  # type: ignore[arg-type]


def test_metrics_record_says_all_it_takes_to_judge_it(tmp_path, pair):
    write_json(tmp_path / "metrics.json", record(pair, carved=True))
    saved = json.loads((tmp_path / "metrics.json").read_text())
    assert list(saved) == sorted(saved)
    assert saved["benchmark"] is True
    assert saved["builtin"] is False
    assert saved["scene"] == "lego"
    assert saved["protocol"] == "dietnerf8"
    assert saved["test_views"] == 2
    assert saved["carved"] is True
    assert saved["seconds"] == {"train": 1.5, "test": 0.25}
    assert saved["config"] == {"until": "inf", "resample_at": [2, 3]}
    assert saved["images"]["r_8"]["psnr"] == "inf"
    assert saved["mean"]["psnr"] == "inf"
    ssim = [saved["images"][name]["ssim_uniform"] for name in ("r_0", "r_8")]
    assert saved["mean"]["ssim_uniform"] == pytest.approx(np.mean(ssim), abs=1e-15)
    assert set(saved["conventions"]) == set(saved["mean"]) == {"psnr", "ssim_gaussian", "ssim_uniform"}
    assert {"gridreg", "torch", "numpy", "numba", "python", "cpu", "threads"} <= set(saved["versions"])


def test_the_built_in_scene_is_never_a_benchmark(pair):
    saved = record(pair, builtin=True, scene="builtin")
    assert saved["benchmark"] is False
    assert saved["builtin"] is True
    assert "no benchmark" in str(saved["scene"])


def test_further_metrics_bring_their_convention():
    saved = metrics_record(
        {"r_0": {"psnr": 20.0, "lpips_vgg": 0.1}},
        scene="lego",
        protocol="gs8",
        builtin=False,
        seed=0,
        steps=1,
        seconds={},
        config={},
        conventions={"lpips_vgg": "VGG16, inputs in [-1, 1]"},
    )
    assert saved["conventions"]["lpips_vgg"] == "VGG16, inputs in [-1, 1]"
    assert "ssim_gaussian" not in saved["conventions"]


def test_a_run_without_test_views_has_no_metrics():
    with pytest.raises(InputError, match="no image was evaluated"):
        metrics_record({}, scene="x", protocol="y", builtin=False, seed=0, steps=1, seconds={}, config={})


def test_versions_are_those_that_run():
    found = versions()
    assert found["torch"] == torch.__version__
    assert found["numpy"] == np.__version__
    assert found["threads"] == torch.get_num_threads()
    assert int(found["cores"]) >= 1
    assert package_version("no-such-package-anywhere") == "not installed"


def test_cpu_model_is_read_or_replaced_by_the_architecture(tmp_path: Path):
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Some  CPU @ 2 GHz\n")
    assert cpu_model(tmp_path / "cpuinfo") == "Some CPU @ 2 GHz"
    (tmp_path / "cpuinfo").write_text("processor\t: 0\n")
    assert cpu_model(tmp_path / "cpuinfo") == cpu_model(tmp_path / "missing") != ""


def test_the_summary_names_scene_protocol_and_what_it_is_the_mean_of():
    views = {"r_0": {"psnr": 20.0, "ssim_gaussian": 0.5}, "r_8": {"psnr": 30.0, "ssim_gaussian": 0.75}}
    told = {
        "scene": "lego",
        "protocol": "gs8",
        "builtin": False,
        "seed": 0,
        "steps": 1,
        "seconds": {},
        "config": {},
    }
    expected = "lego, gs8: mean of 2 test views: PSNR 25.00 dB, SSIM 0.6250 (11x11 Gaussian)"
    assert summary(metrics_record(views, **told)) == expected
    one = summary(metrics_record({"r_0": views["r_0"]}, **{**told, "builtin": True}))
    assert (
        one
        == "lego (built-in, no benchmark), gs8: mean of 1 test view: PSNR 20.00 dB, SSIM 0.5000 (11x11 Gaussian)"
    )
