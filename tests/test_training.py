"""The loop: it learns, goes on bit for bit after an interruption, and says what is wrong in one line."""

import json
import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import gridreg
from gridreg.errors import InputError
from gridreg.fields import field_names, make_field, register_field
from gridreg.ops import compilation
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer, execute, load_run
from gridreg.training.events import resolution_of
from gridreg.training.rays import RayBank, meets

TINY = TrainSettings(
    steps=30,
    rays=128,
    voxels_start=12**3,
    voxels_end=20**3,
    resample_at=(10, 20),
    occupancy_at=(8, 16),
    shrink_at=(8,),
    filter_rays_at=(16,),
    occupancy_resolution=24,
    average_from=0.5,
)
MASKED = [
    {"name": "FrequencyMask", "site": "density", "until": 0.8},
    {"name": "FrequencyMask", "site": "encoding.features", "until": 0.8},
    {"name": "ComponentDropout", "site": "appearance", "p": 0.2},
    {"name": "OcclusionLoss", "weight": 0.01, "samples": 5},
    {"name": "TotalVariation", "site": "density", "weight": 0.1},
    {"name": "L1", "site": "density", "weight": 1e-4},
    {"name": "RandomBackground"},
]
FIELD = {"density_components": 4, "appearance_components": 4, "density_shift": None, "width": 16}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=32), "builtin8", test=[0, 9])


@pytest.fixture
def config():
    return RunConfig(field=FIELD, train=TINY, composition=MASKED, seed=3)


def parameters(trainer):
    return {name: value.detach().clone() for name, value in trainer.field.state_dict().items()}


def test_training_learns_and_walks_through_its_events(scene, config):
    trainer = build_trainer(replace(config, composition=[], train=TINY.scaled(90)), scene)
    first = trainer.train_step()["mse"]
    box = trainer.field.bounds.clone()
    errors = []
    trainer.train(each=lambda report: errors.append(report["mse"]) is None)
    assert trainer.step == 90
    assert trainer.field.resolution == resolution_of(20**3, trainer.field.bounds)
    assert bool((trainer.field.bounds[0] >= box[0]).all())
    assert sum(errors[-5:]) / 5 < 0.8 * first


def test_the_same_seed_gives_the_same_numbers(scene, config):
    one, two = build_trainer(config, scene), build_trainer(config, scene)
    one.train()
    two.train()
    for name, value in parameters(one).items():
        assert torch.equal(value, two.field.state_dict()[name]), name
    other = build_trainer(replace(config, seed=4), scene)
    other.train(until=5)
    assert not torch.equal(other.field.density_lines[0], one.field.density_lines[0])


@pytest.mark.parametrize(
    ("stop", "reshuffle"),
    [(1, False), (8, False), (9, True), (13, False), (17, True), (20, True), (29, False)],
)
def test_a_resumed_run_ends_bit_for_bit_like_an_uninterrupted_one(scene, config, stop, reshuffle, tmp_path):
    config = replace(config, train=replace(config.train, reshuffle=reshuffle))
    whole = build_trainer(config, scene)
    whole.train()
    out = tmp_path / "run"

    class Stop(Exception):
        pass

    def interrupt(report):
        if steps.append(0) or len(steps) == stop:
            raise Stop

    steps = []
    run = None
    saved = replace(config, train=replace(config.train, checkpoint_minutes=0.0))
    with pytest.raises(Stop):
        execute(saved, scene, out, on_step=interrupt)
    if stop == 1:
        # Killed before the first checkpoint: there is nothing to resume.
        with pytest.raises(InputError, match="no checkpoint here"):
            execute(saved, scene, out, resume=True)
        return
    run, metrics = execute(saved, scene, out, resume=True)
    assert run.trainer.step == 30
    for name, value in parameters(whole).items():
        assert torch.equal(value, run.trainer.field.state_dict()[name]), name
    assert metrics["steps"] == 30


def test_the_mean_of_the_last_iterates_ends_the_run(scene, config):
    last = build_trainer(replace(config, train=replace(TINY, average_from=1.0)), scene)
    seen = {}
    last.train(each=lambda _: seen.update({last.step: parameters(last)}) or True)
    mean = build_trainer(config, scene)
    mean.train()
    # From the last resampling on, which takes place at 20, every fifth.
    for name, value in parameters(mean).items():
        if name in dict(mean.field.named_parameters()):
            expected = torch.stack([seen[step][name] for step in (20, 25, 30)]).mean(0)
            torch.testing.assert_close(value, expected)
    assert mean.average.count == 0


