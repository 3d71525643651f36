"""Component dropout and detached masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import gridreg


class Lines(nn.Module):
    """Two lists of components, summed."""

    def __init__(self) -> None:
        super().__init__()
        self.line = nn.Parameter(torch.ones(1, 400, 3, 1))

    def forward(self) -> Tensor:
        return self.line.sum((0, 2, 3))


def test_dropout_keeps_the_mean_and_stops_in_eval_mode() -> None:
    field = Lines()
    with gridreg.apply(
        field, gridreg.ComponentDropout(gridreg.parameters("line", dim=1), p=0.25), total_steps=10, seed=4
    ) as handle:
        sums = []
        for step in range(50):
            handle.step(step)
            found = field()
            assert set(found.detach().unique().tolist()) == {0.0, 4.0}
            assert torch.equal(field(), found)  # the same within a step
            sums.append(found.mean().item())
        assert np.mean(sums) == pytest.approx(3.0, rel=0.02)
        assert len(set(sums)) > 10
        field.eval()
        assert (field() == 3).all()
        field.train()
        assert (field() != 3).any()


def test_dropout_grows_as_dropgaussian_schedules_it() -> None:
    field = Lines()
    dropout = gridreg.ComponentDropout(gridreg.parameters("line", dim=1))
    with gridreg.apply(field, dropout, total_steps=100) as handle:
        assert (field() == 3).all()
        handle.step(50)
        assert handle.values() == {"ComponentDropout(line)": 0.1}
        assert 0.05 < (field() == 0).float().mean() < 0.15


def test_detached_channels_keep_their_value_and_lose_their_gradient() -> None:
    field = Lines()
    mask = gridreg.FixedMask(gridreg.parameters("line", dim=1), visible_ratio=0.5, detach=True)
    with gridreg.apply(field, mask, total_steps=10):
        out = field()
        assert (out == 3).all()
        out.sum().backward()
    assert field.line.grad is not None
    assert (field.line.grad[:, :200] == 1).all()
    assert (field.line.grad[:, 200:] == 0).all()
