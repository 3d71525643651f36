"""Forward-facing scenes are trained, scored and seen in normalised device coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gridreg.rendering import Camera, Lens, OccupancyGrid, Rays, camera_rays, pixel_rays
from gridreg.scenes import Scene, builtin_scene, load_scene, ndc_rays
from gridreg.training import RunConfig, TrainSettings, build_trainer, execute, load_run
from gridreg.training.evaluate import mean_psnr_of
from gridreg.training.rays import NdcWarp, RayBank, warp_of
from tests.forward_scene import write_forward_scene

SETTINGS = TrainSettings(
    steps=150,
    rays=512,
    voxels_start=24**3,
    voxels_end=32**3,
    resample_at=(80,),
    occupancy_at=(60,),
    shrink_at=(),
    filter_rays_at=(0,),
    occupancy_resolution=32,
    carve=True,
    step_ratio=1.0,
)
FIELD = {"density_components": 6, "appearance_components": 8, "density_shift": None, "width": 24}
CONFIG = RunConfig(
    field=FIELD,
    train=SETTINGS,
    composition=[{"name": "FrequencyMask", "site": "density", "until": 0.3}],
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = write_forward_scene(tmp_path_factory.mktemp("forward") / "lighthouse")
    return load_scene(folder, "holdout8")


def test_no_warp_where_the_world_is_meant(tmp_path: Path) -> None:
    plain = load_scene(builtin_scene(tmp_path, size=16), "builtin8", test=())
    assert warp_of(plain) is None
    bank = RayBank(plain.train)
    chosen = torch.tensor([0, 300])
    rows, columns = torch.tensor([0, (300 % 256) // 16]), torch.tensor([0, 300 % 16])
    views = torch.tensor([0, 1])
    expected = pixel_rays(plain.train.poses[views], plain.train.intrinsics[views], rows, columns)
    assert torch.equal(bank.rays(chosen).origins, expected.origins)
    assert torch.equal(bank.rays(chosen).directions, expected.directions)


def test_rays_of_the_bank_are_mapped(scene: Scene) -> None:
    warp = warp_of(scene)
    assert warp is not None
    bank = RayBank(scene.train, warp)
    rays = bank.rays(torch.arange(32 * 32))
    plain = camera_rays(scene.train.poses[0], scene.train.intrinsics[0], 32, 32)
    origins, directions = ndc_rays(plain.origins, plain.directions, scene.train.intrinsics[0], 32, 32)
    torch.testing.assert_close(rays.origins, origins)
    torch.testing.assert_close(rays.directions, directions)
    # They start on the near plane and are of unit length.
    torch.testing.assert_close(rays.origins[:, 2], torch.full((1024,), -1.0))
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(1024))


def test_a_mapped_point_lies_on_the_mapped_ray(scene: Scene) -> None:
    warp = warp_of(scene)
    assert warp is not None
    plain = camera_rays(scene.train.poses[2], scene.train.intrinsics[2], 32, 32)[::37]
    mapped = warp(plain)
    point = (plain.origins + 2.5 * plain.directions).double().numpy()
    # The projection matrix of a camera with the near plane at 1 and the far plane at infinity (appendix C).
    fx, fy = warp.intrinsics[:2]
    x, y, z = point.T
    expected = np.stack([-2 * fx / 32 * x / z, -2 * fy / 32 * y / z, 1 + 2 / z], axis=-1)
    away = expected - mapped.origins.double().numpy()
    along = (away * mapped.directions.double().numpy()).sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(away, along * mapped.directions.double().numpy(), atol=1e-5)
    assert (along > 0).all()


def test_rays_that_look_back_meet_nothing() -> None:
    warp = NdcWarp((30.0, 30.0, 16.0, 16.0), 32, 32)
    back = Rays(torch.zeros(3, 3), torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]]))
    mapped = warp(back)
    assert torch.isfinite(mapped.origins).all()
    assert torch.isfinite(mapped.directions).all()
    assert (mapped.origins[:2, 2] < -1).all()
    assert (mapped.directions[:2, 2] < 0).all()
    assert mapped.origins[2, 2] == -1


def test_training_in_normalised_coordinates(scene: Scene, tmp_path: Path) -> None:
    # Carving asked for by a preset is left out: silhouettes mean nothing to these cells.
    run, metrics = execute(CONFIG, scene, tmp_path / "out")
    assert metrics is not None
    assert not run.trainer.space.carves
    flat = scene.train.composited("white").mean(dim=(0, 1, 2))
    baseline = -10 * torch.log10((scene.test.composited("white") - flat).square().mean())
    assert metrics["mean"]["psnr"] > float(baseline) + 3
    assert metrics["mean"]["psnr"] > 20

    loaded = load_run(tmp_path / "out")
    assert loaded.warp == warp_of(scene)
    again = mean_psnr_of(loaded, scene.test)
    assert again == pytest.approx(metrics["mean"]["psnr"], abs=1e-4)
    unwarped = mean_psnr_of(replace(loaded, warp=None), scene.test)
    assert unwarped < again - 3


def test_pictures_do_not_depend_on_chunks(scene: Scene) -> None:
    trainer = build_trainer(replace(CONFIG, composition=[]), scene)
    view = scene.test
    camera = Camera(view.poses[0], Lens.from_tensor(view.intrinsics[0], view.height, view.width))
    full = OccupancyGrid.full(trainer.field.bounds, (8, 8, 8))
    model = replace(trainer.model, occupancy=full)
    pictures = [model.render(camera, chunk=chunk).colour for chunk in (100, 4096)]
    torch.testing.assert_close(pictures[0], pictures[1])
