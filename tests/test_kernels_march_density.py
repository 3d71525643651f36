"""March, density and early termination in one: the same samples and gradients as the three steps by themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg import ops
from gridreg.errors import InputError
from gridreg.ops import use_backend
from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.simd_math import softplus
from gridreg.ops.cpu.jit.table import float32, next_task, vector
from tests.kernel_grids import close, make_grids, threads

SCALE = 25.0


def make_scene(seed, rays, step, fill):
    """Rays through a box of cells larger than the field's own box, and the field's box."""
    g = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=g), dim=-1)
    origins = torch.rand(rays, 3, generator=g) * 2 - 1 - 3 * directions
    cells = (torch.rand(7, 8, 9, generator=g) < fill).to(torch.uint8)
    cell_bounds = torch.tensor([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]])
    t_min, t_max = torch.full((rays,), 1.0), torch.rand(rays, generator=g) * 4 + 1
    bounds = torch.tensor([[-1.5, -1.2, -1.5], [1.4, 1.5, 1.5]])
    march = ops.MarchArguments(
        origins, directions, t_min, t_max, step, cells, cell_bounds, torch.rand(rays, generator=g)
    )
    return march, bounds


def run(backend, march, activation, bound, planes, lines, opened=None):
    """Result and the gradients of the grids."""
    leaves = [x.clone().requires_grad_() for x in (*planes, *lines)]
    with use_backend(backend):
        if planes:
            found = ops.vm_march_density(march, activation, bound, leaves[:3], leaves[3:], opened)
        else:
            found = ops.cp_march_density(march, activation, bound, leaves, opened)
        upstream = torch.randn(found[4].shape, generator=torch.Generator().manual_seed(0))
        found[4].backward(upstream)
    return [x.detach() for x in found[:5]], [x.grad for x in leaves]


def depth_before(density, step, offsets):
    """Optical depth in front of each sample, float64."""
    depth = torch.cumsum(density.double() * step, 0)
    ray = torch.repeat_interleave(offsets.diff())
    start = torch.cat([torch.zeros(1, dtype=torch.float64), depth])[offsets[:-1]]
    return depth - density.double() * step - start[ray]


@pytest.mark.parametrize("planar", [True, False])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    rays=st.sampled_from([0, 1, 2, 33]),
    count=st.integers(1, 18),
    shift=st.sampled_from([-10.0, -5.0, 0.0, 3.0]),
    bound=st.sampled_from([0.0, 1e-4, 0.3, 1.0]),
    fill=st.sampled_from([0.0, 0.2, 1.0]),
    step=st.floats(0.01, 0.4),
)
def test_same_samples_and_gradients(planar, seed, rays, count, shift, bound, fill, step):
    march, bounds = make_scene(seed, rays, step, fill)
    planes, lines = make_grids(seed, (5, 6, 4), count)
    planes = planes if planar else []
    activation = ops.Activation(bounds, shift, SCALE)
    (offsets, index, t, positions, density), gradients = run(
        "compiled", march, activation, bound, planes, lines
    )
    expected, expected_gradients = run("torch", march, activation, bound, planes, lines)

    # A transmittance within rounding of the bound may fall to either side.
    everything = run("torch", march, activation, 0.0, planes, lines)[0]
    limit = -math.log(bound) if bound > 0 else math.inf
    depth = depth_before(everything[4], step, everything[0])
    if bool(((depth - limit).abs() < 1e-4 * max(limit, 1e-2)).any()) and bound < 1:
        assert abs(len(index) - len(expected[1])) <= rays
        return
    assert torch.equal(offsets, expected[0])
    assert torch.equal(index, expected[1])
    assert torch.equal(t, expected[2])
    assert torch.equal(positions, expected[3])
    close(density, expected[4], 1e-5)
    for a, b in zip(gradients, expected_gradients, strict=True):
        close(a, b, 1e-4)


@pytest.mark.parametrize("planar", [True, False])
def test_is_the_three_steps(planar):
    march, bounds = make_scene(4, 50, 0.05, 0.5)
    planes, lines = make_grids(4, (9, 8, 7), 16)
    activation = ops.Activation(bounds, -3.0, SCALE)
    if planar:
        offsets, index, t, positions, density = ops.vm_march_density(march, activation, 1e-2, planes, lines)[
            :5
        ]
    else:
        offsets, index, t, positions, density = ops.cp_march_density(march, activation, 1e-2, lines)[:5]

    all_offsets, all_index, all_t, all_positions = ops.march.reference(march)
    u = (all_positions - bounds[0]) / (bounds[1] - bounds[0])
    features = ops.vm_density.reference(u, planes, lines) if planar else ops.cp_density.reference(u, lines)
    all_density = SCALE * torch.nn.functional.softplus(features - 3)
    all_density[((u < 0) | (u > 1)).any(1)] = 0
    seen = ops.terminate.reference(all_density * march.step, all_offsets, 1e-2)
    assert 0 < int(seen.sum()) < len(all_index)
    assert bool((all_density[seen] == 0).any())
    assert torch.equal(index, all_index[seen])
    assert torch.equal(t, all_t[seen])
    assert torch.equal(positions, all_positions[seen])
    assert torch.equal(
        offsets.diff(), torch.stack([x.sum() for x in seen.split(all_offsets.diff().tolist())])
    )
    torch.testing.assert_close(density, all_density[seen], rtol=1e-5, atol=1e-5)


def test_closed_channels():
    march, bounds = make_scene(9, 20, 0.05, 0.5)
    planes, lines = make_grids(9, (9, 8, 7), 16)
    activation = ops.Activation(bounds, -3.0, SCALE)
    found, gradients = run("compiled", march, activation, 0.0, planes, lines, 5)
    expected, expected_gradients = run("torch", march, activation, 0.0, planes, lines, 5)
    close(found[4], expected[4], 1e-5)
    for a, b in zip(gradients, expected_gradients, strict=True):
        close(a, b, 1e-4)
        assert bool((a[..., 5:] == 0).all())


def test_same_bits_for_any_number_of_threads():
    march, bounds = make_scene(5, 400, 0.02, 0.6)
    planes, lines = make_grids(5, (30, 31, 32), 16)
    activation = ops.Activation(bounds, -4.0, SCALE)
    results = []
    for count in (1, 2, 3):
        with threads(count):
            found, gradients = run("compiled", march, activation, 1e-3, planes, lines)
        results.append([*found, *gradients])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_densities_that_are_not_numbers_stay_visible():
    march, bounds = make_scene(5, 10, 0.1, 1.0)
    planes, lines = make_grids(5, (3, 3, 3), 8)
    planes[0][1, 1, 2] = float("nan")
    density = ops.vm_march_density(march, ops.Activation(bounds, -4.0, SCALE), 1e-3, planes, lines)[4]
    assert bool(density.isnan().any())


def test_accumulates_in_place():
    march, bounds = make_scene(5, 30, 0.05, 1.0)
    planes, lines = make_grids(5, (6, 5, 4), 8)
    activation = ops.Activation(bounds, -4.0, SCALE)
    _, expected = run("compiled", march, activation, 1e-3, planes, lines)
    leaves = [x.requires_grad_() for x in (*planes, *lines)]
    buffers = [torch.zeros_like(x) for x in planes]
    for leaf, buffer in zip(leaves[:3], buffers, strict=True):
        leaf.grad = buffer
    with ops.accumulate_into_grad():
        density = ops.vm_march_density(march, activation, 1e-3, leaves[:3], leaves[3:])[4]
        density.backward(torch.randn(density.shape, generator=torch.Generator().manual_seed(0)))
    assert all(leaf.grad is buffer for leaf, buffer in zip(leaves[:3], buffers, strict=True))
    for leaf, gradient in zip(leaves, expected, strict=True):
        torch.testing.assert_close(leaf.grad, gradient)


def test_bad_input():
    march, bounds = make_scene(5, 3, 0.1, 1.0)
    planes, lines = make_grids(5, (3, 3, 3), 8)
    good = ops.Activation(bounds, -4.0, SCALE)
    for activation, bound, message in (
        (good, 1.5, "transmittance_bound: found 1.5"),
        (good._replace(scale=0.0), 0.1, "activation.scale: found 0.0"),
        (good._replace(bounds=bounds[0]), 0.1, "activation.bounds: found shape"),
    ):
        with pytest.raises(InputError, match=message):
            ops.vm_march_density(march, activation, bound, planes, lines)
        with pytest.raises(InputError, match=message):
            ops.cp_march_density(march, activation, bound, lines)
    with pytest.raises(InputError, match="step: found -1"):
        ops.cp_march_density(march._replace(step=-1.0), good, 0.1, lines)


@kernel
def _softplus(table):
    """x, out."""
    x, out = vector(table, 0, float32), vector(table, 1, float32)
    blocks = x.shape[0] - x.shape[0] % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(0, blocks, LANES):
            store(out, i, softplus(load(x, i, vector_zero()), vector_zero()))
        for i in range(blocks, x.shape[0]):
            store(out, i, softplus(load(x, i, scalar_zero()), scalar_zero()))


def test_softplus():
    x = torch.cat([torch.linspace(-87, 60, 100_003), torch.linspace(-12, 5, 100_000)])
    out = torch.empty_like(x)
    launch(_softplus, 1, x, out)
    expected = np.logaddexp(0, x.double().numpy())
    np.testing.assert_allclose(out.double().numpy(), expected, rtol=1e-6)


def test_softplus_at_the_ends():
    x = torch.tensor([float("nan"), float("inf"), -float("inf"), -1e30, 1e30, 0.0])
    for repeats in (1, 2):
        out = torch.empty(6 * repeats)
        launch(_softplus, 1, x.repeat(repeats), out)
        assert out[:1].isnan().all()
        assert out[1] == float("inf")
        assert bool((out[2:4] < 2e-38).all())
        assert bool((out[2:4] >= 0).all())
        torch.testing.assert_close(out[4:6], torch.tensor([1e30, math.log(2)]))
