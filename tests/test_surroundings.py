"""What lies outside the box: contracted space, colours behind the field, training, and what reads checkpoints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from gridreg.export.preview import Preview
from gridreg.rendering import CONTRACTED, Rays, Rendered, Surroundings, camera_rays, contract
from gridreg.scenes import Scene, Views, builtin_scene, load_scene
from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.focus import focus_extent, surround_focus
from gridreg.training import RunConfig, build_trainer, execute, load_run, save_ensemble
from gridreg.training.evaluate import mean_psnr_of
from gridreg.training.run import resume_trainer, save_run
from tests.tiny_training import NO_EVENTS

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
CONFIG = RunConfig(
    field={"density_components": 4, "appearance_components": 4, "density_shift": None, "decoder": "rgb"},
    train=replace(NO_EVENTS, steps=60, rays=256),
)


def sky(directions: Tensor) -> Tensor:
    return 0.5 + 0.4 * directions


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The built-in scene, opaque, before a sky whose colour depends on the direction."""
    scene = load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=32), "builtin8", test=(0, 8))

    def opaque(views: Views) -> Views:
        behind = torch.stack(
            [
                sky(camera_rays(p, k, 32, 32).directions).reshape(32, 32, 3)
                for p, k in zip(views.poses, views.intrinsics, strict=True)
            ]
        )
        alpha = views.rgba[..., 3:]
        rgb = views.rgba[..., :3] * alpha + (1 - alpha) * behind
        return replace(views, pixels=torch.cat([rgb, torch.ones_like(alpha)], dim=-1))

    return replace(scene, train=opaque(scene.train), test=opaque(scene.test))


class Glow(nn.Module):
    """A density that depends on the position in contracted space, and a colour likewise."""

    bounds = CONTRACTED

    def density(self, x: Tensor) -> Tensor:
        return 0.3 + 0.2 * x[:, 0].square()

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        return x.abs() / 2


def test_contraction_keeps_the_box_and_holds_all_of_space():
    box = torch.tensor([[0.0, -1.0, 2.0], [4.0, 1.0, 3.0]])
    inside = torch.tensor([[2.0, 0.0, 2.5], [4.0, 1.0, 3.0], [1.0, -0.5, 2.25]])
    expected = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [-0.5, -0.5, -0.5]])
    torch.testing.assert_close(contract(inside, box), expected)
    # Ten half edges off along y: 2 - 1/10, and a tenth of the other coordinates' share.
    far = torch.tensor([[4.0, 10.0, 2.5]])
    torch.testing.assert_close(contract(far, box), torch.tensor([[0.19, 1.9, 0.0]]))
    assert float(contract(torch.randn(100, 3) * 1e6, box).abs().max()) <= 2


def test_colour_behind_the_box_is_that_of_a_fine_quadrature():
    origin, direction = np.array([0.3, -0.2, -4.0]), np.array([0.1, 0.2, 1.0])
    direction /= np.linalg.norm(direction)
    leave = (1 - origin[2]) / direction[2]
    beyond = np.linspace(0, 1 - 1e-6, 200_001)
    t = leave + beyond / (1 - beyond)
    u = origin + t[:, None] * direction
    m = np.maximum(np.abs(u).max(axis=1, keepdims=True), 1)
    x = (2 - 1 / m) * u / m
    length = np.linalg.norm(np.diff(x, axis=0), axis=1)
    middle = (x[1:] + x[:-1]) / 2
    tau = (0.3 + 0.2 * middle[:, 0] ** 2) * length
    passed = np.exp(-np.concatenate([[0], np.cumsum(tau)]))
    colour = ((passed[:-1] - passed[1:])[:, None] * np.abs(middle) / 2).sum(0) + passed[-1] * np.abs(
        x[-1]
    ) / 2

    rays = Rays(*(torch.tensor(v, dtype=torch.float32)[None] for v in (origin, direction)))
    black = Rendered(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1))
    found = Surroundings(Glow(), BOX, 0.5, samples=400).behind(black, rays).colour[0]
    torch.testing.assert_close(found, torch.tensor(colour, dtype=torch.float32), atol=5e-3, rtol=0)
    half = replace(black, opacity=torch.full((1,), 0.5), colour=torch.full((1, 3), 0.1))
    torch.testing.assert_close(
        Surroundings(Glow(), BOX, 0.5, samples=400).behind(half, rays).colour[0], 0.1 + found / 2
    )


def test_samples_go_out_from_the_box_and_past_it_from_near_on():
    around = Surroundings(Glow(), BOX, 0.5, samples=30)
    rays = Rays(
        torch.tensor([[0.0, 0.0, -4.0]] * 2), nn.functional.normalize(torch.tensor([[0.0, 0, 1], [1, 0, 1]]))
    )
    zero = torch.zeros(2)
    marched = around.march_density(rays, zero, zero, 1.0, None, torch.full((2,), 0.5), 0.0)
    through, past = marched.t.reshape(2, 30)
    assert float(through[0]) > 5 > 0.5 < float(past[0]) < 1
    assert bool((through.diff() > 0).all() and (past.diff() > 0).all())
    assert float(past[-1]) > 10
    assert marched.ray_steps.tolist() == [30, 30]


def test_an_opaque_box_hides_them():
    opaque = Rendered(torch.rand(2, 3), torch.ones(2), torch.ones(2))
    rays = Rays(torch.tensor([[0.0, 0.0, -4.0]] * 2), torch.tensor([[0.0, 0.0, 1.0]] * 2))
    assert Surroundings(Glow(), BOX, 0.5).behind(opaque, rays) is opaque