def test_what_a_run_leaves_behind(scene, config, tmp_path):
    run, metrics = execute(config, scene, tmp_path / "out", command=["train"])
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert {
        "config.yaml",
        "checkpoint",
        "metrics.json",
        "test",
        "test.png",
        "curves.png",
        "masks.png",
    } <= names
    stored = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert stored["benchmark"] is False
    assert stored["protocol"] == "builtin8"
    assert stored["mean"]["psnr"] == pytest.approx(metrics["mean"]["psnr"])
    assert len(stored["images"]) == 2
    loaded = load_run(tmp_path / "out")
    x = loaded.field.bounds[0] + torch.rand(50, 3) * (loaded.field.bounds[1] - loaded.field.bounds[0])
    run.trainer.field.eval()
    assert torch.equal(loaded.field.density(x), run.trainer.field.density(x))
    assert loaded.step == 30
    assert loaded.march == run.trainer.march


def test_a_finished_or_foreign_run_is_not_overwritten(scene, config, tmp_path):
    execute(config, scene, tmp_path / "out")
    with pytest.raises(InputError, match="holds a run already"):
        execute(config, scene, tmp_path / "out")
    other = replace(config, seed=5)
    with pytest.raises(InputError, match=r"another configuration \(differs in seed\)"):
        execute(other, scene, tmp_path / "out", resume=True)


def test_parameters_that_are_not_finite_are_never_saved(scene, config, tmp_path):
    saved = replace(config, train=replace(config.train, checkpoint_minutes=0.0))

    def spoil(report):
        steps.append(0)
        if len(steps) == 5:
            with torch.no_grad():
                dict(fields[0].named_parameters())["density_lines.0"].fill_(float("nan"))

    steps, fields = [], []
    original = gridreg.apply

    def remember(field, *args, **kwargs):
        fields.append(field)
        return original(field, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gridreg, "apply", remember)
        with pytest.raises(
            InputError, match=r"step 5: density_lines.0 is not finite.*last good .* is .*checkpoint"
        ):
            execute(saved, scene, tmp_path / "out", on_step=spoil)
    # The checkpoint is the one before the step that failed.
    assert load_run(tmp_path / "out").step == 4


def test_a_loss_that_is_not_finite_names_its_step_and_touches_no_parameter(scene, config):
    trainer = build_trainer(config, scene)
    trainer.train(until=3)
    with torch.no_grad():
        dict(trainer.field.named_parameters())["density_lines.0"].fill_(float("nan"))
    before = parameters(trainer)["density_planes.0"]
    with pytest.raises(InputError, match="step 3: the loss is nan"):
        trainer.train_step()
    assert torch.equal(parameters(trainer)["density_planes.0"], before)


def test_an_empty_occupancy_says_so(scene, config):
    dead = replace(config, field={**FIELD, "density_shift": -30.0}, composition=[])
    trainer = build_trainer(dead, scene)
    with pytest.raises(InputError, match="step 8: the occupancy grid is empty"):
        trainer.train()


def test_carving_keeps_every_opaque_pixel_and_saves_samples(scene, config):
    carved = build_trainer(replace(config, train=replace(TINY, carve=True)), scene)
    plain = build_trainer(config, scene)
    rays, rgba = carved.bank.draw(400, torch.Generator().manual_seed(0))
    hit = meets(rays, carved.occupancy, scene.near, scene.far)
    assert bool(hit[rgba[:, 3] > 0.5].all())
    assert carved.occupancy.fraction < 0.7
    size = [float((t.field.bounds[1] - t.field.bounds[0]).prod()) for t in (carved, plain)]
    assert size[0] < 0.8 * size[1]


def test_filtering_keeps_visible_pixels(scene):
    bank = RayBank(scene.train)
    before = int((bank.pixels[:, 3] > 0).sum())
    bank.restrict(lambda rays: torch.zeros(len(rays), dtype=torch.bool))
    assert len(bank.active) == before


def test_schedules_scale_with_the_number_of_steps():
    short = TrainSettings().scaled(1500)
    assert short.resample_at == (200, 300, 400, 550, 700)
    assert short.occupancy_at == (200, 400)
    assert short.steps == 1500
    assert [TrainSettings().voxels_at(k) for k in (0, 5)] == [128**3, 300**3]
    growth = [TrainSettings().voxels_at(k + 1) / TrainSettings().voxels_at(k) for k in range(5)]
    assert max(growth) - min(growth) < 1e-3


def test_learning_rates_decay_and_start_anew_at_resampling(scene, config):
    trainer = build_trainer(config, scene)
    rates = []
    while trainer.step < 30:
        trainer.train_step()
        rates.append(trainer.optimizer.param_groups[0]["lr"])
    assert rates[1] == pytest.approx(0.02 * 0.1 ** (1 / 30))
    # Restarted at 8 (shrinking), 10 and 20.
    assert rates[10] == pytest.approx(0.02)
    assert rates[25] == pytest.approx(0.02 * 0.1 ** (5 / 30))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps: found 0"),
        ({"rays": -1}, "rays: found -1"),
        ({"learning_rate_grid": math.nan}, "learning_rate_grid: found nan"),
        ({"shrink_at": (7,)}, "shrink_at: found 7"),
        ({"average_from": 1.5}, "average_from: found 1.5"),
    ],
)
def test_settings_out_of_range_are_named(change, message):
    with pytest.raises(InputError, match=message):
        TrainSettings(**change)


