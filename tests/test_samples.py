"""RaySamples: packing, sums along rays, and errors that name what is wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

import gridreg
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


def packed(seed: int = 0, closed: float | None = None) -> dict[str, Tensor]:
    """Samples of three rays, the middle one empty, as nerfacc has them; the last interval may close its ray."""
    generator = torch.Generator().manual_seed(seed)
    rays = torch.tensor([0, 0, 0, 2, 2])
    starts = torch.tensor([0.5, 1.0, 1.5, 0.25, 0.75])
    ends = starts + 0.5
    if closed is not None:
        ends[[2, 4]] = closed
    return {
        "ray_indices": rays, "t_starts": starts, "t_ends": ends, "density": torch.rand(5, generator=generator)
    }  # fmt: skip


def weights_in_numpy(data: dict[str, Tensor]) -> NDArray[np.float64]:
    """Equation 3 of NeRF, ray by ray and sample by sample."""
    found, depth, last = [], 0.0, -1
    for ray, start, end, density in zip(*(value.double().tolist() for value in data.values()), strict=True):
        depth = depth if ray == last else 0.0
        last = ray
        found.append(math.exp(-depth) * -math.expm1(-density * (end - start)))
        depth += density * (end - start)
    return np.array(found)


class TestFromPacked:
    @pytest.mark.parametrize("closed", [None, 1e10])
    def test_weights_are_nerfs(self, closed: float | None) -> None:
        data = packed(closed=closed)
        samples = RaySamples.from_packed(**data)
        np.testing.assert_allclose(samples.weights.numpy(), weights_in_numpy(data), rtol=1e-5)
        if closed:
            assert samples.opacity.tolist() == [1.0, 0.0, 1.0]

    def test_a_sample_lies_in_the_middle_of_its_interval(self) -> None:
        samples = RaySamples.from_packed(**packed(), rays=4)
        assert samples.t.tolist() == [0.75, 1.25, 1.75, 0.5, 1.0]
        assert samples.offsets.tolist() == [0, 3, 3, 5, 5]
        assert samples.index.tolist() == [0, 1, 2, 0, 1]
        assert samples.ray_indices.tolist() == packed()["ray_indices"].tolist()

    @pytest.mark.parametrize("closed", [1e10, float("inf")])
    def test_an_interval_that_closes_a_ray_lies_at_its_start_and_has_no_length(self, closed: float) -> None:
        samples = RaySamples.from_packed(**packed(closed=closed))
        assert samples.t.tolist() == [0.75, 1.25, 1.5, 0.5, 0.75]
        assert samples.lengths.tolist() == [0.5, 0.5, 0.0, 0.5, 0.0]
        assert samples.depth.max() <= 1.5
        assert gridreg.distortion(samples).item() < 1

    def test_the_dense_form_gives_the_same(self) -> None:
        t = torch.tensor([[1.0, 2.0, 3.0]])
        dense = RaySamples.from_dense(t, torch.tensor([1.0, 1.0, 1e10]), torch.full((1, 3), 0.3))
        starts = torch.tensor([0.5, 1.5, 3.0])
        found = RaySamples.from_packed(
            torch.zeros(3), starts, torch.tensor([1.5, 2.5, 1e10]), torch.full((3,), 0.3)
        )
        for name in ("t", "weights", "depth", "lengths"):
            torch.testing.assert_close(getattr(found, name), getattr(dense, name))
        torch.testing.assert_close(gridreg.distortion(found), gridreg.distortion(dense))

    def test_rays_that_are_closed_do_not_spoil_later_ones(self) -> None:
        rays, density = 2000, torch.full((2000, 2), 50.0)
        density[:, 0] = 0.5
        samples = RaySamples.from_dense(torch.tensor([1.0, 2.0]), torch.tensor([1.0, 1e10]), density)
        expected = torch.tensor([-math.expm1(-0.5), math.exp(-0.5)]).repeat(rays)
        torch.testing.assert_close(samples.weights, expected)

    def test_columns_and_further_fields_are_taken_as_they_are(self) -> None:
        data = {name: value[:, None] for name, value in packed().items()}
        samples = RaySamples.from_packed(
            **data,
            weights=torch.full((5, 1), 0.1),
            index=torch.tensor([3, 4, 9, 0, 1]),
            ray_start=torch.zeros(3),
        )
        assert samples.weights.tolist() == pytest.approx([0.1] * 5)
        assert samples.steps.tolist() == [10, 0, 2]

    def test_no_samples(self) -> None:
        empty = {name: value[:0] for name, value in packed().items()}
        assert RaySamples.from_packed(**empty).rays == 0
        assert RaySamples.from_packed(**empty, rays=3).counts.tolist() == [0, 0, 0]

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"ray_indices": torch.tensor([0, 2, 2, 1, 1])}, "must never decrease; sort"),
            ({"rays": 2}, "rays=2: found samples of ray 2"),
            ({"density": torch.ones(4)}, r"one value of each for every sample, found .*density \(4,\)"),
            ({"index": torch.zeros(3)}, "index must have shape"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, changes: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            RaySamples.from_packed(**{**packed(), **changes})


def test_proposals_have_the_same_rays() -> None:
    samples = RaySamples.from_packed(**packed())
    assert samples.replace(proposals=(samples,)).proposals == (samples,)
    with pytest.raises(InputError, match="proposals must have samples on the same 3 rays"):
        samples.replace(proposals=(RaySamples.from_packed(**packed(), rays=4),))
