"""Low-weight samples that share a colour: what is in a group, and that nothing changes in expectation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from backbones.vm import VMField
from gridreg import ops
from gridreg.ops import use_backend
from gridreg.ops.merging import merge_neighbours
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, render, render_rays


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@st.composite
def packed(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Weights of the samples of some rays, over five orders of magnitude, and the ray of each."""
    lengths = draw(st.lists(st.integers(0, 12), max_size=8))
    exponents = draw(st.lists(st.floats(-5, 0), min_size=sum(lengths), max_size=sum(lengths)))
    weights = 10.0 ** torch.tensor(exponents, dtype=torch.float32)
    return weights, torch.repeat_interleave(
        torch.arange(len(lengths)), torch.tensor(lengths, dtype=torch.int64)
    )


@given(samples=packed(), bound=st.sampled_from([1e-3, 1e-2, 0.3]), seed=st.none() | st.integers(0, 99))
def test_groups_are_runs_of_low_weight_neighbours_on_one_ray(samples, bound, seed):
    weights, rays = samples
    representatives, groups = merge_neighbours(weights, rays, bound, None if seed is None else seeded(seed))
    assert groups.shape == weights.shape
    # Every group has its representative among its members, and groups follow one another.
    assert torch.equal(groups[representatives], torch.arange(len(representatives)))
    assert torch.equal(groups.unique_consecutive(), torch.arange(len(representatives)))
    for number in range(len(representatives)):
        members = (groups == number).nonzero().squeeze(-1)
        assert len(rays[members].unique()) == 1
        if len(members) > 1:
            assert bool((weights[members] < bound).all())
            assert float(weights[members].double().sum()) < 2 * bound
    # Two low-weight neighbours stay apart only where a group is full.
    assert len(representatives) <= len(weights)


@given(
    samples=packed(),
    bounds=st.sampled_from([(1e-4, 0.0), (1e-4, 1e-3), (1e-3, 1e-2), (0.0, 0.3), (1e-2, 1e-2)]),
    seed=st.none() | st.integers(0, 99),
)
def test_compiled_groups_are_the_plain_ones(samples, bounds, seed):
    weights, rays = samples
    offsets = torch.zeros(10, dtype=torch.int64)
    offsets[1:] = torch.bincount(rays, minlength=9).cumsum(0)
    found = []
    for name in ("compiled", "torch"):
        with ops.use_backend(name):
            found.append(ops.merge_samples(weights, offsets, *bounds, None if seed is None else seeded(seed)))
    for compiled, plain in zip(*found, strict=True):
        assert torch.equal(compiled, plain)
    representatives, of_rays, groups = found[0]
    assert torch.equal(of_rays, rays[representatives])
    assert torch.equal(groups >= 0, weights > bounds[0])


@given(samples=packed(), floor=st.sampled_from([1e-4, 1e-2, 2.0]), channels=st.integers(1, 4))
def test_colours_of_groups_and_their_gradients(samples, floor, channels):
    weights, rays = samples
    offsets = torch.zeros(9, dtype=torch.int64)
    offsets[1:] = torch.bincount(rays, minlength=8).cumsum(0)
    representatives, _, groups = ops.merge_samples(weights, offsets, floor, 0.1)
    colours = torch.rand(len(representatives), channels, generator=seeded()).requires_grad_()
    upstream = torch.rand(len(weights), channels, generator=seeded(1))
    found = []
    for name in ("compiled", "torch"):
        with ops.use_backend(name):
            out = ops.spread_to_samples(colours, groups, representatives)
            found.append((out.detach(), *torch.autograd.grad(out, colours, upstream)))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=0)
    torch.testing.assert_close(found[0][1], found[1][1])


def test_no_samples():
    representatives, groups = merge_neighbours(
        torch.empty(0), torch.empty(0, dtype=torch.int64), 0.1, seeded()
    )
    assert representatives.shape == groups.shape == (0,)


