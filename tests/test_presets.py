"""Every preset trains: its field, its schedule, and every regularizer of its composition does something."""

import math
from dataclasses import replace

import pytest
import torch

import gridreg
from gridreg.base import overrides
from gridreg.errors import ConfigError
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import (
    RunConfig,
    TrainOptions,
    build_trainer,
    configure,
    load_preset,
    preset_names,
    regularizers_of,
)
from gridreg.training.config import override
from gridreg.training.typed_data import from_data

PENALTIES = ("penalty", "grid_penalty")
OPTIMIZER = ("parameter_groups", "update_groups")
# A network as large as FreeNeRF's would take minutes here.
SMALL_NETWORK = {"width": 16, "colour_width": 8, "coarse_samples": 8, "fine_samples": 8}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=24), "builtin8", test=[0])


@pytest.fixture(scope="module", params=preset_names())
def config(request):
    """A preset on a small grid, with few rays, everything else as it is."""
    config = load_preset(request.param)
    field = dict(config.field)
    if config.backbone == "mlp":
        field |= SMALL_NETWORK
    train = replace(config.train, rays=96, voxels_start=14**3, voxels_end=20**3)
    return replace(config, field=field, train=train)


@pytest.fixture(scope="module")
def trained(config, scene):
    """The trainer after three iterations, and what they reported."""
    trainer = build_trainer(config, scene)
    reports = []
    trainer.train(until=3, each=lambda report: reports.append(report) is None)
    return trainer, reports


def test_three_iterations_of_every_preset(trained):
    trainer, reports = trained
    assert [math.isfinite(report["loss"]) for report in reports] == [True] * 3
    penalties = [r for r in trainer.handle.regularizers if any(overrides(r, part) for part in PENALTIES)]
    rare = {type(r).__name__ for r in penalties if getattr(r, "every", 1) > 1}
    for step, report in enumerate(reports):
        terms = {name: value for name, value in report.items() if name not in ("loss", "mse", "psnr")}
        assert len(terms) == len(penalties)
        assert all(math.isfinite(value) and value >= 0 for value in terms.values())
        # Near samples may all lie in empty cells; grids are never 0.
        grids = {name: value for name, value in terms.items() if "(" in name}
        assert all(
            value > 0 for name, value in grids.items() if not step or name.partition("(")[0] not in rare
        )
        # What the optimizer takes over is not part of the loss.
        assert report["mse"] - 1e-6 <= report["loss"] <= report["mse"] + sum(terms.values()) + 1e-6


def seen(field):
    """Density and colour at places inside the box."""
    generator = torch.Generator().manual_seed(0)
    x = field.bounds[0] + torch.rand(200, 3, generator=generator) * (field.bounds[1] - field.bounds[0])
    d = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    with torch.no_grad():
        return torch.cat([field.density(x)[:, None], field.colour(x, d)], dim=1)


def test_every_mask_and_low_pass_of_a_preset_changes_what_its_field_shows(trained):
    trainer, _ = trained
    field, handle = trainer.field, trainer.handle
    acting = [r for r in handle.regularizers if overrides(r, "transform")]
    with torch.no_grad(), handle.suspended():
        kept = {name: value.clone() for name, value in field.state_dict().items()}
        for parameter in field.parameters():
            # Large enough for softplus to show the density, small enough to leave colours between 0 and 1.
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
        raw = seen(field)
        for regularizer in acting:
            with gridreg.apply(field, regularizer, total_steps=handle.total_steps) as alone:
                alone.step(2)
                assert not torch.equal(seen(field), raw), regularizer
            assert torch.equal(seen(field), raw)
        field.load_state_dict(kept)


def test_everything_in_a_preset_is_of_a_kind_that_was_looked_at(trained):
    trainer, _ = trained
    for regularizer in trainer.handle.regularizers:
        parts = ("transform", *PENALTIES, *OPTIMIZER, "background", "near_far", "on_samples")
        assert any(overrides(regularizer, part) for part in parts), regularizer
        if overrides(regularizer, "background"):
            white = torch.ones(3)
            drawn = trainer.handle.background(5, torch.Generator().manual_seed(0), white)
            assert drawn.shape == (5, 3)
            assert not torch.equal(drawn, white.expand(5, 3))
        if isinstance(regularizer, gridreg.WeightDecay):
            decays = [group["weight_decay"] for group in trainer.optimizer.param_groups]
            assert regularizer.decay in decays


def test_events_of_a_preset_lie_within_its_run(config):
    train = load_preset(config.preset).train
    for events in (train.resample_at, train.occupancy_at, train.shrink_at, train.filter_rays_at):
        assert all(0 <= event < train.steps for event in events)
    assert list(train.resample_at) == sorted(train.resample_at)


