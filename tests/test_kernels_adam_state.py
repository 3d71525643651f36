"""What the fused optimizer keeps between steps, and what it refuses."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from gridreg.base import LocalTerm
from gridreg.errors import InputError
from gridreg.ops.fused_adam import FusedAdam

BETAS = (0.9, 0.99)


def grid(shape: tuple[int, ...], seed: int) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.randn(shape, generator=torch.Generator().manual_seed(seed)))


def gradient(p: torch.Tensor, step: int) -> torch.Tensor:
    return torch.randn(p.shape, generator=torch.Generator().manual_seed(1000 + step))


class TestState:
    def test_resume_is_bit_exact(self):
        def advance(p, optimizer, first, last):
            for step in range(first, last):
                if step % 3:
                    p.grad = gradient(p, step) if p.grad is None else p.grad.add_(gradient(p, step))
                optimizer.step()

        p = grid((20, 6, 8), 5)
        optimizer = FusedAdam([{"params": [p], "name": "grid"}], lr=0.02, betas=BETAS)
        advance(p, optimizer, 1, 6)
        q = torch.nn.Parameter(p.detach().clone())
        resumed = FusedAdam([{"params": [q], "name": "grid"}], lr=0.5)
        resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
        advance(p, optimizer, 6, 11)
        advance(q, resumed, 6, 11)
        assert torch.equal(p, q)
        assert resumed.param_groups[0]["lr"] == 0.02

    def test_state_has_the_names_of_torch(self):
        p = grid((20, 6, 8), 5)
        p.grad = gradient(p, 0)
        q = torch.nn.Parameter(p.detach().clone())
        q.grad = p.grad.clone()
        fused, plain = FusedAdam([p], lr=0.02, betas=BETAS), torch.optim.Adam([q], lr=0.02, betas=BETAS)
        fused.step()
        plain.step()
        own, other = fused.state_dict()["state"][0], plain.state_dict()["state"][0]
        assert list(own) == list(other)
        for key in own:
            torch.testing.assert_close(own[key], other[key])

    def test_without_a_gradient(self):
        p, q = grid((5, 4), 0), grid((5, 4), 1)
        before = p.detach().clone()
        optimizer = FusedAdam([p, q], lr=0.1)
        assert optimizer.step() == {}
        assert torch.equal(p, before)
        assert not optimizer.state
        optimizer.step(local_terms=[LocalTerm("l1", 1.0, p, ())])
        assert not torch.equal(p, before)
        assert q not in optimizer.state

    def test_gradient_buffers_stay(self):
        p = grid((5, 4), 0)
        p.grad = gradient(p, 0)
        address = p.grad.data_ptr()
        optimizer = FusedAdam([p], lr=0.1)
        optimizer.step()
        (p * 2).sum().backward()
        assert p.grad.data_ptr() == address
        assert torch.equal(p.grad, torch.full_like(p, 2.0))

    def test_empty_parameter(self):
        p = torch.nn.Parameter(torch.zeros(0, 4))
        p.grad = torch.zeros_like(p)
        FusedAdam([p], lr=0.1).step()
        assert p.numel() == 0


def test_bad_arguments():
    p, q = grid((5, 4), 0), grid((5, 4), 1)
    before = p.detach().clone()
    for name, value in (("lr", -1.0), ("eps", math.nan), ("weight_decay", -0.1), ("betas", (0.9, 1.0))):
        with pytest.raises(InputError, match=name):
            FusedAdam([p], **{name: value})
    optimizer = FusedAdam([p])
    with pytest.raises(InputError, match="expected one of total_variation, l1, l2"):
        optimizer.step(local_terms=[LocalTerm("huber", 1.0, p, (), "h")])
    with pytest.raises(InputError, match=r"h: found a parameter \(5, 4\)"):
        optimizer.step(local_terms=[LocalTerm("l1", 1.0, p, ()), LocalTerm("l1", 1.0, q, (), "h")])
    with pytest.raises(InputError, match="closure"):
        optimizer.step(lambda: 0.0)
    assert torch.equal(p, before)
