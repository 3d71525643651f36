"""Sums along rays against loops in NumPy, for any packing of any rays."""

from __future__ import annotations

import copy
import pickle
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gridreg.samples import RaySamples
from gridreg.segments import optical_depth_to_weights, spread, sum_before, sum_per_ray
from tests.oracles import make_batch

counts = st.lists(st.integers(0, 7), min_size=0, max_size=8)


def packing(lengths: list[int]) -> tuple[Tensor, Tensor]:
    """Offsets and ray of each sample."""
    offsets = torch.tensor([0, *np.cumsum(lengths, dtype=int)], dtype=torch.int64)
    return offsets, torch.repeat_interleave(
        torch.arange(len(lengths)), torch.tensor(lengths, dtype=torch.int64)
    )


def random(count: int, *tail: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(count, *tail, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@given(counts, st.sampled_from([(), (1,), (3,), (2, 2)]))
def test_sum_per_ray(lengths: list[int], tail: tuple[int, ...]) -> None:
    offsets, rays = packing(lengths)
    values = random(len(rays), *tail)
    found = sum_per_ray(values, offsets, rays)
    assert found.shape == (len(lengths), *tail)
    for ray, (begin, end) in enumerate(pairwise(offsets)):
        np.testing.assert_allclose(found[ray], values[begin:end].numpy().sum(0), atol=1e-12)


@given(counts, st.sampled_from([(), (3,)]))
def test_spread(lengths: list[int], tail: tuple[int, ...]) -> None:
    offsets, rays = packing(lengths)
    values = random(len(lengths), *tail)
    np.testing.assert_array_equal(spread(values, offsets, rays), np.repeat(values.numpy(), lengths, axis=0))


@given(counts)
def test_sum_before(lengths: list[int]) -> None:
    offsets, rays = packing(lengths)
    values = random(len(rays))
    found = sum_before(values, offsets, rays).numpy()
    for begin, end in pairwise(offsets):
        ray = values[begin:end].numpy()
        np.testing.assert_allclose(found[begin:end], [ray[:i].sum() for i in range(len(ray))], atol=1e-12)


@given(counts, st.floats(0, 30))
def test_weights_add_to_the_opacity(lengths: list[int], scale: float) -> None:
    offsets, rays = packing(lengths)
    depth = random(len(rays)).abs() * scale
    weights = optical_depth_to_weights(depth, offsets)
    assert ((weights >= 0) & (weights <= 1)).all()
    opacity = 1 - torch.exp(-sum_per_ray(depth, offsets, rays))
    torch.testing.assert_close(sum_per_ray(weights, offsets, rays), opacity, atol=1e-12, rtol=0)


@given(counts)
def test_gradients_do_not_cross_rays(lengths: list[int]) -> None:
    offsets, rays = packing(lengths)
    if not lengths:
        return
    depth = random(len(rays)).abs().requires_grad_()
    weights = optical_depth_to_weights(depth, offsets)
    for chosen in {0, len(lengths) - 1}:
        (gradient,) = torch.autograd.grad(
            weights[rays == chosen].square().sum(), depth, retain_graph=True, allow_unused=True
        )
        assert (gradient[rays != chosen] == 0).all()


def test_layouts_that_are_not_contiguous() -> None:
    offsets, rays = packing([2, 0, 3])
    values = random(3, 5).T
    assert not values.is_contiguous()
    torch.testing.assert_close(
        sum_per_ray(values, offsets, rays), sum_per_ray(values.contiguous(), offsets, rays)
    )
    expanded = torch.ones(1, dtype=torch.float64).expand(5).requires_grad_()
    (gradient,) = torch.autograd.grad(sum_per_ray(expanded, offsets, rays).sum(), expanded)
    assert (gradient == 1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_dtypes(dtype: torch.dtype) -> None:
    offsets, rays = packing([4, 1, 0, 3])
    values = random(8, dtype=torch.float64).to(dtype)
    for found in (
        sum_per_ray(values, offsets, rays),
        spread(values[:4], offsets, rays),
        sum_before(values, offsets, rays),
        optical_depth_to_weights(values.abs(), offsets),
    ):
        assert found.dtype == dtype


def test_many_rays_give_the_same_bits_each_time() -> None:
    offsets, rays = packing(list(np.random.default_rng(0).integers(0, 60, 500)))
    values = random(len(rays), dtype=torch.float32).requires_grad_()
    results = []
    for _ in range(3):
        weights = optical_depth_to_weights(values.abs(), offsets)
        per_ray = sum_per_ray(weights * values, offsets, rays)
        (gradient,) = torch.autograd.grad((spread(per_ray, offsets, rays) * weights).sum(), values)
        results.append((per_ray.detach(), gradient))
    for per_ray, gradient in results[1:]:
        assert torch.equal(per_ray, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_inference_mode() -> None:
    offsets, rays = packing([2, 3])
    with torch.inference_mode():
        found = sum_per_ray(random(5), offsets, rays)
    torch.testing.assert_close(found, sum_per_ray(random(5), offsets, rays))


def test_samples_can_be_copied_and_sent_to_other_processes() -> None:
    samples = make_batch(0, 3, 5).samples(patch=(1, 1, 3))
    opacity = samples.opacity
    for twin in (copy.deepcopy(samples), pickle.loads(pickle.dumps(samples))):
        assert isinstance(twin, RaySamples)
        assert twin.patch == (1, 1, 3)
        assert torch.equal(twin.opacity, opacity)
        assert twin.t is not samples.t
