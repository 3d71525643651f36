"""Opaque pictures on one colour: it is the background, random ones are left out, and silhouettes follow from it."""

import json
from dataclasses import replace

import pytest
import torch
from PIL import Image

from gridreg.attach._notices import AttachWarning
from gridreg.scenes import Views, builtin_scene, load_scene
from gridreg.training import RunConfig, build_trainer, execute
from tests.tiny_training import NO_EVENTS

GREY = (0.8, 0.6, 0.4)
CONFIG = RunConfig(
    field={"density_components": 4, "appearance_components": 4, "density_shift": None, "width": 16},
    train=replace(NO_EVENTS, steps=3),
    composition=[{"name": "RandomBackground"}],
)


@pytest.fixture(scope="module")
def transparent(tmp_path_factory):
    return builtin_scene(tmp_path_factory.mktemp("scene"), size=32)


@pytest.fixture(scope="module")
def opaque(transparent, tmp_path_factory):
    """The built-in pictures before a sheet of paper, in one list as people's own pictures are."""
    folder = tmp_path_factory.mktemp("opaque")
    content = json.loads((transparent / "transforms_train.json").read_text())
    for k, frame in enumerate(content["frames"]):
        picture = Image.open(transparent / "train" / f"r_{k}.png")
        paper = Image.new("RGBA", picture.size, tuple(round(255 * c) for c in GREY))
        Image.alpha_composite(paper, picture).convert("RGB").save(folder / f"r_{k}.png")
        frame["file_path"] = f"r_{k}.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def behind(trainer):
    """Background colours of a batch of training rays."""
    return trainer.render_batch()[0].samples.background


def test_the_paper_is_the_background(opaque, tmp_path, capfd):
    scene = load_scene(opaque, "holdout8")
    torch.testing.assert_close(scene.background, torch.tensor(GREY), atol=1e-2, rtol=0)
    trainer = build_trainer(CONFIG, scene)
    assert torch.equal(behind(trainer), scene.background.expand(64, 3))
    trainer.handle.remove()
    with pytest.warns(AttachWarning, match="RandomBackground not asked yet"):
        execute(CONFIG, scene, tmp_path / "run")
    said = "".join(capfd.readouterr())
    assert "opaque photographs on one colour (0.80, 0.60, 0.40): it is the background" in said
    given = load_scene(opaque, "holdout8", background="black")
    assert given.background.tolist() == [0, 0, 0]


def test_transparent_pictures_keep_random_backgrounds(transparent):
    scene = load_scene(transparent, "builtin8", test=[])
    assert scene.train.backdrop is None
    assert scene.background.tolist() == [1, 1, 1]
    assert behind(build_trainer(CONFIG, scene)).std() > 0.1


def test_a_room_is_no_backdrop(opaque):
    scene = load_scene(opaque, "holdout8")
    rgba = scene.train.rgba.clone()
    rgba[:, :4, :, :3] = torch.rand(rgba[:, :4, :, :3].shape, generator=torch.Generator().manual_seed(0))
    room = replace(scene, train=replace(scene.train, pixels=rgba))
    assert room.train.backdrop is None
    # Without surroundings, that is: what is behind the box is learned otherwise.
    alone = replace(CONFIG, train=replace(CONFIG.train, surroundings=False))
    assert behind(build_trainer(alone, room)).std() > 0.1


def test_pixels_tell_their_opacity_but_not_on_a_backdrop(transparent, opaque):
    config = replace(CONFIG, composition=[{"name": "ExpectedBackground"}])
    scene = load_scene(transparent, "builtin8", test=[])
    trainer = build_trainer(config, scene)
    rendered, _ = trainer.render_batch()
    assert torch.equal(rendered.samples.background, torch.full((64, 3), 0.5))
    alpha = rendered.samples.target_opacity
    assert set(alpha.unique().tolist()) <= set(scene.train.rgba[..., 3].unique().tolist())
    report = trainer.train_step()
    assert report["ExpectedBackground"] > 0
    paper = build_trainer(config, load_scene(opaque, "holdout8"))
    assert paper.render_batch()[0].samples.target_opacity.isnan().all()
    report = paper.train_step()
    assert report["ExpectedBackground"] == 0
    assert report["loss"] == pytest.approx(report["mse"])


def test_silhouettes_are_those_of_the_alpha_where_they_are_decided(transparent, opaque):
    truth = load_scene(transparent, "builtin8", test=[]).train
    assert torch.equal(truth.silhouettes, truth.rgba[..., 3])
    views = load_scene(opaque, "holdout8", test=[]).train
    content = json.loads((transparent / "transforms_train.json").read_text())
    names = [frame["file_path"].rpartition("/")[2] for frame in content["frames"]]
    everything = load_scene(transparent, f"first{len(names)}", test=[]).train
    alpha = torch.stack([everything.rgba[names.index(name), ..., 3] for name in views.names])
    found = views.silhouettes
    assert float(alpha[found == 0].max()) < 0.2
    assert float((alpha[found == 1] > 0.95).float().mean()) > 0.95
    # Of what is empty, and of what is full, nearly all is known.
    assert float((found[alpha == 0] == 0).float().mean()) > 0.98
    assert float((found[alpha == 1] == 1).float().mean()) > 0.6


def test_noise_of_the_paper_is_paper_and_a_white_spot_is_not():
    generator = torch.Generator().manual_seed(0)
    rgb = 0.9 + 0.01 * torch.rand(1, 40, 40, 3, generator=generator)
    rgb[:, 10:30, 10:30] = 0.3
    rgb[:, 18:22, 18:22] = 0.9
    views = Views(
        torch.cat([rgb, torch.ones(1, 40, 40, 1)], dim=-1), torch.eye(4)[None], torch.ones(1, 4), ("a",), (0,)
    )
    found = views.silhouettes[0]
    outside = torch.ones(40, 40, dtype=torch.bool)
    outside[10:30, 10:30] = False
    assert bool((found[outside] == 0).all())
    assert bool(found[18:22, 18:22].isnan().all())
    assert bool((found[12:17, 12:28] == 1).all())


def test_silhouettes_carve_and_keep_random_backgrounds_from_what_is_undecided(opaque):
    config = replace(CONFIG, train=replace(CONFIG.train, carve=True))
    trainer = build_trainer(config, load_scene(opaque, "holdout8"))
    assert trainer.occupancy.fraction < 0.9
    assert trainer.bank.pixels[:, 3].isnan().any()
    rendered, target = trainer.render_batch()
    alpha = rendered.samples.target_opacity
    drawn = (rendered.samples.background - trainer.scene.background).abs().amax(dim=-1) > 1e-6
    assert torch.equal(drawn, ~alpha.isnan())
    assert torch.equal(target[alpha == 0], rendered.samples.background[alpha == 0])
    assert set(alpha[~alpha.isnan()].tolist()) <= {0.0, 1.0}
