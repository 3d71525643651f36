"""The fused optimizer against `torch.optim.Adam` on autograd's gradients of the same penalties."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.base import LocalTerm
from gridreg.ops import use_backend
from gridreg.ops.cpu.adam import step as adam
from gridreg.ops.cpu.adam.layout import Layout, layout
from gridreg.ops.fused_adam import FusedAdam

BETAS = (0.9, 0.99)


def penalty(kind: str, p: torch.Tensor, spatial: tuple[int, ...]) -> torch.Tensor:
    """The form that a term names, as autograd sees it."""
    if kind == "l1":
        return p.abs().mean()
    if kind == "l2":
        return p.square().mean()
    pairs = (
        p.narrow(a, 1, p.shape[a] - 1) - p.narrow(a, 0, p.shape[a] - 1) for a in spatial if p.shape[a] > 1
    )
    return sum((pair.square().mean() for pair in pairs), 0 * p.sum())


def part_sizes(kind: str, p: torch.Tensor, spatial: tuple[int, ...]) -> torch.Tensor:
    """How large the numbers are whose sum is the gradient of a penalty, for each element."""
    if kind == "total_variation":
        pairs = (p.numel() / p.shape[a] * (p.shape[a] - 1) for a in spatial if p.shape[a] > 1)
        return sum((8 * p.detach().abs().max() / n for n in pairs), torch.zeros(()))
    return (p.sign() if kind == "l1" else 2 * p).detach().abs() / p.numel()


def grid(shape: tuple[int, ...], seed: int, dtype: torch.dtype = torch.float32) -> torch.nn.Parameter:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    values[values.abs() < 0.2] = 0.0
    return torch.nn.Parameter(values.to(dtype))


def gradient(p: torch.Tensor, step: int) -> torch.Tensor:
    """Sparse, as only rows near samples get one."""
    g = torch.Generator().manual_seed(1000 + step)
    dense = torch.randn(p.shape, generator=g)
    return torch.where(
        torch.rand(p.shape[0], generator=g).view(-1, *[1] * (p.dim() - 1)) < 0.5, dense, 0.0
    ).to(p)


def compare(
    p: torch.nn.Parameter,
    kinds,
    *,
    steps: int = 4,
    decay: float = 0.0,
    decoupled: bool = True,
    lr: float = 0.02,
):
    """Run both for some steps, the reference in float64; returns the fused optimizer.

    Adam divides a gradient by its own size, so where a sum nearly cancels its rounding shows: compared
    loosely there.
    """
    clear = torch.ones_like(p, dtype=torch.bool)
    q = torch.nn.Parameter(p.detach().double().clone())
    fused = FusedAdam([p], lr=lr, betas=BETAS, weight_decay=decay, decoupled_weight_decay=decoupled)
    reference = (torch.optim.AdamW if decoupled else torch.optim.Adam)(
        [q], lr=lr, betas=BETAS, weight_decay=decay
    )
    for step in range(steps):
        terms = [
            LocalTerm(kind, scale, p, spatial, f"{i} {kind}")
            for i, (kind, scale, spatial) in enumerate(kinds)
        ]
        forms = [scale * penalty(kind, q, spatial) for kind, scale, spatial in kinds]
        parts = gradient(q, step).abs() + sum(
            scale * part_sizes(kind, q, axes) for kind, scale, axes in kinds
        )
        reference.zero_grad(set_to_none=False)
        if forms:
            torch.stack(forms).sum().backward()
        q.grad = gradient(q, step) + (torch.zeros_like(q) if q.grad is None else q.grad)
        p.grad = gradient(p, step) if p.grad is None else p.grad.add_(gradient(p, step))
        values = fused.step(local_terms=terms)
        reference.step()
        clear &= (q.grad == 0) | (q.grad.abs() > 3e-3 * parts)
        assert list(values.values()) == pytest.approx([form.item() for form in forms], rel=1e-5, abs=1e-9)
        assert torch.count_nonzero(p.grad) == 0
        found, expected = p.detach(), q.detach().to(p.dtype)
        torch.testing.assert_close(found[clear], expected[clear], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found, expected, rtol=0, atol=0.02 * lr)
    assert clear.float().mean() > 0.6 or p.numel() < 100
    return fused


terms_lists = st.lists(
    st.tuples(
        st.sampled_from(["total_variation", "l1", "l2"]),
        st.sampled_from([1e-3, 1.0, 30.0]),
        st.sampled_from([(0, 1)]),
    ),
    max_size=4,
)


class TestAgainstTorch:
    @settings(max_examples=30, deadline=None)
    @given(
        shape=st.tuples(st.integers(2, 60), st.integers(2, 9), st.sampled_from([1, 2, 3, 8, 11, 16, 48])),
        kinds=terms_lists,
        seed=st.integers(0, 2**31),
    )
    def test_planes(self, shape, kinds, seed):
        compare(grid(shape, seed), kinds)

    @settings(max_examples=40, deadline=None)
    @given(
        case=st.sampled_from(
            [
                ((30, 16), (0,)),
                ((2, 5), (0,)),
                ((1, 5), (0,)),
                ((700,), (0,)),
                ((1, 3, 9, 14), (2, 3)),
                ((2, 3, 9, 14), (-1, -2)),
                ((1, 2, 5, 6, 7), (2, 3, 4)),
                ((5, 6, 7, 4), (0, 1, 2)),
                ((3, 1, 2, 9), (0, 1, 2)),
                ((1, 1, 1), (0, 1, 2)),
                ((4, 5, 6), (0, 2)),
                ((3, 4, 2, 3, 2), (0, 1, 2, 3)),
            ]
        ),
        seed=st.integers(0, 2**31),
        both=st.booleans(),
    )
    def test_any_axes(self, case, seed, both):
        shape, spatial = case
        compare(
            grid(shape, seed), [("total_variation", 3.0, spatial), *([("l1", 0.1, spatial)] if both else [])]
        )

    @pytest.mark.parametrize("decoupled", [True, False])
    def test_all_together_over_many_steps(self, decoupled):
        kinds = [("total_variation", 0.1, (0, 1)), ("l1", 8e-3, (0, 1)), ("l2", 0.02, (0, 1))]
        compare(grid((25, 9, 16), 0), kinds, steps=25, decay=0.1, decoupled=decoupled, lr=0.01)

    def test_two_sets_of_axes_on_one_grid(self):
        compare(
            grid((6, 7, 8), 0),
            [("total_variation", 1.0, (0,)), ("total_variation", 2.0, (0, 1)), ("l1", 1.0, ())],
        )

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_plain_path(self, dtype):
        kinds = [("total_variation", 0.1, (0, 1)), ("l1", 8e-3, (0, 1)), ("l2", 0.02, (0, 1))]
        with use_backend("torch"):
            compare(grid((9, 1, 4), 0, dtype), kinds, steps=6, decay=0.1)
            compare(grid((9, 7, 4), 0, dtype), kinds, steps=6, decay=0.1, decoupled=False)

    def test_strided_parameter(self):
        p, q = (
            grid((4, 6, 5), 0),
            torch.nn.Parameter(grid((4, 6, 5), 0).detach().permute(2, 0, 1).contiguous().permute(1, 2, 0)),
        )
        assert not q.is_contiguous()
        for x in (p, q):
            FusedAdam([x], lr=0.1).step(local_terms=[LocalTerm("total_variation", 1.0, x, (1, 2))])
        torch.testing.assert_close(p, q, rtol=1e-6, atol=1e-6)

    def test_larger_than_a_task(self):
        compare(grid((5, 14001), 0), [("l1", 0.1, ())], steps=2)
        compare(grid((70, 3, 700), 0), [("total_variation", 0.1, (0, 1))], steps=2)


class TestExactness:
    def run(self, threads: int):
        p = grid((60, 30, 16), 3)
        optimizer = FusedAdam([p], lr=0.02, betas=BETAS)
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(threads)
            for step in range(3):
                p.grad = gradient(p, step)
                values = optimizer.step(
                    local_terms=[
                        LocalTerm("total_variation", 1.0, p, (0, 1), "tv"),
                        LocalTerm("l1", 1.0, p, (), "l1"),
                    ]
                )
        finally:
            torch.set_num_threads(before)
        return p.detach(), values

    def test_thread_count_does_not_matter(self):
        (p, values), (q, others) = self.run(1), self.run(2)
        assert torch.equal(p, q)
        assert values == others

    def test_untouched_parts_stay_bit_for_bit(self):
        p = grid((4000, 16), 1)
        before = p.detach().clone()
        p.grad = torch.zeros_like(p)
        p.grad[2000:2010] = 1.0
        optimizer = FusedAdam([p], lr=0.1)
        for _ in range(3):
            optimizer.step()
        moved = (p.detach() != before).any(1)
        assert moved[2000:2010].all()
        assert moved.sum() == 10

    @pytest.mark.parametrize("bad", [math.nan, math.inf])
    def test_bad_gradients_show(self, bad):
        for terms in (False, True):
            p = grid((40, 3, 16), 1)
            p.grad = torch.zeros_like(p)
            p.grad[20, 1, 3] = bad
            term = [LocalTerm("total_variation", 1.0, p, (0, 1), "tv")] if terms else []
            FusedAdam([p], lr=0.1).step(local_terms=term)
            assert not torch.isfinite(p.detach()[20, 1, 3])
            assert torch.isfinite(p.detach()).sum() == p.numel() - 1
            assert torch.count_nonzero(p.grad) == 0


def test_which_tensors_take_the_kernel(monkeypatch):
    calls = []

    def record(plans):
        calls.extend(plan.step.p.dtype for plan in plans)
        update_flat(plans)

    update_flat = adam.update_flat
    monkeypatch.setattr(adam, "update_flat", record)
    strided = torch.nn.Parameter(torch.zeros(3, 2).T)
    for p in (grid((2, 3), 0), grid((2, 3), 0, torch.float64), strided):
        p.grad = torch.ones_like(p)
        FusedAdam([p], lr=0.1).step()
        with use_backend("torch"):
            FusedAdam([p], lr=0.1).step()
    assert calls == [torch.float32]


def test_layout():
    assert layout((7, 5), (0,)) == Layout(1, 7, 1, 5)
    assert layout((2, 3, 9, 14), (2, 3)) == Layout(6, 9, 14, 1)
    assert layout((2, 3, 9, 14), (3, -2)) == Layout(6, 9, 14, 1)
    assert layout((4, 5, 6, 3), (2, 0, 1)) is None
    assert layout((4, 5, 6, 3), (0, 2)) is None
    assert layout((4, 5, 6, 3, 1), (0, 1, 2, 3)) is None
    assert layout((4, 5), ()) == Layout(1, 1, 1, 20)


def test_blocks_do_not_matter(monkeypatch):
    """Old values pass correctly between blocks that are updated at the same time."""
    results = []
    for blocks in (1, 2, 7, 60):
        monkeypatch.setattr(adam, "_BLOCKS", blocks)
        results.append(TestExactness().run(2)[0])
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_together_as_one_by_one():
    """Parameters of one step do not see each other, with and without neighbours, also beside one that has no blocks."""
    shapes = {(40, 9, 16): (0, 1), (5, 6, 7, 4): (0, 1, 2), (1, 30, 3): (1,), (70, 8): (), (2, 3): (0,)}
    together = [grid(shape, seed) for seed, shape in enumerate(shapes)]
    apart = [torch.nn.Parameter(p.detach().clone()) for p in together]
    joint, alone = FusedAdam(together, lr=0.1), [FusedAdam([p], lr=0.1) for p in apart]
    for step in range(3):
        terms, values = [], {}
        for p, q, optimizer, axes in zip(together, apart, alone, shapes.values(), strict=True):
            kind, name = ("total_variation" if axes else "l1"), str(p.shape)
            p.grad, q.grad = gradient(p, step), gradient(q, step)
            terms.append(LocalTerm(kind, 2.0, p, axes, name))
            values |= optimizer.step(local_terms=[LocalTerm(kind, 2.0, q, axes, name)])
        assert joint.step(local_terms=terms) == values
        assert all(torch.equal(p, q) for p, q in zip(together, apart, strict=True))
