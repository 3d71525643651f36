"""Coarse and fine sampling against NumPy, and rendering with samples of unequal lengths."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from backbones.hierarchical import intervals, inverse_transform, stratified
from gridreg.rendering import MarchSettings, OccupancyGrid, RayMarchResult, Rays, render_rays

RAYS = st.integers(1, 4)
SEEDS = st.integers(0, 1000)


def ends(rays, seed):
    generator = torch.Generator().manual_seed(seed)
    t_min = torch.rand(rays, generator=generator) * 3
    return t_min, t_min + 0.5 + torch.rand(rays, generator=generator), torch.rand(rays, generator=generator)


@given(rays=RAYS, count=st.integers(1, 9), seed=SEEDS)
def test_one_sample_lies_in_each_equal_part(rays, count, seed):
    t_min, t_max, jitter = ends(rays, seed)
    t, edges = stratified(t_min, t_max, count, jitter)
    width = (t_max - t_min)[:, None] / count
    expected = t_min[:, None] + (torch.arange(count) + jitter[:, None]) * width
    torch.testing.assert_close(t, expected)
    torch.testing.assert_close(edges.diff(dim=1), width.expand(rays, count), atol=1e-5, rtol=1e-4)
    assert torch.equal(edges[:, 0], t_min)
    assert torch.equal(edges[:, -1], t_max)


def inverse_by_numpy(edges, weights, wanted, padding):
    """The inverse of the cumulative distribution by NumPy's linear interpolation."""
    shares = weights + padding
    cumulative = np.concatenate([[0.0], np.cumsum(shares / shares.sum())])
    return np.interp(wanted, cumulative, edges)


@given(parts=st.integers(1, 8), count=st.integers(1, 16), seed=SEEDS)
def test_fine_samples_invert_the_distribution(parts, count, seed):
    generator = np.random.default_rng(seed)
    edges = np.cumsum(0.1 + generator.random(parts + 1))
    weights, jitter = generator.random(parts), generator.random()
    found = inverse_transform(
        torch.tensor(edges)[None],
        torch.tensor(weights)[None],
        count,
        torch.tensor([jitter], dtype=torch.float64),
    )[0]
    expected = inverse_by_numpy(edges, weights, (np.arange(count) + jitter) / count, 1e-5)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
    assert bool((found.diff() >= 0).all())


def test_samples_gather_in_proportion_to_the_weights():
    edges, weights = torch.linspace(0, 4, 5)[None], torch.tensor([[0.1, 0.6, 0.0, 0.3]])
    t = inverse_transform(edges, weights, 1000, torch.tensor([0.5]), padding=0.0)[0]
    counts = torch.histc(t, 4, 0, 4)
    torch.testing.assert_close(counts, torch.tensor([100.0, 600.0, 0.0, 300.0]), atol=1.0, rtol=0)


def test_a_ray_that_saw_nothing_is_sampled_evenly():
    edges = torch.linspace(2, 6, 9)[None]
    t = inverse_transform(edges, torch.zeros(1, 8), 16, torch.tensor([0.5]))[0]
    torch.testing.assert_close(t, 2 + (torch.arange(16) + 0.5) / 4)


@given(count=st.integers(1, 12), seed=SEEDS)
def test_intervals_meet_half_way_and_fill_the_ray(count, seed):
    t_min, t_max, _ = ends(3, seed)
    shares = torch.rand(3, count, generator=torch.Generator().manual_seed(seed)).sort(dim=1).values
    t = t_min[:, None] + shares * (t_max - t_min)[:, None]
    lengths = intervals(t, t_min, t_max)
    torch.testing.assert_close(lengths.sum(1), t_max - t_min, atol=1e-5, rtol=1e-5)
    assert bool((lengths >= 0).all())
    for ray in range(3):
        edges = [t_min[ray].item()]
        edges += [(a + b) / 2 for a, b in zip(t[ray, :-1].tolist(), t[ray, 1:].tolist(), strict=True)]
        edges.append(t_max[ray].item())
        np.testing.assert_allclose(lengths[ray].numpy(), np.diff(edges), atol=1e-5)


class Fog(nn.Module):
    """The same density and colour everywhere, sampled by a march of its own."""

    def __init__(self, positions, answer=RayMarchResult):
        super().__init__()
        self.register_buffer("bounds", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.level = nn.Parameter(torch.tensor(0.8))
        self.places, self.answer, self.asked = positions, answer, []

    def density(self, x):
        return self.level.expand(len(x))

    def colour(self, x, d):
        return torch.full((len(x), 3), 0.25)

    def colour_of_features(self, features, directions, ray_indices):
        self.asked.append((features.detach(), ray_indices))
        return features.expand(-1, 3)

    def march_density(self, rays, t_min, t_max, step, occupancy, jitter, transmittance_bound):
        count = len(self.places)
        t = t_min[:, None] + self.places * (t_max - t_min)[:, None]
        delta = intervals(t, t_min, t_max).flatten()
        offsets = torch.arange(len(rays) + 1) * count
        index = torch.arange(count).repeat(len(rays))
        x = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).reshape(-1, 3)
        return self.answer(offsets, index, t.flatten(), x, self.density(x), delta)


def rays_along_x(count=3):
    origins = torch.tensor([[-3.0, 0.1, 0.2]]).repeat(count, 1)
    return Rays(origins, torch.tensor([[1.0, 0.0, 0.0]]).repeat(count, 1))


def rendered(field, **options):
    grid = OccupancyGrid.full(field.bounds, (2, 2, 2))
    march = MarchSettings(0.01, transmittance_bound=0.0, weight_bound=0.0)
    return render_rays(field, rays_along_x(), grid, march, background=torch.ones(3), **options)


@pytest.mark.parametrize("answer", [RayMarchResult, lambda *tensors: tensors])
def test_samples_of_unequal_length_are_composited_by_their_own(answer):
    field = Fog(torch.tensor([0.05, 0.1, 0.4, 0.9]), answer)
    out = rendered(field)
    # A homogeneous medium 2 units deep, however it is cut.
    opacity = 1 - np.exp(-0.8 * 2.0)
    torch.testing.assert_close(out.opacity, torch.full((3,), opacity, dtype=torch.float32))
    torch.testing.assert_close(out.samples.delta.reshape(3, 4).sum(1), torch.full((3,), 2.0))
    torch.testing.assert_close(
        out.colour, torch.full((3, 3), opacity * 0.25 + 1 - opacity, dtype=torch.float32)
    )
    assert out.samples.steps.tolist() == [4, 4, 4]
    out.opacity.sum().backward()
    assert field.level.grad.item() == pytest.approx(3 * 2 * np.exp(-1.6), rel=1e-4)


def test_a_march_may_count_skipped_samples_and_bring_features():
    def answer(*tensors):
        features = torch.arange(12.0)[:, None] / 12
        return RayMarchResult(*tensors, ray_steps=torch.tensor([7, 7, 7]), features=features)

    field = Fog(torch.tensor([0.1, 0.2, 0.5, 0.7]), answer)
    out = rendered(field)
    assert out.samples.steps.tolist() == [7, 7, 7]
    ((features, ray_indices),) = field.asked
    assert features.shape == (12, 1)
    assert torch.equal(ray_indices, out.samples.ray_indices)
    torch.testing.assert_close(out.samples.colours, features.expand(-1, 3))


def test_samples_of_one_step_count_as_before():
    field = Fog(torch.tensor([0.5]), lambda *tensors: tensors[:5])
    out = rendered(field)
    torch.testing.assert_close(out.samples.delta, torch.full((3,), 0.01))
    assert out.samples.steps.tolist() == [200, 200, 200]
