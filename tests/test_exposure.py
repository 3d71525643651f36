"""Exposure and white balance of photographs: known gains are found, renders keep the mean, and scores say so."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

import gridreg.rendering
from gridreg.cli import main
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer, execute, load_run, save_ensemble
from gridreg.training.exposure import affine_corrected, affine_psnr, wants_exposure
from gridreg.training.run import resume_trainer, save_run

CONFIG = RunConfig(
    field={"density_components": 4, "appearance_components": 8, "density_shift": None, "decoder": "rgb"},
    train=TrainSettings(
        steps=200,
        rays=512,
        learning_rate_grid=0.05,
        voxels_start=20_000,
        voxels_end=20_000,
        resample_at=(),
        occupancy_at=(),
        shrink_at=(),
        filter_rays_at=(0,),
        carve=True,
        exposure=True,
    ),
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=32), "builtin8", test=(0, 8))


@pytest.fixture(scope="module")
def truth():
    """Gains of eight photographs: up to a third of a stop, and warmer or colder."""
    exposures = torch.tensor([0.2, -0.2, 0.1, -0.1, 0.15, -0.15, 0.05, -0.05])[:, None]
    warmth = torch.tensor([0.1, 0.0, -0.1]) * torch.tensor([1.0, 1, -1, -1, 1, 1, -1, -1])[:, None]
    return (exposures + warmth).exp()


@pytest.fixture(scope="module")
def exposed(scene, truth):
    """The same photographs, darker than any of them could clip, each with its gains."""
    rgba = scene.train.rgba.clone()
    rgba[..., :3] = 0.6 * rgba[..., :3] * truth[:, None, None]
    return replace(scene, train=replace(scene.train, pixels=rgba))


def test_known_gains_are_found(scene, exposed, truth):
    found = []
    for one in (exposed, scene):
        trainer = build_trainer(CONFIG, one)
        trainer.train()
        found.append(trainer.beside.exposure.gains.detach().log())
    assert float(found[0].mean(dim=0).abs().max()) < 1e-5
    # What the light on eight sides of the object looks like is no exposure, and is there without any.
    expected = truth.log() - truth.log().mean(dim=0)
    gains = found[0] - found[1]
    assert float((gains - expected).abs().mean()) < 0.3 * float(expected.abs().mean())
    assert float(torch.corrcoef(torch.stack([gains.flatten(), expected.flatten()]))[0, 1]) > 0.95
    assert float(found[1].abs().mean()) < 0.5 * float(expected.abs().mean())


def test_a_background_that_was_put_there_is_not_exposed(exposed):
    trainer = build_trainer(CONFIG, exposed)
    with torch.no_grad():
        trainer.beside.exposure.log_gains[:4] = 0.5
    shown, _ = trainer.render_batch()
    view, opacity = trainer.bank.drawn_views, shown.opacity[:, None]
    gain = torch.where(view < 4, 0.25, -0.25).exp()[:, None]
    matter = gridreg.rendering.composite(replace(shown.samples, background=torch.zeros(len(view), 3))).colour
    torch.testing.assert_close(shown.colour, gain * matter + (1 - opacity))
    put_there = replace(shown, colour=matter + 1 - opacity)
    taken = trainer.beside.exposure.expose(put_there, trainer.bank, taken=True)
    torch.testing.assert_close(taken.colour, gain * put_there.colour)


def test_wanted_where_it_is_said(scene):
    assert wants_exposure(scene, CONFIG.train)
    assert not wants_exposure(scene, TrainSettings())
    one = replace(
        scene.train,
        **{
            name: getattr(scene.train, name)[:1] for name in ("pixels", "poses", "intrinsics", "names", "ids")
        },
    )
    assert not wants_exposure(replace(scene, train=one), CONFIG.train)


def test_an_affine_map_of_colours_is_undone():
    generator = torch.Generator().manual_seed(0)
    image, matrix = torch.rand(12, 9, 3, generator=generator), torch.rand(3, 3, generator=generator) / 3
    target = image @ matrix + 0.05
    torch.testing.assert_close(affine_corrected(image, target), target, atol=1e-5, rtol=0)
    assert affine_psnr(image, target) > 80
    flat = torch.full((4, 4, 3), 0.5)
    torch.testing.assert_close(affine_corrected(flat, flat / 2), flat / 2, atol=1e-5, rtol=0)


def test_a_resumed_run_ends_alike_and_scores_say_what_they_are(exposed, tmp_path, capsys):
    config = replace(CONFIG, train=replace(CONFIG.train, steps=6))
    trainer = build_trainer(config, exposed)
    trainer.train(until=3)
    save_run(tmp_path / "half", trainer, config, {})
    trainer.train()
    again, _ = resume_trainer(tmp_path / "half", config, exposed)
    again.train()
    assert torch.equal(again.beside.exposure.log_gains, trainer.beside.exposure.log_gains)
    assert float(again.beside.exposure.log_gains.detach().abs().max()) > 0
    _, metrics = execute(config, exposed, tmp_path / "run")
    assert metrics["mean"]["psnr_affine"] > metrics["mean"]["psnr"]
    assert "affine" in metrics["conventions"]["psnr_affine"]
    assert load_run(tmp_path / "run").exposed
    save_ensemble([tmp_path / "run", tmp_path / "run"], tmp_path / "both")
    assert load_run(tmp_path / "both").exposed


def test_eval_scores_likewise(tmp_path, capsys):
    folder = builtin_scene(tmp_path / "scenes", size=32)
    out = str(tmp_path / "run")
    words = ["train", "--scene", str(folder), "--out", out, "--steps", "2", "--no-mesh", "--no-video"]
    assert (
        main([*words, "--set", "train.exposure=true", "train.voxels_end=8000", "train.voxels_start=8000"])
        == 0
    )
    stored = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert main(["eval", out, "--out", str(tmp_path / "again")]) == 0
    scored = json.loads((tmp_path / "again" / "metrics.json").read_text())
    assert scored["mean"]["psnr_affine"] == pytest.approx(stored["mean"]["psnr_affine"], abs=1e-4)
    assert scored["conventions"] == stored["conventions"]
