"""The renderer against scenes whose pictures are known in closed form."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from gridreg.rendering import Camera, Lens, MarchSettings, Model, OccupancyGrid, Rays, render_rays


class Sphere(nn.Module):
    """A homogeneous ball of one colour."""

    def __init__(self, radius: float = 1.0, density: float = 2.0) -> None:
        super().__init__()
        self.register_buffer("bounds", torch.tensor([[-1.5] * 3, [1.5] * 3]))
        self.radius = radius
        self.level = nn.Parameter(torch.tensor(density))
        self.tint = nn.Parameter(torch.tensor([0.9, 0.5, 0.1]))

    def density(self, x):
        return torch.where(x.norm(dim=-1) < self.radius, self.level, torch.zeros_like(x[:, 0]))

    def colour(self, x, d):
        return self.tint.expand(x.shape[0], 3)


def parallel_rays(offsets):
    origins = torch.stack([offsets, torch.zeros_like(offsets), torch.full_like(offsets, 3.0)], dim=-1)
    return Rays(origins, torch.tensor([0.0, 0.0, -1.0]).expand_as(origins).contiguous())


WHITE = torch.ones(3)
EXACT = {"transmittance_bound": 0.0, "weight_bound": 0.0}


@given(radius=st.floats(0.3, 1.3), density=st.floats(0.1, 6.0), offset=st.floats(-1.4, 1.4))
def test_opacity_and_colour_of_a_homogeneous_ball(radius, density, offset):
    field = Sphere(radius, density)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    step = 1e-3
    out = render_rays(
        field, parallel_rays(torch.tensor([offset])), grid, MarchSettings(step, **EXACT), background=WHITE
    )
    chord = 2 * math.sqrt(max(0.0, radius**2 - offset**2))
    opacity = 1 - math.exp(-density * chord)
    # Both ends of the chord are met to within a step.
    slack = 2 * step * density + 1e-5
    assert out.opacity.item() == pytest.approx(opacity, abs=slack)
    expected = opacity * field.tint + (1 - opacity)
    torch.testing.assert_close(out.colour[0], expected, atol=slack, rtol=0)


@given(density=st.floats(0.2, 8.0), offset=st.floats(-0.8, 0.8))
def test_depth_of_a_homogeneous_ball(density, offset):
    field = Sphere(1.0, density)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    out = render_rays(
        field, parallel_rays(torch.tensor([offset])), grid, MarchSettings(1e-3, **EXACT), background=WHITE
    )
    half = math.sqrt(1 - offset**2)
    enter, chord = 3.0 - half, 2 * half
    # int_0^L (a + s) sigma exp(-sigma s) ds
    decay = math.exp(-density * chord)
    expected = enter * (1 - decay) + (1 - decay) / density - chord * decay
    assert out.depth.item() == pytest.approx(expected, abs=6e-3)


def test_gradient_of_opacity_is_the_analytic_one():
    field = Sphere(1.0, 0.7)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    out = render_rays(
        field, parallel_rays(torch.tensor([0.0])), grid, MarchSettings(1e-3, **EXACT), background=WHITE
    )
    out.opacity.sum().backward()
    assert field.level.grad.item() == pytest.approx(2 * math.exp(-1.4), rel=2e-3)


def test_empty_cells_are_skipped_and_leave_the_picture_alone():
    field = Sphere(0.6, 5.0)
    full = OccupancyGrid.full(field.bounds, (24, 24, 24))
    pruned = OccupancyGrid.full(field.bounds, (24, 24, 24))
    pruned.update(field.density, step=0.05)
    assert 0 < pruned.fraction < 0.2
    rays = parallel_rays(torch.linspace(-1.4, 1.4, 57))
    one = render_rays(field, rays, full, MarchSettings(0.01), background=WHITE)
    two = render_rays(field, rays, pruned, MarchSettings(0.01), background=WHITE)
    torch.testing.assert_close(one.colour, two.colour, atol=1e-5, rtol=0)
    assert len(two.samples) < 0.6 * len(one.samples)


@given(bound=st.sampled_from([1e-2, 1e-3, 1e-4]), density=st.floats(0.5, 40.0))
def test_early_termination_changes_a_pixel_by_at_most_its_bound(bound, density):
    field = Sphere(1.2, density)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    rays = parallel_rays(torch.linspace(-1.3, 1.3, 27))
    exact = render_rays(field, rays, grid, MarchSettings(0.02, **EXACT), background=WHITE)
    cut = render_rays(
        field, rays, grid, MarchSettings(0.02, transmittance_bound=bound, weight_bound=0.0), background=WHITE
    )
    assert (exact.colour - cut.colour).abs().max() <= bound + 1e-5
    assert len(cut.samples) <= len(exact.samples)


def test_background_shows_where_nothing_is():
    field = Sphere(0.2)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    behind = torch.rand(5, 3, generator=torch.Generator().manual_seed(1))
    out = render_rays(
        field, parallel_rays(torch.full((5,), 1.2)), grid, MarchSettings(0.05), background=behind
    )
    torch.testing.assert_close(out.colour, behind)
    assert out.opacity.abs().max() == 0


def test_a_ray_that_misses_the_box_has_no_samples():
    field = Sphere()
    grid = OccupancyGrid.full(field.bounds, (4, 4, 4))
    out = render_rays(field, parallel_rays(torch.tensor([7.0])), grid, MarchSettings(0.1), background=WHITE)
    assert len(out.samples) == 0
    torch.testing.assert_close(out.colour, torch.ones(1, 3))


def camera(distance=4.0):
    pose = torch.eye(4)
    pose[2, 3] = distance
    return Camera(pose, Lens((40.0, 40.0, 16.0, 12.0), 24, 32))


def test_pictures_do_not_depend_on_the_chunk_size():
    field = Sphere()
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    model = Model(field, grid, MarchSettings(0.05), WHITE)
    pictures = [model.render(camera(), chunk=chunk) for chunk in (7, 100, 10_000)]
    for other in pictures[1:]:
        assert torch.equal(pictures[0].colour, other.colour)
        assert torch.equal(pictures[0].depth, other.depth)


def test_a_picture_is_not_mirrored():
    field = Sphere(0.3, 30.0)
    field.register_buffer("centre", torch.tensor([0.8, 0.5, 0.0]))
    field.density = lambda x: torch.where((x - field.centre).norm(dim=-1) < 0.3, 30.0, 0.0)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    out = Model(field, grid, MarchSettings(0.05), WHITE).render(camera())
    rows, columns = (out.opacity > 0.5).nonzero(as_tuple=True)
    # x = 0.8, y = 0.5 at depth about 4: right of the centre and above it.
    assert columns.float().mean().item() + 0.5 == pytest.approx(16 + 40 * 0.8 / 4, abs=0.8)
    assert rows.float().mean().item() + 0.5 == pytest.approx(12 - 40 * 0.5 / 4, abs=0.8)
