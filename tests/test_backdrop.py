"""Opaque pictures on one colour: it is the background, and random ones are left out."""

import json
from dataclasses import replace

import pytest
import torch
from PIL import Image

from gridreg.attach._notices import AttachWarning
from gridreg.scenes import builtin_scene, load_scene
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
    room = replace(scene, train=replace(scene.train, rgba=rgba))
    assert room.train.backdrop is None
    assert behind(build_trainer(CONFIG, room)).std() > 0.1


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
