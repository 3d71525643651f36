"""The mean of the last iterates, which is a better field than any of them: stochastic weight averaging."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


class WeightAverage:
    """Running mean of parameters.

    With a few rays an iteration, and learning rates that are still large at the end, every iterate carries the noise
    of the last batches; their mean does not. Source: Izmailov et al., "Averaging Weights Leads to Wider Optima and
    Better Generalization" (2018).

    Example:
        >>> weight = torch.nn.Parameter(torch.tensor([1.0]))
        >>> average = WeightAverage()
        >>> for value in (1.0, 2.0, 6.0):
        ...     _ = weight.data.fill_(value)
        ...     average.add([weight])
        >>> average.copy_to([weight])
        >>> weight.item()
        3.0
    """

    def __init__(self) -> None:
        self.count = 0
        self.means: list[Tensor] = []

    @torch.no_grad()
    def add(self, parameters: Iterable[Tensor]) -> None:
        """Take one more iterate in."""
        given = list(parameters)
        if not self.count:
            self.means = [p.detach().clone() for p in given]
        self.count += 1
        for mean, p in zip(self.means, given, strict=True):
            mean.lerp_(p, 1 / self.count)

    @torch.no_grad()
    def copy_to(self, parameters: Iterable[Tensor]) -> None:
        """Write the mean into the parameters, if there is one, and forget it."""
        if self.count:
            for mean, p in zip(self.means, parameters, strict=True):
                p.copy_(mean)
        self.clear()

    def clear(self) -> None:
        """Forget everything, as after a resampling, when the parameters are others."""
        self.count, self.means = 0, []

    def state_dict(self) -> dict[str, Any]:
        """All that a later process needs to go on."""
        return {"count": self.count, "means": self.means}

    def load_state_dict(self, state: dict[str, Any], device: torch.device | str = "cpu") -> None:
        """Go on from `state_dict`, on the device of the parameters."""
        self.count, self.means = state["count"], [mean.to(device) for mean in state["means"]]