def test_fields_are_found_by_name():
    assert "vm" in field_names()
    bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
    assert make_field("vm", bounds, (4, 4, 4)).resolution == (4, 4, 4)
    with pytest.raises(InputError, match=r"backbone: found 'vmm', expected one of .*; did you mean 'vm'"):
        make_field("vmm", bounds, (4, 4, 4))
    with pytest.raises(InputError, match=r"backbone 'vm': .*colour_components"):
        make_field("vm", bounds, (4, 4, 4), colour_components=3)
    register_field("mine", lambda *args, **kwargs: torch.nn.Linear(1, 1))
    assert isinstance(make_field("mine"), torch.nn.Linear)


EXAMPLE = Path(__file__).parents[1] / "examples" / "few_tensorf_blender.py"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "quik"], "preset: found 'quik'"),
        (["--scene", "nowhere"], "nowhere: no such scene folder"),
        (["--steps", "0"], "--steps: found 0"),
        (["--set", "train.stebs=3"], "stebs"),
        (["--config", "missing.yaml"], "missing.yaml: YAML file not found"),
        (["--resume"], "--resume: expected the run's folder"),
        (["--backbone", "nerf"], "backbone: found 'nerf'"),
    ],
)
def test_the_example_answers_bad_input_with_one_line_and_status_2(arguments, message, tmp_path):
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_pixels_in_a_random_order_each_once_before_any_again(scene):
    bank, generator = RayBank(scene.train, reshuffle=True), torch.Generator().manual_seed(0)
    few = torch.arange(0, len(bank.pixels), 7)
    bank.restrict(lambda rays: torch.zeros(len(rays), dtype=torch.bool))
    bank.active = few
    bank.pixels = torch.arange(len(bank.pixels), dtype=torch.float32)[:, None].expand(-1, 4)
    drawn = torch.cat([bank.draw(100, generator)[1][:, 0] for _ in range(40)]).long()
    rounds = drawn[: len(drawn) // len(few) * len(few)].reshape(-1, len(few))
    assert len(rounds) >= 2
    assert torch.equal(rounds.sort(dim=1).values, few.expand(len(rounds), -1))
    assert not torch.equal(rounds[0], rounds[1])
    assert not torch.equal(rounds[0], few)


def test_no_pixel_waits_that_is_not_drawn_any_more(scene):
    bank, generator = RayBank(scene.train, reshuffle=True), torch.Generator().manual_seed(0)
    bank.draw(10, generator)
    bank.restrict(lambda rays: torch.zeros(len(rays), dtype=torch.bool))
    assert (bank.draw(len(bank.active), generator)[1][:, 3] > 0).all()


@pytest.mark.parametrize("reshuffle", [False, True])
def test_nothing_to_draw_is_said_in_one_line(scene, reshuffle):
    bank = RayBank(scene.train, reshuffle=reshuffle)
    bank.active = bank.active[:0]
    with pytest.raises(InputError, match=r"all of the \d+ pixels are transparent and see no occupied cell"):
        bank.draw(4, torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"density_components": 0}, "expected at least 1"),
        ({"appearance_components": -1}, "expected at least 1|negative"),
        ({"density_shift": "abc"}, r"field.density_shift: found 'abc', expected a finite number or null"),
        ({"initial_opacity": math.inf}, "field.initial_opacity: found inf"),
        ({"density_components": 2.5}, "field.density_components: found 2.5, expected an integer"),
        ({"decoder": 3}, "field.decoder: found 3, expected text"),
        ({"density_componentz": 3}, "density_componentz"),
    ],
)
def test_options_of_a_field_are_checked(scene, field, message):
    with pytest.raises(InputError, match=message):
        build_trainer(RunConfig(field=field, train=TINY), scene)


def test_compiling_and_pauses_are_no_time_of_training(scene, tmp_path):
    """Or the first row of a study would seem slower than the others, by the kernels that it compiles."""

    def each(report):
        with compilation.timed() if len(losses) % 2 else compilation.clock_stopped():
            time.sleep(0.3)
        losses.append(report["loss"])

    losses = []
    settings = replace(TINY, steps=8, resample_at=(), occupancy_at=(), shrink_at=(), filter_rays_at=())
    config = RunConfig(field={"density_components": 4, "appearance_components": 4}, train=settings)
    began = time.perf_counter()
    _, metrics = execute(config, scene, tmp_path / "run", on_step=each)
    assert len(losses) == 8
    assert metrics["seconds"]["train"] + 2.4 <= time.perf_counter() - began
