"""Penalties on neighbouring rays of image patches: smooth depth, small divergence."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gridreg.attach.sites import SiteLike
from gridreg.base import Context, Regularizer, check_weight, register
from gridreg.errors import InputError
from gridreg.regularizers.rays import TINY, alpha_of
from gridreg.samples import RaySamples
from gridreg.schedules import Geometric, Numeric

__all__ = ["DepthSmoothness", "RayKL", "depth_smoothness", "ray_kl"]

_REGNERF_WEIGHT = Geometric(400.0, 0.1, until=512)


def _patches(samples: RaySamples, needed: tuple[int, int], purpose: str) -> tuple[int, int, int]:
    if samples.patch is None or samples.patch[1] < needed[0] or samples.patch[2] < needed[1]:
        raise InputError(
            f"{purpose} needs samples.patch = (count, height, width) with patches of at least "
            f"{needed[0]}x{needed[1]} rays, found {samples.patch}"
        )
    return samples.patch


def depth_smoothness(samples: RaySamples) -> Tensor:
    """Mean squared difference of depth between a ray of a patch and its neighbours below and to the right.

    ``mean_ij (d_ij - d_{i+1,j})^2 + (d_ij - d_{i,j+1})^2`` over ``i < height``, ``j < width`` and patches.

    Args:
        samples: rays of which the last are patches (`RaySamples.patch`), usually from unseen poses; the
            depth is the sum of weight times distance.

    Returns:
        Scalar, squared world units. Source: RegNeRF (Niemeyer et al. 2022), geometry regularization,
        averaged as in its program.

    Raises:
        InputError: the samples have no patches, or none of at least 2x2 rays.

    Example:
        >>> import torch
        >>> t = torch.tensor([[1.0], [1.0], [1.0], [2.0]])
        >>> samples = RaySamples.from_dense(t, torch.ones(1), torch.full((4, 1), 100.0), patch=(1, 2, 2))
        >>> depth_smoothness(samples).item()
        0.0
    """
    count, height, width = _patches(samples, (2, 2), "DepthSmoothness")
    depth = samples.depth[samples.rays - count * height * width :].reshape(count, height, width)
    corner = depth[:, :-1, :-1]
    return ((corner - depth[:, 1:, :-1]).square() + (corner - depth[:, :-1, 1:]).square()).mean()


def ray_kl(samples: RaySamples) -> Tensor:
    """Mean Kullback-Leibler divergence of a ray from its right neighbour in the patch.

    ``sum_i p_i log(p_i / q_i)`` with ``p_i = alpha_i / sum_j alpha_j + 1e-10`` of the ray and ``q`` of the
    neighbour, steps of equal number side by side. Patches of 1x2 rays are InfoNeRF's pairs.

    Args:
        samples: rays of which the last are patches (`RaySamples.patch`).

    Returns:
        Scalar in nats. Source: InfoNeRF (Kim et al. 2022), information gain reduction; its program has ray
        and neighbour exchanged.

    Raises:
        InputError: the samples have no patches, or none of at least 1x2 rays.

    Example:
        >>> import torch
        >>> two = RaySamples.from_dense(torch.ones(3), torch.ones(3), torch.ones(2, 3), patch=(1, 1, 2))
        >>> ray_kl(two).item()
        0.0
    """
    count, height, width = _patches(samples, (1, 2), "RayKL")
    first = samples.rays - count * height * width
    alpha = samples.to_dense(alpha_of(samples))[first:].reshape(count, height, width, -1)
    share = alpha / (alpha.sum(-1, keepdim=True) + TINY) + TINY
    ray, neighbour = share[:, :, :-1], share[:, :, 1:]
    return (ray * (ray / neighbour).log()).sum(-1).mean()


@register
@dataclass(frozen=True)
class DepthSmoothness(Regularizer):
    """Steps of depth between neighbouring rays of unseen patches are penalised: see `depth_smoothness`.

    Args:
        weight: factor of the loss; RegNeRF: 400 falling to 0.1 over 512 steps.

    Formula: ``mean((d_ij - d_{i+1,j})^2 + (d_ij - d_{i,j+1})^2)`` over patches
    Unit: squared world units
    Source: RegNeRF (Niemeyer et al. 2022), geometry regularization

    Example:
        >>> DepthSmoothness().weight.at(512, 15_000)
        0.1
    """

    weight: Numeric = _REGNERF_WEIGHT

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step."""
        check_weight(self.weight)

    def needs(self) -> tuple[str, ...]:
        """Patches."""
        return ("patch",)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`depth_smoothness`."""
        return depth_smoothness(samples)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """At its default."""
        return [cls()]


@register
@dataclass(frozen=True)
class RayKL(Regularizer):
    """Neighbouring rays should meet matter at the same steps: see `ray_kl`.

    Args:
        weight: factor of the loss; InfoNeRF: 1e-5.

    Formula: ``mean(sum_i p_i log(p_i / q_i))`` over rays and their right neighbours
    Unit: nats
    Source: InfoNeRF (Kim et al. 2022), information gain reduction

    Example:
        >>> RayKL().weight
        1e-05
    """

    weight: Numeric = 1e-5

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step."""
        check_weight(self.weight)

    def needs(self) -> tuple[str, ...]:
        """Patches."""
        return ("patch",)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`ray_kl`."""
        return ray_kl(samples)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """At its default."""
        return [cls()]
