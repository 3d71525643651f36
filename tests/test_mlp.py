"""The coordinate network against NumPy, its masked encodings, its march, and its way through a trainer."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from backbones.mlp import MLPField
from gridreg.fields import make_field
from gridreg.rendering import (
    Camera,
    Lens,
    MarchSettings,
    Model,
    OccupancyGrid,
    Rays,
    box_intersection,
    render_rays,
)
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer, load_run, save_run

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 3.0]])
TINY = {
    "width": 12,
    "depth": 4,
    "skip": 1,
    "colour_width": 8,
    "position_octaves": 3,
    "direction_octaves": 2,
    "coarse_samples": 6,
    "fine_samples": 10,
    "precision": "float32",
}


def small(seed=0, trained=True, **options):
    generator = torch.Generator().manual_seed(seed)
    field = MLPField(BOX, (4, 4, 4), generator=generator, **{**TINY, **options})
    if trained:
        with torch.no_grad():
            field.density_head.weight.normal_(0, 1, generator=generator)
            for layer in (*field.trunk, field.bottleneck, *field.colour_layers):
                layer.bias.normal_(0, 0.1, generator=generator)
    return field


def points(count=40, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = BOX[0] + torch.rand(count, 3, generator=generator) * (BOX[1] - BOX[0])
    d = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return x, d


def encoded(values, octaves, mask=None):
    """NeRF, equation 4, octave by octave and the input first; ``mask`` has a factor for the input and each octave."""
    mask = np.ones(octaves + 1) if mask is None else mask
    parts = [mask[0] * values]
    for k in range(octaves):
        parts += [mask[k + 1] * np.sin(2.0**k * values), mask[k + 1] * np.cos(2.0**k * values)]
    return np.concatenate(parts, axis=1)


def by_numpy(field, x, d, position_mask=None, direction_mask=None):
    """Density and colour as section 5.1 and figure 7 of NeRF have them."""

    def linear(layer, values):
        return values @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()

    box = BOX.double().numpy()
    local = (x.double().numpy() - box.mean(0)) / ((box[1] - box[0]).max() / 3)
    position = encoded(local, field.position_octaves, position_mask)
    direction = encoded(d.double().numpy(), field.direction_octaves, direction_mask)
    hidden = position
    for place, layer in enumerate(field.trunk):
        hidden = np.maximum(linear(layer, hidden), 0)
        if place == field.skip:
            hidden = np.concatenate([position, hidden], axis=1)
    density = np.log1p(np.exp(linear(field.density_head, hidden)[:, 0] + field.density_shift))
    first, last = field.colour_layers
    bottleneck = linear(field.bottleneck, hidden)
    seen = np.maximum(linear(first, np.concatenate([direction, bottleneck], axis=1)), 0)
    return density, 1 / (1 + np.exp(-linear(last, seen)))


@given(seed=st.integers(0, 50), depth=st.integers(3, 5), octaves=st.integers(0, 10))
def test_density_and_colour_are_those_of_the_paper(seed, depth, octaves):
    field = small(seed, depth=depth, position_octaves=octaves)
    x, d = points(20, seed)
    density, colour = by_numpy(field, x, d)
    np.testing.assert_allclose(field.density(x).detach().numpy(), density, atol=1e-3, rtol=1e-3)
    np.testing.assert_allclose(field.colour(x, d).detach().numpy(), colour, atol=1e-3)


def test_the_published_sizes_are_the_defaults():
    field = MLPField(BOX)
    shapes = [tuple(layer.weight.shape) for layer in field.trunk]
    assert shapes == [(256, 63), *[(256, 256)] * 4, (256, 63 + 256), *[(256, 256)] * 2]
    assert [tuple(layer.weight.shape) for layer in field.colour_layers] == [(128, 27 + 256), (3, 128)]
    assert (field.coarse_samples, field.fine_samples) == (64, 128)


def test_density_is_zero_outside_the_box():
    outside = torch.tensor([[1.001, 0.0, 1.5], [0.0, -2.1, 1.0], [0.0, 0.0, 3.1]])
    assert torch.equal(small().density(outside), torch.zeros(3))


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
def test_an_untrained_field_has_its_initial_opacity_and_a_gradient(opacity):
    field = small(trained=False, initial_opacity=opacity)
    length = float((BOX[1] - BOX[0]).mean())
    density = field.density(points()[0])
    torch.testing.assert_close(density, torch.full((40,), -math.log(1 - opacity) / length))
    (1 - torch.exp(-density * length)).mean().backward()
    slope = field.density_head.bias.grad.item()
    assert slope > 0.02
    assert field.density_head.weight.grad.abs().max() > 1e-3


def test_values_without_gradient_are_taken_in_parts(monkeypatch):
    field, (x, d) = small(), points()
    whole = field.density(x), field.colour(x, d)
    monkeypatch.setattr("backbones.mlp._CHUNK", 7)
    rays = torch.arange(40) % 5
    with torch.no_grad():
        torch.testing.assert_close(field.density(x), whole[0], atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(field.colour(x, d), whole[1], atol=1e-6, rtol=1e-5)
        by_ray = field.colour_of_rays(x, d[:5], rays)
    torch.testing.assert_close(by_ray, field.colour(x, d[:5][rays]), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(
        field.colour_of_features(field._hidden(x), d[:5], rays), by_ray, atol=1e-6, rtol=1e-5
    )


def test_bfloat16_products_are_close_to_those_in_float32():
    x, d = points()
    low, full = small(precision="bfloat16"), small()
    torch.testing.assert_close(low.density(x), full.density(x), atol=0.05, rtol=0.05)
    torch.testing.assert_close(low.colour(x, d), full.colour(x, d), atol=0.03, rtol=0)


def test_the_same_seed_gives_the_same_weights():
    one, two, other = (small(seed, trained=False) for seed in (1, 1, 2))
    for a, b in zip(one.parameters(), two.parameters(), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(one.trunk[0].weight, other.trunk[0].weight)


# --- masks on the encodings --------------------------------------------------------------------


@given(step=st.integers(0, 100))
def test_masks_close_octaves_of_both_encodings(step):
    field, (x, d) = small(), points()
    composition = [gridreg.FrequencyMask(f"encoding.{name}", until=90) for name in ("position", "direction")]
    with gridreg.apply(field, *composition, total_steps=100) as handle:
        handle.step(step)
        density, colour = field.density(x), field.colour(x, d)
    masks = [gridreg.frequency_mask(count + 1, step, 90, block=1).double().numpy() for count in (3, 2)]
    expected = by_numpy(field, x, d, *masks)
    np.testing.assert_allclose(density.detach().numpy(), expected[0], atol=1e-4, rtol=1e-4)
    np.testing.assert_allclose(colour.detach().numpy(), expected[1], atol=1e-4)


def test_closed_octaves_get_no_gradient_where_the_position_enters_again():
    field, (x, d) = small(), points()
    with gridreg.apply(field, gridreg.FrequencyMask("encoding.position"), total_steps=100):
        field.colour(x, d).sum().backward()
    for layer in (field.trunk[0], field.trunk[2]):
        gradient = layer.weight.grad
        assert torch.equal(gradient[:, 3:21], torch.zeros_like(gradient[:, 3:21]))
        assert gradient[:, :3].abs().max() > 0
    assert field.trunk[2].weight.grad[:, 21:].abs().max() > 0


def test_removing_masks_restores_the_field_exactly():
    field, (x, d) = small(), points()
    before = field.density(x), field.colour(x, d)
    handle = gridreg.apply(field, *gridreg.composition("freenerf"), total_steps=100)
    assert not torch.equal(field.density(x), before[0])
    handle.remove()
    assert torch.equal(field.density(x), before[0])
    assert torch.equal(field.colour(x, d), before[1])


# --- the march ---------------------------------------------------------------------------------


def rays_at(count=6, seed=0):
    """Rays from outside through the box; the last one misses it."""
    generator = torch.Generator().manual_seed(seed)
    aim = points(count, seed)[0]
    origins = aim + 6 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    directions = torch.nn.functional.normalize(aim - origins, dim=-1)
    directions[-1] *= -1
    return Rays(origins, directions)


def marched(field, occupancy=None, jitter=None, rays=None):
    rays = rays_at() if rays is None else rays
    t_min, t_max = box_intersection(rays, field.bounds)
    grid = OccupancyGrid.full(field.bounds, (5, 6, 7)) if occupancy is None else occupancy
    jitter = torch.linspace(0, 0.99, len(rays)) if jitter is None else jitter
    return field.march_density(rays, t_min, t_max, 0.01, grid, jitter, 1e-4), t_min, t_max


def test_the_march_returns_both_looks_in_order():
    field = small()
    found, t_min, t_max = marched(field)
    counts = found.offsets.diff()
    assert counts.tolist() == [16] * 5 + [0]
    assert found.ray_steps.tolist() == [16] * 5 + [0]
    for ray in range(5):
        part = slice(int(found.offsets[ray]), int(found.offsets[ray + 1]))
        t = found.t[part]
        assert bool((t.diff() >= 0).all())
        assert found.index[part].tolist() == list(range(16))
        assert float(found.delta[part].sum()) == pytest.approx(float(t_max[ray] - t_min[ray]), rel=1e-5)
        even = t_min[ray] + (torch.arange(6) + 0.99 * ray / 5) * (t_max[ray] - t_min[ray]) / 6
        assert all(float((t - place).abs().min()) < 1e-5 for place in even)
    torch.testing.assert_close(found.density, field.density(found.positions))
    torch.testing.assert_close(found.features, field._hidden(found.positions))


def test_the_second_look_goes_where_the_first_one_saw_something():
    field = small()
    # A slab near x = 0.5, opaque to all rays that cross it.
    field._density_of = lambda hidden: 1e-4 + 200.0 * (hidden[:, 0] > 0.4) * (hidden[:, 0] < 0.6)
    field._hidden = lambda x: x
    rays = Rays(torch.tensor([[-3.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    grid = OccupancyGrid.full(field.bounds, (1, 1, 1))
    field.coarse_samples, field.fine_samples = 20, 40
    found = marched(field, grid, torch.tensor([0.5]), rays)[0]
    near = (found.positions[:, 0] > 0.3) & (found.positions[:, 0] < 0.7)
    assert int(near.sum()) >= 38
    assert len(found.t) == 60


def test_empty_cells_are_skipped_and_still_counted():
    field = small()
    grid = OccupancyGrid.full(BOX, (4, 4, 4))
    grid.cells[:2] = 0
    found = marched(field, grid)[0]
    assert bool((found.positions[:, 0] >= 0).all())
    assert 0 < len(found.t) < 80
    assert found.ray_steps.tolist() == [16] * 5 + [0]
    assert int(found.index.max()) <= 15
    grid.cells[:] = 0
    assert len(marched(field, grid)[0].t) == 0


def test_the_same_jitter_gives_the_same_samples_and_another_one_others():
    field = small()
    one, two = marched(field)[0], marched(field)[0]
    assert torch.equal(one.t, two.t)
    assert torch.equal(one.density, two.density)
    assert not torch.equal(marched(field, jitter=torch.full((6,), 0.3))[0].t, one.t)


def test_the_first_look_leaves_no_gradient():
    field = small()
    looks = []
    inner = field._hidden
    field._hidden = lambda x: looks.append((torch.is_grad_enabled(), len(x))) or inner(x)
    found = marched(field)[0]
    assert looks == [(False, 30), (True, 80)]
    found.density.sum().backward()
    assert all(p.grad is not None for p in field.trunk.parameters())


def test_an_untrained_field_renders_to_its_opacity_whatever_the_sampling():
    field = small(trained=False)
    rays = rays_at()
    t_min, t_max = box_intersection(rays, BOX)
    grid = OccupancyGrid.full(BOX, (1, 1, 1))
    march = MarchSettings(0.5, transmittance_bound=0.0, weight_bound=0.0)
    out = render_rays(field, rays, grid, march, background=torch.ones(3))
    level = float(field.density(points(1)[0]).detach())
    torch.testing.assert_close(out.opacity, 1 - torch.exp(-level * (t_max - t_min)), atol=1e-5, rtol=1e-5)
    assert len(out.samples) == 80
    torch.testing.assert_close(
        out.samples.colours,
        field.colour(out.samples.positions, rays.directions[out.samples.ray_indices]),
        atol=1e-6,
        rtol=1e-5,
    )


def test_occlusion_counts_the_first_samples_of_each_ray():
    field = small(trained=False)
    grid = OccupancyGrid.full(BOX, (1, 1, 1))
    out = render_rays(field, rays_at(), grid, MarchSettings(0.5), background=torch.ones(3))
    level = float(field.density(points(1)[0]).detach())
    found = gridreg.occlusion_loss(out.samples, 4).detach()
    assert float(found) == pytest.approx(level * 4 / 16, rel=1e-5)


def test_pictures_hardly_depend_on_the_chunk_size():
    field = small()
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.0, -0.5, 7.0])
    grid = OccupancyGrid.full(BOX, (4, 4, 4))
    camera = Camera(pose, Lens((12.0, 12.0, 4.0, 4.0), 8, 8))
    model = Model(field, grid, MarchSettings(0.5))
    one, two = (model.render(camera, chunk=c).colour for c in (64, 5))
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)
    assert float(one.std()) > 0.01


# --- training ----------------------------------------------------------------------------------

SETTINGS = TrainSettings(
    steps=60,
    rays=48,
    learning_rate_network=1e-2,
    resample_at=(2, 4),
    occupancy_at=(3,),
    shrink_at=(3,),
    filter_rays_at=(),
    occupancy_resolution=12,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=16), "builtin8", test=[0])


def config(**changes):
    return RunConfig(backbone="mlp", field=TINY, train=SETTINGS, composition="freenerf", **changes)


def test_a_trainer_passes_over_the_events_of_grids(scene):
    trainer = build_trainer(config(), scene)
    box = trainer.field.bounds.clone()
    reports = []
    trainer.train(each=lambda report: reports.append(report) is None)
    assert trainer.step == 60
    assert torch.equal(trainer.field.bounds, box)
    assert reports[0]["OcclusionLoss"] > 0
    first, last = (sum(r["mse"] for r in part) for part in (reports[:5], reports[-5:]))
    assert last < 0.6 * first
    assert [g["name"] for g in trainer.optimizer.param_groups] == ["network"]
    assert trainer.optimizer.param_groups[0]["betas"] == (0.9, 0.999)


def test_a_run_goes_on_bit_for_bit_and_its_checkpoint_renders(scene, tmp_path):
    whole, first = build_trainer(config(), scene), build_trainer(config(), scene)
    whole.train(until=12)
    first.train(until=5)
    save_run(tmp_path / "checkpoint", first, config(), {})
    second = build_trainer(config(), scene)
    second.load_state_dict(first.state_dict())
    second.train(until=12)
    for name, value in whole.field.state_dict().items():
        assert torch.equal(value, second.field.state_dict()[name]), name
    loaded = load_run(tmp_path)
    # Masks are those of the next iteration.
    first.handle.step(first.step)
    x, d = points(10)
    loaded_density, density = loaded.field.density(x), first.field.density(x)
    torch.testing.assert_close(loaded_density, density)
    torch.testing.assert_close(loaded.field.colour(x, d), first.field.colour(x, d))


def test_bad_arguments_are_named():
    for options, text in (
        ({"width": 0}, "width=0: expected at least 1"),
        ({"depth": 5}, "depth=5: expected at least 6"),
        ({"skip": -1}, "skip=-1"),
        ({"fine_samples": 0}, "fine_samples=0"),
        ({"initial_opacity": 1.0}, "initial_opacity=1.0"),
    ):
        with pytest.raises(ValueError, match=text):
            MLPField(BOX, **options)
    with pytest.raises(ValueError, match="bounds="):
        MLPField(BOX.flip(0))
    with pytest.raises(gridreg.InputError, match="backbone 'mlp'"):
        make_field("mlp", BOX, (4, 4, 4), density_components=4)
    with pytest.raises(gridreg.InputError, match="density"):
        gridreg.apply(small(), gridreg.FrequencyMask("density"), total_steps=10)
