"""Penalties on density at samples, and on its derivative: sparsity, eikonal."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg.base import register
from gridreg.errors import InputError
from gridreg.regularizers.rays import SamplesPenalty
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric


def cauchy_sparsity(samples: RaySamples) -> Tensor:
    """Sum over samples of ``log(1 + 2 density^2)``: most of space is empty.

    Args:
        samples: `N` samples; those that were skipped have density 0 and add nothing.

    Returns:
        Scalar (densities per world unit). Source: SNeRG (Hedman et al. 2021); Plenoxels (Yu et al. 2022).

    Example:
        >>> samples = RaySamples.from_dense(torch.arange(2.0), torch.ones(2), torch.tensor([[0.0, 1.0]]))
        >>> round(cauchy_sparsity(samples).item(), 4)  # log 3
        1.0986
    """
    return torch.log1p(2 * samples.density.square()).sum()


def eikonal(samples: RaySamples) -> Tensor:
    """Mean over samples of ``(|g| - 1)^2``: a signed distance grows by 1 for each unit of length.

    Args:
        samples: with `gradients` of a signed distance.

    Returns:
        Scalar, no unit. Source: IGR (Gropp et al. 2020), equation 2.

    Raises:
        InputError: the samples have no gradients.

    Example:
        >>> g = torch.tensor([[[3.0, 0.0, 0.0]]])
        >>> one = RaySamples.from_dense(torch.ones(1), torch.ones(1), torch.ones(1, 1), gradients=g)
        >>> eikonal(one).item()
        4.0
    """
    if samples.gradients is None:
        raise InputError("eikonal needs samples with gradients, found None")
    lengths: Tensor = torch.linalg.vector_norm(samples.gradients, dim=-1)
    return (lengths - 1).square().sum() / max(len(samples), 1)


@register
@dataclass(frozen=True)
class CauchySparsity(SamplesPenalty):
    """Density anywhere is penalised, large values little more than middling ones: see `cauchy_sparsity`.

    Args:
        weight: factor of the loss; Plenoxels: 1e-12 (forward-facing) to 1e-11 (all around).

    Formula: ``sum log(1 + 2 density^2)`` over the samples
    Unit: none (density per world unit)
    Source: SNeRG (Hedman et al. 2021); on grids Plenoxels (Yu et al. 2022)
    """

    weight: Numeric = 1e-11
    function = staticmethod(cauchy_sparsity)


@register
@dataclass(frozen=True)
class Eikonal(SamplesPenalty):
    """The gradient of a signed distance should have length 1: see `eikonal`.

    Args:
        weight: factor of the loss; IGR, VolSDF and NeuS: 0.1.

    Formula: ``mean((|g| - 1)^2)`` over samples, ``g`` the derivative of the distance by the position
    Unit: none
    Source: IGR (Gropp et al. 2020), equation 2
    """

    weight: Numeric = 0.1
    function = staticmethod(eikonal)
    required = ("gradients",)
