"""Patches from cameras between the training cameras, and training with penalties on them."""

import math
from dataclasses import replace

import pytest
import torch

from gridreg.errors import InputError
from gridreg.rendering import camera_rays
from gridreg.scenes import Views, builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer
from gridreg.training.unseen import UnseenPatches, poses_between
from tests.tiny_training import NO_EVENTS

SMOOTH = {"name": "DepthSmoothness", "weight": 0.5}
CONFIG = RunConfig(
    field={"density_components": 4, "appearance_components": 4, "density_shift": None, "width": 16},
    train=replace(NO_EVENTS, steps=200, patches=3, patch_size=5),
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=32), "builtin8", test=[])


def looking_at(position, focus):
    """A camera with its x axis level."""
    pose = torch.eye(4)
    backward = torch.nn.functional.normalize(position - focus, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), backward), dim=0)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(backward, right), backward], dim=1)
    pose[:3, 3] = position
    return pose


def views_of(poses, size=20):
    count = len(poses)
    return Views(
        torch.zeros(count, size, size, 4),
        torch.stack(list(poses)),
        torch.tensor([15.0, 15.0, size / 2, size / 2]).expand(count, 4),
        tuple(map(str, range(count))),
        tuple(range(count)),
    )


def test_between_cameras_that_look_at_a_point_are_cameras_that_do():
    focus = torch.tensor([0.5, -1.0, 0.25])
    offsets = torch.tensor([[3.0, 0.0, 1.0], [-0.5, 5.0, 2.0], [-2.0, -1.0, 0.1]])
    poses = torch.stack([looking_at(focus + o, focus) for o in offsets])
    share = torch.linspace(0, 1, 7)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        found = poses_between(poses[i].expand(7, 4, 4), poses[j].expand(7, 4, 4), share, focus)
        axes, away = found[:, :3, :3], found[:, :3, 3] - focus
        torch.testing.assert_close(axes.mT @ axes, torch.eye(3).expand(7, 3, 3), atol=1e-5, rtol=0)
        assert torch.linalg.det(axes).min() > 0.99
        near, far = offsets[i].norm(), offsets[j].norm()
        torch.testing.assert_close(away.norm(dim=-1), torch.lerp(near, far, share), atol=1e-4, rtol=0)
        torch.testing.assert_close(away, axes[:, :, 2] * away.norm(dim=-1, keepdim=True), atol=1e-4, rtol=0)
        torch.testing.assert_close(found[0], poses[i], atol=1e-5, rtol=0)
        torch.testing.assert_close(found[-1], poses[j], atol=1e-5, rtol=0)


def test_between_cameras_that_look_at_each_other_the_first_one_turns_no_other_way():
    here, there = looking_at(torch.tensor([2.0, 0, 0]), torch.zeros(3)), torch.eye(4)
    there[:3, :3] = here[:3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    there[:3, 3] = -here[:3, 3]
    found = poses_between(here[None], there[None], torch.tensor([0.5]), torch.zeros(3))[0]
    assert torch.equal(found[:3, :3], here[:3, :3])
    assert torch.isfinite(found).all()


def test_patches_are_windows_of_one_camera_each():
    focus = torch.zeros(3)
    views = views_of([looking_at(torch.tensor(p), focus) for p in ([4.0, 0, 1], [0.0, 4, 1], [-4.0, 0, 1])])
    rays = UnseenPatches(views, 6).draw(40, torch.Generator().manual_seed(0))
    assert len(rays) == 40 * 36
    origins, directions = rays.origins.reshape(40, 36, 3), rays.directions.reshape(40, 6, 6, 3)
    assert torch.equal(origins, origins[:, :1].expand(40, 36, 3))
    assert len(origins[:, 0].unique(dim=0)) == 40
    # Every one is a window of the picture that a camera at its place takes: cut it out by its first ray.
    for origin, patch in zip(origins[:, 0], directions, strict=True):
        window = camera_rays(looking_at(origin, focus), views.intrinsics[0], 20, 20)
        whole = window.directions.reshape(20, 20, 3)
        at = int((whole.reshape(-1, 3) - patch[0, 0]).norm(dim=-1).argmin())
        top, left = at // 20, at % 20
        cut = whole[top : top + 6, left : left + 6]
        torch.testing.assert_close(patch, cut, atol=2e-3, rtol=0)


def test_the_generator_alone_decides_and_one_camera_is_enough():
    views = views_of([looking_at(torch.tensor([3.0, 1.0, 1.0]), torch.zeros(3))])
    patches = UnseenPatches(views, 4)
    first, again, other = (patches.draw(2, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.directions, again.directions)
    assert not torch.equal(first.directions, other.directions)
    torch.testing.assert_close(first.origins, views.poses[:, :3, 3].expand(32, 3))


def test_only_regularizers_that_need_patches_get_them_and_targets_stay(scene):
    plain = build_trainer(CONFIG, scene)
    with_patches = build_trainer(replace(CONFIG, composition=[SMOOTH, {"name": "ExpectedBackground"}]), scene)
    rendered, target = plain.render_batch()
    assert plain.unseen is None
    assert rendered.samples.patch is None
    more, same = with_patches.render_batch()
    assert more.samples.patch == (3, 5, 5)
    assert len(more.colour) == len(target) + 75
    # The same pixels, only on another background.
    assert torch.equal(more.samples.directions[:64], rendered.samples.directions)
    assert same.shape == target.shape
    assert torch.equal(more.samples.target_opacity[:64], rendered.samples.target_opacity)
    assert more.samples.target_opacity[64:].isnan().all()
    report = with_patches.train_step()
    assert math.isfinite(report["loss"])


def test_depth_of_unseen_views_is_smoother_with_the_penalty(scene):
    """What it is there for, on patches that the training did not draw."""

    def roughness(composition):
        trainer = build_trainer(replace(CONFIG, composition=composition), scene)
        trainer.train()
        measured = build_trainer(replace(CONFIG, composition=[SMOOTH], seed=1), scene)
        measured.field.load_state_dict(trainer.field.state_dict())
        terms = []
        with torch.no_grad():
            for _ in range(20):
                samples = measured.render_batch()[0].samples
                measured.handle.loss(samples)
                terms.append(float(measured.handle.terms["DepthSmoothness"]))
        return sum(terms) / len(terms)

    assert roughness([SMOOTH]) < 0.7 * roughness([])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"patches": 0}, "patches: found 0, expected an integer of at least 1"),
        ({"patch_size": 1}, "patch_size: found 1, expected an integer of at least 2"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(InputError, match=message):
        TrainSettings(**settings)


def test_a_patch_larger_than_the_pictures(scene):
    config = replace(CONFIG, train=replace(CONFIG.train, patch_size=33), composition=[SMOOTH])
    with pytest.raises(InputError, match=r"train.patch_size: found 33, .* the images' 32 pixels"):
        build_trainer(config, scene)
