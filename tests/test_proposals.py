"""The proposal loss against the formula of mip-NeRF 360, interval by interval."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from gridreg.regularizers.proposals import proposal_loss
from tests import oracles

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(0, 5), st.integers(1, 9), st.sampled_from([0.4, 1.0]))
def test_it_is_equation_13(seed: int, count: int, width: int, kept: float) -> None:
    fine = oracles.make_batch(seed, count, 7, kept)
    coarse = oracles.make_batch(seed + 1, count, width, kept)
    found = proposal_loss(fine.samples().replace(proposals=(coarse.samples(),)))
    np.testing.assert_allclose(found.item(), oracles.proposal_loss(fine, coarse), rtol=1e-6, atol=1e-9)


def test_it_adds_over_proposals() -> None:
    fine, *coarse = (oracles.make_batch(seed, 4, 6).samples() for seed in range(3))
    parts = [proposal_loss(fine.replace(proposals=(proposal,))) for proposal in coarse]
    torch.testing.assert_close(proposal_loss(fine.replace(proposals=tuple(coarse))), sum(parts))


@given(seeds)
def test_a_proposal_that_covers_the_samples_costs_nothing(seed: int) -> None:
    fine = oracles.make_batch(seed, 5, 6, kept=1.0).samples()
    assert proposal_loss(fine.replace(proposals=(fine,))).item() == pytest.approx(0, abs=1e-12)
    wide = gridreg.RaySamples.from_packed(
        torch.arange(5), torch.zeros(5), torch.full((5,), 99.0), torch.ones(5), weights=torch.ones(5)
    )
    assert proposal_loss(fine.replace(proposals=(wide,))).item() == 0


def test_the_final_samples_get_no_gradient() -> None:
    fine = oracles.make_batch(0, 4, 6).samples(grad=True)
    density = torch.rand(4, 3, requires_grad=True)
    coarse = gridreg.RaySamples.from_dense(torch.tensor([2.1, 2.5, 3.0]), torch.full((3,), 0.4), density)
    loss = proposal_loss(fine.replace(proposals=(coarse,)))
    of_coarse, of_fine = torch.autograd.grad(loss, (density, fine.density), allow_unused=True)
    assert of_fine is None
    assert of_coarse is not None
    assert (of_coarse != 0).any()


def test_without_proposals_it_is_refused() -> None:
    with pytest.raises(gridreg.InputError, match="needs samples with proposals, found None"):
        proposal_loss(oracles.make_batch(0, 2, 3).samples())
