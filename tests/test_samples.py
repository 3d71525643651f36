"""RaySamples: packing, sums along rays, and errors that name what is wrong."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from gridreg.errors import InputError
from gridreg.samples import RaySamples
from gridreg.segments import optical_depth_to_weights, spread, sum_before, sum_per_ray
from tests.oracles import Batch, batches, make_batch


def ray_of(offsets: Tensor) -> Tensor:
    return torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff())


@given(batches)
def test_weights_follow_the_rendering_equation(batch: Batch) -> None:
    samples = batch.samples()
    dense = samples.to_dense(samples.weights, batch.t.shape[1]).numpy()
    np.testing.assert_allclose(dense, batch.weights, rtol=1e-9, atol=1e-12)


@given(batches)
def test_packing_keeps_every_valid_sample_in_its_place(batch: Batch) -> None:
    samples = batch.samples()
    assert len(samples) == batch.valid.sum()
    assert samples.rays == batch.t.shape[0]
    np.testing.assert_array_equal(samples.t, batch.t[batch.valid])
    np.testing.assert_array_equal(samples.colours, batch.colours[batch.valid])
    np.testing.assert_array_equal(samples.ray_indices, np.nonzero(batch.valid)[0])
    np.testing.assert_array_equal(samples.index, np.nonzero(batch.valid)[1])
    np.testing.assert_array_equal(samples.counts, batch.valid.sum(1))
    ones = samples.to_dense(torch.ones(len(samples)), batch.t.shape[1])
    np.testing.assert_array_equal(ones.numpy(), batch.valid)


@given(batches)
def test_opacity_and_depth_are_sums_along_the_ray(batch: Batch) -> None:
    samples = batch.samples()
    np.testing.assert_allclose(samples.opacity, batch.weights.sum(1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(samples.depth, (batch.weights * batch.t).sum(1), rtol=1e-9, atol=1e-12)


@given(batches, st.integers(0, 3))
def test_sum_and_spread_are_transposes(batch: Batch, extra: int) -> None:
    samples = batch.samples()
    generator = torch.Generator().manual_seed(1)
    tail = (extra,) if extra else ()
    values = torch.rand(len(samples), *tail, dtype=torch.float64, generator=generator)
    per_ray = torch.rand(samples.rays, *tail, dtype=torch.float64, generator=generator)
    left, right = (samples.sum_per_ray(values) * per_ray).sum(), (values * samples.spread(per_ray)).sum()
    torch.testing.assert_close(left, right)


@pytest.mark.parametrize("offsets", [[0, 5], [0, 0, 3, 3, 5, 5], [0, 1, 2, 5], [0, 0]])
def test_sums_pass_gradcheck_with_empty_rays(offsets: list[int]) -> None:
    where = torch.tensor(offsets)
    rays = ray_of(where)
    values = torch.rand(offsets[-1], dtype=torch.float64, requires_grad=True)
    per_ray = torch.rand(len(offsets) - 1, dtype=torch.float64, requires_grad=True)
    for function, argument in ((sum_per_ray, values), (sum_before, values), (spread, per_ray)):
        assert gradcheck(lambda x, f=function: f(x**2, where, rays), (argument,))
        assert gradgradcheck(lambda x, f=function: f(x**3, where, rays), (argument,))
    assert gradcheck(lambda x: optical_depth_to_weights(x, where), (values,))


def test_sum_before_matches_a_loop() -> None:
    values = torch.arange(1.0, 6.0)
    offsets = torch.tensor([0, 2, 2, 5])
    assert sum_before(values, offsets, ray_of(offsets)).tolist() == [0, 1, 0, 3, 7]


def test_sum_before_keeps_its_digits_after_many_opaque_rays() -> None:
    # A float32 running sum over all rays would have forgotten the last ray's small numbers.
    offsets = torch.tensor([0, 1000, 1003])
    values = torch.cat([torch.full((1000,), 1e6), torch.tensor([1e-3, 2e-3, 3e-3])])
    before = sum_before(values, offsets, ray_of(offsets))[-3:]
    torch.testing.assert_close(before, torch.tensor([0.0, 1e-3, 3e-3]), rtol=1e-4, atol=0)


def test_sums_keep_dtype_and_are_the_same_every_time() -> None:
    offsets = torch.tensor([0, 400, 400, 1000])
    values = torch.rand(1000, 3, requires_grad=True)
    results = [sum_per_ray(values, offsets, ray_of(offsets)) for _ in range(3)]
    assert results[0].dtype == torch.float32
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])
    assert sum_before(values[:, 0].detach(), offsets, ray_of(offsets)).dtype == torch.float32


def test_one_row_of_distances_serves_all_rays() -> None:
    t, delta = torch.linspace(2, 3, 5), torch.full((5,), 0.25)
    samples = RaySamples.from_dense(t, delta, torch.ones(3, 5))
    assert samples.t.tolist() == t.tolist() * 3
    assert samples.start.tolist() == [2.0] * 3
    assert samples.steps.tolist() == [5] * 3


def test_start_and_steps_are_inferred_when_not_given() -> None:
    batch = make_batch(0, 4, 8, kept=1.0)
    batch.t, batch.delta = np.tile(2 + 0.1 * np.arange(8), (4, 1)), np.full((4, 8), 0.1)
    batch.valid[0] = False
    batch.valid[1, :3] = False
    batch.valid[2, 5:] = False
    samples = batch.samples().replace(ray_start=None, ray_steps=None)
    np.testing.assert_allclose(samples.start, [0, 2, 2, 2])
    assert samples.steps.tolist() == [0, 8, 5, 8]


def test_no_samples_and_no_rays() -> None:
    for rays in (0, 3):
        empty = RaySamples(
            offsets=torch.zeros(rays + 1, dtype=torch.int64),
            index=torch.zeros(0, dtype=torch.int64),
            **{name: torch.zeros(0) for name in ("t", "delta", "density", "weights")},
        )
        assert empty.opacity.tolist() == empty.depth.tolist() == empty.start.tolist() == [0] * rays
        assert empty.steps.tolist() == [0] * rays
        assert empty.to_dense(empty.t).shape == (rays, 0)


def test_replace_changes_only_what_it_is_told() -> None:
    samples = make_batch(1, 2, 3, kept=1.0).samples()
    other = samples.replace(density=samples.density * 2)
    assert other.t is samples.t
    assert torch.equal(other.density, samples.density * 2)
    assert len(samples.opacity) == 2


def fields_of(count: int, rays: int) -> dict[str, Tensor]:
    return {
        "offsets": torch.linspace(0, count, rays + 1).long(),
        "index": torch.zeros(count, dtype=torch.int64),
        **{name: torch.rand(count) for name in ("t", "delta", "density", "weights")},
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"density": torch.rand(5)}, r"density must have shape \(4,\).*found \(5,\)"),
        ({"t": torch.rand(4, 1)}, r"t must have shape"),
        ({"t": torch.tensor(1.0)}, r"t must have shape"),
        ({"colours": torch.rand(4, 4)}, r"colours must have shape \(4, 3\)"),
        ({"background": torch.rand(4, 3)}, r"background must have shape \(2, 3\)"),
        ({"ray_steps": torch.ones(2)}, r"ray_steps must be int64, found torch.float32"),
        ({"index": torch.zeros(4)}, r"index must be int64"),
        ({"delta": torch.ones(4, dtype=torch.int32)}, r"delta must be a floating-point type"),
        ({"weights": torch.ones(4, device="meta")}, r"weights is on meta"),
        ({"offsets": torch.tensor([0, 5, 4])}, r"offsets must rise from 0 to the 4 samples"),
        ({"offsets": torch.tensor([0, 2, 3])}, r"offsets must rise from 0 to the 4 samples, found 0 to 3"),
        ({"offsets": torch.zeros(0, dtype=torch.int64)}, r"offsets must have shape \(rays \+ 1,\)"),
        ({"patch": (1, 2, 2)}, r"patch \(1, 2, 2\) needs 4 rays"),
        ({"patch": (1, 0, 2)}, r"patch \(1, 0, 2\)"),
    ],
)
def test_errors_name_the_tensor(change: dict[str, Tensor], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        RaySamples(**{**fields_of(4, 2), **change})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"density": torch.rand(4)}, r"density must have shape \(rays, samples\)"),
        ({"valid": torch.ones(2, 3)}, r"valid must be bool of shape \(2, 3\)"),
        ({"valid": torch.ones(3, 2, dtype=torch.bool)}, r"valid must be bool"),
        ({"t": torch.rand(2, 4)}, r"t and delta must have shape \(2, 3\)"),
        ({"weights": torch.rand(3, 2)}, r"weights must have shape \(2, 3\)"),
        ({"positions": torch.rand(2, 3)}, r"positions must have shape \(2, 3, 3\)"),
    ],
)
def test_errors_of_dense_samples(change: dict[str, Tensor], message: str) -> None:
    dense = {"t": torch.rand(2, 3), "delta": torch.rand(2, 3), "density": torch.rand(2, 3)}
    with pytest.raises(InputError, match=message):
        RaySamples.from_dense(**{**dense, **change})


def test_dense_width_too_small() -> None:
    samples = make_batch(2, 2, 4, kept=1.0).samples()
    with pytest.raises(InputError, match="width 2 is too small: the largest sample index is 3"):
        samples.to_dense(samples.t, 2)
