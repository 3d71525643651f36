"""Laws that every penalty on samples keeps, whatever its formula: registered ones included without a line of test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import gridreg
from gridreg.base import REGISTRY, Clock, Context, Regularizer
from gridreg.samples import RaySamples
from tests.oracles import Batch, make_batch

RAYS, STEPS = 12, 10
PATCH = (2, 2, 2)


def penalties() -> list[Regularizer]:
    """All examples of all registered penalties on samples."""
    return [
        example
        for cls in REGISTRY.values()
        if gridreg.overrides(cls, "penalty")
        for example in cls.examples("density")
    ]


def context(step: int = 0) -> Context:
    clock = Clock(100, seed=0)
    clock.step = step
    return Context(clock)


def packed(batch: Batch, dtype: torch.dtype = torch.float64, **more: Any) -> RaySamples:
    """The batch as samples with all that a renderer can fill in."""
    tensors = {name: torch.tensor(getattr(batch, name), dtype=dtype) for name in ("t", "delta", "density")}
    colours = torch.tensor(batch.colours, dtype=dtype)
    return RaySamples.from_dense(
        **tensors,
        colours=colours,
        positions=colours,
        valid=torch.tensor(batch.valid),
        patch=PATCH,
        **{**filled_in(tensors["density"]), **more},
    )


def filled_in(density: Tensor, fog: float = 1.0) -> dict[str, Any]:
    """What else a renderer can fill in; the gradients and the proposal go with the density."""
    dtype, generator = density.dtype, torch.Generator().manual_seed(11)
    axes = torch.randn(*density.shape, 3, generator=generator, dtype=torch.float64).to(dtype)
    thin = RaySamples.from_dense(
        torch.linspace(2.0, 3.0, STEPS, dtype=dtype), density.new_full((STEPS,), 0.1), density
    )
    return {
        "target_opacity": opacities(dtype),
        "target_depth": torch.randn(RAYS, generator=generator, dtype=torch.float64).to(dtype),
        "images": torch.arange(RAYS) // 4,
        "gradients": torch.nn.functional.normalize(axes, dim=-1) * (fog + density[..., None]),
        "proposals": (thin,),
    }


def opacities(dtype: torch.dtype = torch.float64) -> Tensor:
    """Of the pixels that the rays are compared with; one is not known."""
    return torch.linspace(0, 1, RAYS, dtype=dtype).index_fill(0, torch.tensor(5), float("nan"))


def reorder(samples: RaySamples, order: Tensor) -> RaySamples:
    """The same rays in another order."""
    pieces = [torch.arange(int(samples.offsets[r]), int(samples.offsets[r + 1])) for r in order.tolist()]
    index = torch.cat(pieces)
    changes: dict[str, Any] = {
        name: getattr(samples, name)[index]
        for name in ("t", "delta", "index", "density", "weights", "colours", "positions", "gradients")
        if getattr(samples, name) is not None
    }
    changes["offsets"] = torch.tensor([0, *np.cumsum([len(piece) for piece in pieces])])
    for name in ("ray_start", "ray_steps", "target_opacity", "target_depth", "images"):
        if getattr(samples, name) is not None:
            changes[name] = getattr(samples, name)[order]
    if samples.proposals is not None:
        changes["proposals"] = tuple(reorder(proposal, order) for proposal in samples.proposals)
    return samples.replace(**changes)


each = pytest.mark.parametrize("penalty", penalties(), ids=repr)
seeds = st.integers(0, 10_000)


def test_all_of_the_catalogue_take_part() -> None:
    names = {type(penalty).__name__ for penalty in penalties()}
    assert names >= {"OcclusionLoss", "CauchySparsity", "OpacityEntropy", "RayEntropy", "DistortionLoss"}
    assert names >= {"DepthSmoothness", "RayKL"}


@each
@given(seeds, st.sampled_from([0.3, 0.7, 1.0]))
def test_skipped_steps_count_as_empty_ones(penalty: Regularizer, seed: int, kept: float) -> None:
    batch = make_batch(seed, RAYS, STEPS, kept)
    filled = replace(batch, density=np.where(batch.valid, batch.density, 0), valid=np.ones_like(batch.valid))
    filled.colours = np.where(batch.valid[..., None], batch.colours, 0.0)
    if isinstance(penalty, gridreg.Eikonal):
        return  # A mean over the points at which the distance was asked for, wherever they are.
    # What is known of rays does not depend on what is skipped.
    more = filled_in(torch.tensor(filled.density))
    skipped = penalty.penalty(packed(batch, **more), context())
    torch.testing.assert_close(
        skipped, penalty.penalty(packed(filled, **more), context()), rtol=1e-9, atol=1e-12
    )


@each
@given(seeds)
def test_it_is_a_finite_scalar_not_below_zero(penalty: Regularizer, seed: int) -> None:
    for scale in (1e-3, 1.0, 1e3):
        value = penalty.penalty(packed(make_batch(seed, RAYS, STEPS, scale=scale)), context())
        assert value.shape == ()
        assert torch.isfinite(value)
        assert value >= -1e-9


@each
def test_float32_is_close_to_float64(penalty: Regularizer) -> None:
    batch = make_batch(3, RAYS, STEPS)
    wide = penalty.penalty(packed(batch), context())
    narrow = penalty.penalty(packed(batch, torch.float32), context())
    assert wide.dtype == torch.float64
    assert narrow.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), wide, rtol=2e-4, atol=1e-6)


@each
@given(seeds)
def test_the_order_of_rays_does_not_matter(penalty: Regularizer, seed: int) -> None:
    samples = packed(make_batch(seed, RAYS, STEPS))
    patches = RAYS - PATCH[0] * PATCH[1] * PATCH[2]
    generator = torch.Generator().manual_seed(seed)
    # Rays of patches have an order of their own.
    order = torch.cat([torch.randperm(patches, generator=generator), torch.arange(patches, RAYS)])
    torch.testing.assert_close(
        penalty.penalty(reorder(samples, order), context()), penalty.penalty(samples, context())
    )


@each
def test_empty_space_costs_nothing(penalty: Regularizer) -> None:
    batch = make_batch(4, RAYS, STEPS, kept=1.0)
    batch.density[:] = 0.0
    # Nothing is known of the depth of rays that meet nothing.
    unknown = torch.full((RAYS,), float("nan"), dtype=torch.float64)
    samples = packed(batch, target_opacity=torch.zeros(RAYS, dtype=torch.float64), target_depth=unknown)
    assert penalty.penalty(samples, context()).item() == pytest.approx(0.0, abs=2e-5)


@each
def test_descent_lowers_it(penalty: Regularizer) -> None:
    # A single wall across all rays is where some penalties are at their least: start from fog.
    batch = make_batch(5, RAYS, STEPS, kept=1.0, scale=0.5)
    t, delta, colours = (torch.tensor(x) for x in (batch.t, batch.delta, batch.colours))
    raw = torch.tensor(np.log(batch.density + 0.1), requires_grad=True)
    values = []
    for _ in range(30):
        density = raw.exp()
        more = filled_in(density)
        if "proposals" in penalty.needs():
            density = density.detach().flip(1)
        samples = RaySamples.from_dense(
            t, delta, density, colours=colours, positions=colours, patch=PATCH, **more
        )
        value = penalty.penalty(samples, context())
        values.append(value.item())
        (gradient,) = torch.autograd.grad(value, raw)
        assert torch.isfinite(gradient).all()
        with torch.no_grad():
            raw -= 0.02 * gradient / gradient.abs().max().clamp(min=1e-12)
    assert values[-1] < values[0]


@each
def test_inputs_are_left_alone(penalty: Regularizer) -> None:
    samples = packed(make_batch(6, RAYS, STEPS))
    names = ("offsets", "t", "delta", "index", "density", "weights", "colours", "ray_start", "ray_steps")
    before = {name: getattr(samples, name).clone() for name in names}
    penalty.penalty(samples, context())
    assert all(torch.equal(before[name], getattr(samples, name)) for name in names)


@each
def test_the_same_samples_give_the_same_bits(penalty: Regularizer) -> None:
    samples = packed(make_batch(7, RAYS, STEPS), torch.float32)
    values = {penalty.penalty(samples, context()).item() for _ in range(3)}
    assert len(values) == 1


@each
def test_plain_data_and_back_with_a_schedule(penalty: Regularizer) -> None:
    scheduled = replace(penalty, weight=gridreg.Linear(0.0, 0.5, until=0.25))  # type: ignore[call-arg]
    for regularizer in (penalty, scheduled):
        text = yaml.safe_dump(gridreg.to_config([regularizer]))
        assert gridreg.from_config(yaml.safe_load(text)) == [regularizer]


@each
def test_the_handle_weighs_it_by_the_schedule(penalty: Regularizer) -> None:
    scheduled = replace(penalty, weight=gridreg.Linear(0.0, 0.5, until=10))  # type: ignore[call-arg]
    samples = packed(make_batch(8, RAYS, STEPS))
    with gridreg.apply(torch.nn.Linear(1, 1).double(), scheduled, total_steps=20) as handle:
        assert handle.loss(samples).item() == 0.0
        handle.step(5)
        expected = 0.25 * penalty.penalty(samples, context(5))
        torch.testing.assert_close(handle.loss(samples), expected)
        assert list(handle.terms) == [type(penalty).__name__]
        assert handle.values() == {type(penalty).__name__: 0.25}


@each
def test_what_it_needs_is_asked_for_by_name(penalty: Regularizer) -> None:
    samples = packed(make_batch(9, RAYS, STEPS))
    with gridreg.apply(torch.nn.Linear(1, 1), penalty, total_steps=20) as handle:
        with pytest.raises(gridreg.InputError, match=r"needs samples; call handle\.loss\(samples\)"):
            handle.loss()
        for attribute in penalty.needs():
            with pytest.raises(gridreg.InputError, match=rf"needs samples\.{attribute}, found None"):
                handle.loss(samples.replace(**{attribute: None}))