def test_presets_can_be_chosen_by_option(config):
    chosen = configure(TrainOptions(preset=config.preset))
    assert chosen == load_preset(config.preset)
    assert chosen.preset == config.preset


# --- published settings ------------------------------------------------------------------------


def test_cp_has_the_sizes_and_penalties_of_its_paper():
    config = load_preset("cp")
    assert config.backbone == "cp"
    assert (config.field["density_components"], config.field["appearance_components"]) == (96, 288)
    assert (config.train.voxels_start, config.train.voxels_end) == (128**3, 500**3)
    assert config.train.resample_at == (2000, 3000, 4000, 5500, 7000)
    regularizers = regularizers_of(config)
    assert gridreg.L1("density", weight=1e-5) in regularizers
    for site in ("density", "appearance"):
        assert gridreg.TotalVariation(site, weight=1e-3) in regularizers
    masks = [r.site for r in regularizers if isinstance(r, gridreg.FrequencyMask)]
    few = regularizers_of(load_preset("few_tensorf"))
    assert masks == [r.site for r in few if isinstance(r, gridreg.FrequencyMask)]


def test_freenerf_has_the_schedule_of_its_program():
    config = load_preset("freenerf")
    assert (config.backbone, config.train.steps, config.train.rays) == ("mlp", 50_000, 1024)
    assert config.train.learning_rate_network == 5e-4
    # A tenth in 500,000 iterations.
    assert config.train.learning_rate_decay == pytest.approx(0.1 ** (50_000 / 500_000), abs=1e-3)
    assert regularizers_of(config) == gridreg.composition("freenerf")


def test_grid_rivals_differ_from_the_baseline_in_their_composition():
    baseline = load_preset("tensorf")
    fourierf, sanerf = load_preset("fourierf"), load_preset("sanerf")
    assert regularizers_of(fourierf) == gridreg.composition("fourierf")
    assert fourierf.train == sanerf.train == baseline.train
    assert fourierf.field == baseline.field
    assert sanerf.field == {**baseline.field, "decoder": "sh"}
    kinds = regularizers_of(sanerf)
    for site in ("density", "appearance"):
        assert gridreg.GridBlur(site, until=0.8, start=0.15, rounds=30, rate=0.2) in kinds
    assert gridreg.ViewDependenceMask("view", bands=2) in kinds


@pytest.mark.parametrize(
    ("preset", "backbone", "like"),
    [
        ("quick", "cp", "cp_quick"),
        ("few_tensorf", "cp", "cp"),
        ("quick", "mlp", "freenerf_quick"),
        ("few_tensorf", "mlp", "freenerf"),
    ],
)
def test_another_backbone_comes_with_options_and_regularizers_that_fit_it(preset, backbone, like):
    config, fitting = configure(TrainOptions(preset=preset, backbone=backbone)), load_preset(like)
    assert config.train == load_preset(preset).train
    assert (config.field, config.composition) == (fitting.field, fitting.composition)
    own = configure(TrainOptions(preset=preset, backbone=backbone, composition="none"))
    assert own.composition == "none"


def test_best_long_is_best_with_more_iterations():
    best, long = load_preset("best"), load_preset("best-long")
    assert long.train == best.train.scaled(long.train.steps)
    assert (long.backbone, long.field, long.composition) == (best.backbone, best.field, best.composition)


def test_finetuned_is_the_published_schedule_with_four_changes():
    published, ours = load_preset("few_tensorf_10k"), load_preset("few_tensorf_finetuned")
    assert ours.train == replace(published.train, carve=True)
    changed = {"decoder": "mlp_fea", "density_shift": None, "initial_opacity": 0.1}
    assert ours.field == {**published.field, **changed}
    left = [
        part
        for part in published.composition
        if part["name"] != "Orthogonality" and part.get("site") != "encoding.position"
    ]
    assert ours.composition == [*left, {"name": "RandomBackground"}]
    assert len(left) == len(published.composition) - 3


def test_keys_of_before_are_refused_with_their_names_of_now():
    for old, new in gridreg.errors.RENAMED_KEYS.items():
        with pytest.raises(
            ConfigError, match=rf"train\.{old}: unknown key; it is called {new} now\. valid: steps, "
        ):
            from_data(RunConfig, {"scene": "builtin", "train": {old: 0.1}})
        with pytest.raises(ConfigError, match=rf"set: train\.{old}: unknown key; it is called {new} now"):
            override(RunConfig(scene="builtin"), {f"train.{old}": 0.1}, source="set")