def test_wanted_where_there_is_something_behind(room):
    assert build_trainer(CONFIG, room).beside.surroundings is not None
    off = replace(CONFIG, train=replace(CONFIG.train, surroundings=False))
    assert build_trainer(off, room).beside.surroundings is None
    assert build_trainer(CONFIG, replace(room, ndc=True)).beside.surroundings is None
    clear = room.train.rgba.clone()
    clear[0, 0, 0, 3] = 0
    transparent = replace(room, train=replace(room.train, pixels=clear))
    assert build_trainer(CONFIG, transparent).beside.surroundings is None
    outward = room.train.poses.clone()
    outward[:, :3, :3] *= torch.tensor([-1.0, 1.0, -1.0])
    assert surround_focus(room.train.poses.double().numpy())
    assert not surround_focus(outward.double().numpy())


def test_a_sky_is_learned_outside_the_box(room):
    def sky_alone(views: Views) -> Views:
        rays = [camera_rays(p, k, 32, 32) for p, k in zip(views.poses, views.intrinsics, strict=True)]
        rgb = torch.stack([sky(one.directions).reshape(32, 32, 3) for one in rays])
        return replace(views, pixels=torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=-1))

    empty = replace(room, train=sky_alone(room.train), test=sky_alone(room.test))
    scores = {}
    for on in (True, False):
        settings = replace(CONFIG.train, learning_rate_grid=0.05, surroundings=on)
        trainer = build_trainer(replace(CONFIG, train=settings), empty)
        trainer.train()
        scores[on] = mean_psnr_of(trainer.model, empty.test)
    assert scores[True] > scores[False] + 1.5


def test_checkpoints_keep_them_and_older_ones_go_on_without(room, tmp_path):
    config = replace(CONFIG, train=replace(CONFIG.train, steps=6))
    trainer = build_trainer(config, room)
    trainer.train(until=3)
    save_run(tmp_path / "half", trainer, config, {})
    trainer.train()
    again, _ = resume_trainer(tmp_path / "half", config, room)
    again.train()
    wanted = trainer.beside.surroundings.model.state_dict()
    assert all(
        torch.equal(value, wanted[name])
        for name, value in again.beside.surroundings.model.state_dict().items()
    )
    save_run(tmp_path / "whole", trainer, config, {})
    loaded = load_run(tmp_path / "whole")
    score = mean_psnr_of(trainer.model, room.test)
    assert mean_psnr_of(loaded, room.test) == pytest.approx(score, abs=1e-6)
    shown = Preview(trainer.model).at()
    assert shown.surroundings is not trainer.beside.surroundings.model
    assert mean_psnr_of(shown, room.test) == pytest.approx(score, abs=1e-6)

    trainer.beside.surroundings = None
    save_run(tmp_path / "older", trainer, config, {})
    assert load_run(tmp_path / "older").surroundings is None
    assert resume_trainer(tmp_path / "older", config, room)[0].beside.surroundings is None


def test_an_ensemble_has_the_mean_of_what_is_behind(room, tmp_path):
    for seed in (0, 1):
        config = replace(CONFIG, seed=seed, train=replace(CONFIG.train, steps=2))
        execute(config, room, tmp_path / str(seed))
    save_ensemble([tmp_path / "0", tmp_path / "1"], tmp_path / "both")
    rays = camera_rays(room.test.poses[0], room.test.intrinsics[0], 32, 32)[:50]
    black = Rendered(torch.zeros(50, 3), torch.zeros(50), torch.zeros(50))
    one, two, both = (
        load_run(tmp_path / name).surroundings.behind(black, rays).colour for name in ("0", "1", "both")
    )
    torch.testing.assert_close(both, (one + two) / 2)


def ring(count: int = 19, aspect: float = 16 / 9) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Portrait photographs around the origin from a distance of 4, that show 1.2 to each side of it."""
    poses = np.stack([look_at_origin(360 * k / count, 20.0) for k in range(count)])
    distance = float(np.linalg.norm(poses[0, :3, 3]))
    focal = 90 / (1.2 / distance)
    return poses, np.tile([focal, focal, 90, 90 * aspect], (count, 1)), (180, round(180 * aspect))


def test_the_box_is_where_the_cameras_look():
    poses, intrinsics, size = ring()
    rng = np.random.default_rng(0)
    near = rng.uniform(-0.6, 0.6, (2000, 3))
    far = rng.normal(0, 30, (60, 3))
    alone = focus_extent(poses, intrinsics, size)
    assert 1.2 <= alone.bounds[1, 0] <= 1.8
    found = focus_extent(poses, intrinsics, size, np.concatenate([near, far]))
    # The object fills two thirds of the box and more.
    assert ((found.bounds[1] - found.bounds[0]) < 1.2 / 0.66).all()
    assert (found.bounds[0] <= near.min(axis=0)).all()
    assert (found.bounds[1] >= near.max(axis=0)).all()
    distance = float(np.linalg.norm(poses[0, :3, 3]))
    assert found.near < distance - math.sqrt(3) * 0.6
    assert found.far > distance + math.sqrt(3) * 0.6
    shift = np.array([5.0, -3.0, 1.0])
    poses[:, :3, 3] += shift
    moved = focus_extent(poses, intrinsics, size, np.concatenate([near, far]) + shift)
    np.testing.assert_allclose(moved.bounds, found.bounds + shift, atol=1e-6)


def test_a_camera_that_strays_does_not_move_the_box():
    poses, intrinsics, size = ring()
    found = focus_extent(poses, intrinsics, size).bounds
    stray = poses[:1].copy()
    stray[0, :3, 3] *= 30
    moved = focus_extent(np.concatenate([poses, stray]), np.tile(intrinsics[:1], (20, 1)), size).bounds
    np.testing.assert_allclose(moved, found, atol=0.4)