def test_representatives_are_drawn_in_proportion_to_weight():
    weights, rays = torch.tensor([1e-4, 3e-4, 6e-4]), torch.zeros(3, dtype=torch.int64)
    generator, count = seeded(), torch.zeros(3)
    for _ in range(4000):
        representatives, _ = merge_neighbours(weights, rays, 1e-2, generator)
        count[representatives] += 1
    # Standard error of a share: below 0.008.
    torch.testing.assert_close(count / 4000, torch.tensor([0.1, 0.3, 0.6]), atol=0.035, rtol=0)


class Fog(nn.Module):
    """Thin fog of changing colour."""

    def __init__(self, density: float = 0.3) -> None:
        super().__init__()
        self.register_buffer("bounds", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.level = nn.Parameter(torch.tensor(density))
        self.tint = nn.Parameter(torch.tensor([0.9, 0.5, 0.1]))
        self.asked = 0

    def density(self, x: Tensor) -> Tensor:
        return self.level.expand(x.shape[0]) * (1.5 + torch.sin(5 * x[:, 2]))

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        self.asked += len(x)
        return torch.sigmoid(self.tint + 2 * torch.sin(x[:, 2:] * torch.tensor([5.0, 7.0, 9.0])))


def rays_down(count: int) -> Rays:
    origins = torch.rand(count, 3, generator=seeded()) - 0.5
    origins[:, 2] = 2.0
    return Rays(origins, torch.tensor([0.0, 0.0, -1.0]).expand_as(origins).contiguous())


def image(field: Fog, merge_weight: float, generator: torch.Generator | None) -> Tensor:
    march = MarchSettings(0.01, weight_bound=1e-4, transmittance_bound=0.0, merge_weight=merge_weight)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    return render_rays(
        field, rays_down(16), grid, march, background=torch.ones(3), generator=generator
    ).colour


def test_the_mean_of_many_draws_is_the_image_without_merging():
    field = Fog()
    exact = image(field, 0.0, seeded()).detach()
    generator = seeded()
    draws = torch.stack([image(field, 0.02, generator).detach() for _ in range(300)])
    error = (draws.mean(0) - exact).abs()
    assert float(draws.std(0).min()) > 0
    assert bool((error < 5 * draws.std(0) / 300**0.5 + 1e-6).all())
    # One draw differs by the spread of colours within groups of 2 %: half a percent of white here.
    assert float((draws - exact).square().mean().sqrt()) < 0.005


def test_the_mean_gradient_of_colours_is_the_one_without_merging():
    field = Fog()

    def gradient(merge_weight: float, generator: torch.Generator) -> Tensor:
        found = torch.autograd.grad(image(field, merge_weight, generator).square().sum(), field.tint)[0]
        return found / 16

    exact, generator = gradient(0.0, seeded()), seeded()
    draws = torch.stack([gradient(0.02, generator) for _ in range(300)])
    error = (draws.mean(0) - exact).abs()
    assert bool((error < 5 * draws.std(0) / 300**0.5 + 1e-4).all())


def test_fewer_colours_are_asked_for():
    field = Fog()
    image(field, 0.0, seeded())
    every, field.asked = field.asked, 0
    image(field, 0.02, seeded())
    assert 0 < field.asked < every / 3


def test_a_ray_does_not_depend_on_its_company():
    """Without a generator a group's representative lies at half of its weight, whatever else is rendered."""
    field, march = Fog(), MarchSettings(0.01, weight_bound=1e-4, transmittance_bound=0.0, merge_weight=0.02)
    grid, rays = OccupancyGrid.full(field.bounds, (8, 8, 8)), rays_down(16)
    together = render_rays(field, rays, grid, march, background=torch.ones(3)).colour
    for start, stop in ((0, 1), (3, 8), (8, 16)):
        some = Rays(rays.origins[start:stop], rays.directions[start:stop])
        apart = render_rays(field, some, grid, march, background=torch.ones(3)).colour
        assert torch.equal(apart, together[start:stop])
    exact = image(field, 0.0, None)
    # As good as a draw, in this fog of colours that change quickly; never quite the same.
    assert 0 < float((together - exact).detach().square().mean().sqrt()) < 0.005


def test_without_gradients_colours_come_in_blocks(monkeypatch):
    field = Fog()
    every = image(field, 0.0, None)
    monkeypatch.setattr(render, "_BLOCK", 100)
    sizes, whole = [], field.colour
    monkeypatch.setattr(field, "colour", lambda x, d: (sizes.append(len(x)), whole(x, d))[1])
    with torch.no_grad():
        assert torch.equal(image(field, 0.0, None), every)
    assert max(sizes) == 100
    assert len(sizes) > 2


def averaged_field() -> VMField:
    bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return VMField(
        bounds,
        (12, 13, 14),
        appearance_components=8,
        scale=0.5,
        density_shift=None,
        initial_opacity=0.9,
        generator=seeded(),
        precision="float32",
    )


def averaged_image(field: nn.Module, feature_weight: float) -> Tensor:
    march = MarchSettings(0.05, merge_weight=0.02, feature_weight=feature_weight)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    return render_rays(field, rays_down(40), grid, march, background=torch.ones(3)).colour


def test_means_of_a_linear_field_change_nothing():
    """What is averaged before a linear decoder could be averaged behind it."""
    field = averaged_field()
    field.decoder = nn.Module()
    field.decoder.forward = lambda features, directions, positions, ray_indices: (
        features[:, :3] + positions + directions[ray_indices]
    )
    exact = averaged_image(field, 0.0)
    for bound in (0.05, 0.3, 0.99):
        torch.testing.assert_close(averaged_image(field, bound), exact, atol=1e-5, rtol=0)


@pytest.mark.parametrize("bound", [0.05, 0.3])
def test_compiled_and_plain_means_agree(bound):
    field, target = averaged_field(), torch.rand(40, 3, generator=seeded())
    found = {}
    for backend in ("auto", "torch"):
        with use_backend(backend):
            image = averaged_image(field, bound)
            slopes = torch.autograd.grad((image - target).square().mean(), list(field.parameters()))
        found[backend] = [image.detach(), *slopes]
    assert float((found["auto"][0] - found["torch"][0]).abs().max()) < 1 / 255
    for ours, plain in zip(found["auto"], found["torch"], strict=True):
        torch.testing.assert_close(ours, plain, atol=2e-6, rtol=2e-3)


def test_means_of_a_long_image_come_in_blocks(monkeypatch):
    field = averaged_field()
    with torch.no_grad():
        every = averaged_image(field, 0.3)
        monkeypatch.setattr(render, "_BLOCK", 50)
        torch.testing.assert_close(averaged_image(field, 0.3), every, atol=1e-6, rtol=0)


def test_fewer_colours_are_asked_for_with_means():
    field, asked = averaged_field(), []
    whole = field.decoder.forward
    field.decoder.forward = lambda features, *others: (asked.append(len(features)), whole(features, *others))[
        1
    ]
    averaged_image(field, 0.0)
    averaged_image(field, 0.3)
    assert 0 < asked[1] < asked[0] / 3


def test_runs_weigh_less_than_twice_their_bound_and_never_hold_two_rays():
    weights = torch.rand(200, generator=seeded()) * 0.1
    offsets = torch.tensor([0, 60, 60, 150, 200])
    _, rays, groups = ops.merge_samples(weights, offsets, 1e-4, 0.02)
    means = ops.average_features(weights, groups, rays, 0.2)
    inside = means.of_samples >= 0
    totals = torch.zeros(len(means.offsets) - 1).index_add_(0, means.of_samples[inside], weights[inside])
    assert float(totals.max()) < 0.4
    assert int(means.offsets[-1]) == len(rays) == len(means.fractions)
    for first, last in zip(means.offsets[:-1].tolist(), means.offsets[1:].tolist(), strict=True):
        assert rays[first:last].unique().numel() == 1
        assert float(means.fractions[first:last].sum()) == pytest.approx(1.0, abs=1e-5)
