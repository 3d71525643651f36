"""The laws of masks alone."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from gridreg.attach.selectors import outputs
from gridreg.attach.sites import Place
from gridreg.base import Clock, Context, Regularizer
from gridreg.regularizers.mask_base import Mask
from gridreg.testing._subjects import STEPS, Subject, contexts, expect, tensor_for


def closed_channels(regularizer: Regularizer, subject: Subject) -> None:
    """A closed channel has exactly no effect and no gradient, even where it is NaN or infinite."""
    if not isinstance(regularizer, Mask):
        return
    for context in contexts(regularizer, subject, 2):
        place = context.place
        assert place is not None
        closed = context.state["mask"] == 0
        value = tensor_for(context).detach()
        count = int(closed.sum())
        bad = torch.tensor([float("nan"), float("inf")], dtype=value.dtype).repeat(count)[:count]
        value.movedim(place.dim, -1)[..., closed] = bad
        value.requires_grad_()
        result = regularizer.transform(value, context)
        (gradient,) = torch.autograd.grad(result, value, torch.ones_like(result))
        expect((gradient.movedim(place.dim, -1)[..., closed] == 0).all(), "a closed channel has a gradient")
        if regularizer.detach:
            expect(torch.equal(result.nan_to_num(), value.nan_to_num()), "values change")
        else:
            expect((result.movedim(place.dim, -1)[..., closed] == 0).all(), "a closed channel has an effect")
        expect(result.movedim(place.dim, -1)[..., ~closed].isfinite().all(), "an open channel is spoilt")


def masks(regularizer: Regularizer, subject: Subject) -> None:
    """A mask keeps `check_mask` at channels without and with octaves, at every step of a run."""
    if isinstance(regularizer, Mask):
        for octaves in (None, (-1, 0, 0, 1, 1, 2, 2, 3), (0, 1, 2)):
            place = Place("grid", outputs("grid"), -1, octaves=octaves)
            place.complete(7 if octaves is None else len(octaves))
            for step in range(0, STEPS + 2, 3):
                check_mask(regularizer, place, step, STEPS)


def check_mask(mask: Mask, place: Place, step: int, total_steps: int) -> None:
    """The laws of masks at one place, step and run length.

    Raises:
        AssertionError: a value outside [0, 1], one that increases along the ranks or decreases with the step,
            a channel that is closed after the end, or a scheduled mask whose lowest rank is closed at step 0.
    """

    def at(step: int) -> Tensor:
        clock = Clock(total_steps, seed=0)
        clock.step = step
        return mask.mask(Context(clock, place))

    values = at(step)
    expect(values.dtype == torch.float32, f"a mask is float32, found {values.dtype}")
    expect(values.shape == (place.channels,), f"a mask of shape {tuple(values.shape)}")
    expect(values.min() >= 0 and values.max() <= 1, "a mask outside [0, 1]")
    ranks = torch.tensor(mask.ranks(place))
    by_rank = [group for rank in range(int(ranks.max()) + 1) if len(group := values[ranks == rank])]
    expect(all((group == group[0]).all() for group in by_rank), "channels of one rank differ")
    if mask.monotone():
        expect(all(low[0] >= high[0] for low, high in pairwise(by_rank)), "a mask increases with the rank")
        expect((at(step + 1) >= values).all(), "a mask decreases with the step")
    end = mask.end(int(ranks.max()) + 1, total_steps)
    if end is not None:
        expect((at(end) == 1).all(), "a mask is not fully open at its end")
        expect((at(max(end, step)) == 1).all(), "a mask closes after its end")
        # An encoding may lack the identity, which is the lowest rank.
        expect(0 not in ranks or (at(0) == 1).any(), "nothing is open at step 0")
