"""The plain path on another device: nothing mixes devices, and the numbers are those of the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import gridreg
from gridreg.cli import main
from gridreg.export import extract_mesh
from gridreg.machine import choose_device
from gridreg.ops import use_backend
from gridreg.rendering import Camera, Lens
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.scenes.doubts import trained_on
from gridreg.training import RunConfig, TrainSettings, build_trainer, load_run, resume_trainer, save_run
from gridreg.training.presets import load_preset
from tests.fake_device import DEVICE, FakeDevice

SETTINGS = TrainSettings(
    steps=6,
    rays=32,
    reshuffle=True,
    patches=1,
    patch_size=4,
    voxels_start=8**3,
    voxels_end=10**3,
    resample_at=(4,),
    occupancy_at=(2,),
    occupancy_resolution=8,
    shrink_at=(2,),
    filter_rays_at=(3,),
    carve=True,
    step_ratio=2.0,
    merge_weight=0.01,
    average_from=0.5,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=16), "builtin8")


@pytest.fixture
def device() -> Iterator[torch.device]:
    """A CUDA device: the one that is there, or a fake one."""
    if torch.cuda.is_available():
        yield DEVICE
    else:
        with FakeDevice():
            yield DEVICE


def config_of(backbone: str) -> RunConfig:
    site = "density" if backbone != "mlp" else "encoding.position"
    composition = [
        gridreg.FrequencyMask(site, until=0.9),
        gridreg.OcclusionLoss(weight=0.01, distance=0.3),
        gridreg.DistortionLoss(),
        gridreg.DepthSmoothness(weight=0.1),
        gridreg.RayKL(),
        gridreg.ExpectedBackground(until=0.5),
        gridreg.RandomBackground(),
        gridreg.SampleSpaceAnnealing(),
        gridreg.DistanceGradientScaling(),
    ]
    if backbone != "mlp":
        composition += [
            gridreg.TotalVariation(site, share=0.5),
            gridreg.Orthogonality("density.lines"),
            gridreg.L1(site),
            gridreg.ComponentDropout("appearance", p=0.2),
            gridreg.FourierLowPass(site, keep=gridreg.Linear(0.3, 1.0, until=0.9)),
            gridreg.GridBlur("appearance"),
            gridreg.WeightDecay("appearance", decay=0.1),
        ]
    field = load_preset({"vm": "quick", "cp": "cp_quick", "mlp": "freenerf"}[backbone]).field
    small = {key: min(value, 8) if type(value) is int else value for key, value in field.items()}
    train = replace(SETTINGS, carve=backbone == "vm")
    if backbone == "mlp":  # counts as 128 cells across
        train = replace(train, step_ratio=16.0, rays=8)
    return RunConfig(backbone=backbone, field=small, train=train, composition=gridreg.to_config(composition))


def test_views_that_are_trained_on_are_counted_where_scenes_are_split_over_devices(
    scene: Scene, device: torch.device
) -> None:
    there = scene.to(device)
    assert trained_on(there.test, there.train) == 0
    assert trained_on(scene.train, there.train) == len(scene.train)


@pytest.mark.parametrize("backbone", ["vm", "cp", "mlp"])
def test_training_and_rendering(backbone: str, scene: Scene, device: torch.device, tmp_path: Path) -> None:
    config, there = config_of(backbone), scene.to(device)
    ours = build_trainer(config, there)
    with use_backend("torch"):
        theirs = build_trainer(config, scene)
        expected = [theirs.train_step()["loss"] for _ in range(config.train.steps)]
    found = []
    for step in range(config.train.steps):
        found.append(ours.train_step()["loss"])
        if step == 4:
            save_run(tmp_path / "checkpoint", ours, config, {})
    assert found == pytest.approx(expected, rel=1e-4)
    assert all(p.device == device for p in ours.field.parameters())
    assert ours.occupancy.cells.device == device
    resumed, _ = resume_trainer(tmp_path / "checkpoint", config, there)
    assert resumed.train_step()["loss"] == pytest.approx(expected[5], rel=1e-4)
    loaded = load_run(tmp_path / "checkpoint", device)
    camera = Camera(scene.test.poses[0], Lens.from_tensor(scene.test.intrinsics[0], 16, 16))
    image = loaded.render(camera)
    assert image is not None
    assert image.colour.device.type == "cpu"
    with use_backend("torch"):
        torch.testing.assert_close(image.colour, load_run(tmp_path / "checkpoint").render(camera).colour)
    if backbone == "vm":
        assert len(extract_mesh(loaded.field, loaded.occupancy, resolution=8, threshold=1e-3).vertices)


def test_what_the_fake_device_refuses(device: torch.device) -> None:
    there, here = torch.ones(3, device=device), torch.ones(3)
    with pytest.raises(RuntimeError, match="cuda"):
        there + here
    with pytest.raises(TypeError, match="cuda"):
        there.numpy()
    with pytest.raises((RuntimeError, IndexError)):
        here[torch.zeros(1, dtype=torch.long, device=device)]
    assert float((there * torch.tensor(2.0)).sum()) == 6.0
    assert there.to(here).device == here.device
    assert torch.tensor([1.0], device=there.device).device == device


@pytest.mark.parametrize("name", ["cuda", "mps", "tpu"])
def test_a_device_that_is_not_there(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    if name != "tpu" and choose_device("auto").type == name:
        pytest.skip(f"{name} is here")
    assert main(["train", "--device", name]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert name in said


def test_auto_is_a_device_that_is_here() -> None:
    torch.ones(1, device=choose_device("auto"))
