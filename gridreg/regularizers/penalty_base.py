"""Base of penalties that are a plain function of the samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from gridreg.base import Context, Regularizer
from gridreg.samples import RaySamples

__all__ = ["SamplesPenalty"]


@dataclass(frozen=True)
class SamplesPenalty(Regularizer):
    """Base of penalties that are a function of the samples alone.

    Class attributes:
        function: the penalty without its weight, of `RaySamples` alone, as a static method.
    """

    function: ClassVar[Any]
    example_arguments = ({},)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """The function of the samples."""
        found: Tensor = self.function(samples)
        return found
