"""Base of penalties that are a plain function of the samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from gridreg.attach.sites import SiteLike
from gridreg.base import Context, Regularizer
from gridreg.samples import RaySamples

__all__ = ["SamplesPenalty"]


@dataclass(frozen=True)
class SamplesPenalty(Regularizer):
    """Base of penalties that are a function of the samples alone.

    Class attributes:
        function: the penalty without its weight, of `RaySamples` alone, as a static method.
        required: attributes of the samples that it reads and that a renderer may leave out (None).
    """

    function: ClassVar[Any]
    required: ClassVar[tuple[str, ...]] = ()

    def needs(self) -> tuple[str, ...]:
        """Attributes that the function reads."""
        return self.required

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """The function of the samples."""
        found: Tensor = self.function(samples)
        return found

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """At its default."""
        return [cls()]
