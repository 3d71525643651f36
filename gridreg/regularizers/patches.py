"""Penalties on neighbouring rays of image patches: smooth depth and normals, small divergence."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional as F

from gridreg.base import register
from gridreg.errors import InputError
from gridreg.regularizers.rays import TINY, SamplesPenalty, alpha_of
from gridreg.samples import RaySamples
from gridreg.schedules import Geometric, Numeric

_REGNERF_WEIGHT = Geometric(400.0, 0.1, until=512)


def _in_patches(samples: RaySamples, values: Tensor, needed: tuple[int, int], purpose: str) -> Tensor:
    """The values ``(R, ...)`` of the rays that are patches: ``(count, height, width, ...)``."""
    if samples.patch is None or samples.patch[1] < needed[0] or samples.patch[2] < needed[1]:
        raise InputError(
            f"{purpose} needs samples.patch = (count, height, width) with patches of at least "
            f"{needed[0]}x{needed[1]} rays, found {samples.patch}"
        )
    count, height, width = samples.patch
    last = values[samples.rays - count * height * width :]
    return last.reshape(count, height, width, *values.shape[1:])


def _steps(images: Tensor) -> tuple[Tensor, Tensor]:
    """Differences to the neighbour below and to the one on the right, ``(count, height - 1, width - 1, ...)``."""
    corner = images[:, :-1, :-1]
    return corner - images[:, 1:, :-1], corner - images[:, :-1, 1:]


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
    down, right = _steps(_in_patches(samples, samples.depth, (2, 2), "DepthSmoothness"))
    return (down.square() + right.square()).mean()


def normal_smoothness(samples: RaySamples) -> Tensor:
    """Mean absolute difference of the normal between a ray of a patch and its neighbours below and to the right.

    ``mean_ij |n_ij - n_{i+1,j}|_1 + |n_ij - n_{i,j+1}|_1`` with the normal of a ray, the mean by weight of the
    directions of its samples' gradients, at unit length.

    Args:
        samples: with `gradients`; the last rays are patches (`RaySamples.patch`).

    Returns:
        Scalar, no unit. Source: DN-Splatter (Turkulainen et al. 2024), normal smoothness; the same at points moved a
        little: UNISURF (Oechsle et al. 2021).

    Raises:
        InputError: the samples have no gradients, no patches, or none of at least 2x2 rays.

    Example:
        >>> import torch
        >>> g = torch.tensor([[[0.0, 0.0, 2.0]]]).expand(4, 1, 3)
        >>> t, density = torch.ones(1), torch.ones(4, 1)
        >>> rays = RaySamples.from_dense(t, t, density, gradients=g, patch=(1, 2, 2))
        >>> normal_smoothness(rays).item()
        0.0
    """
    if samples.gradients is None:
        raise InputError("NormalSmoothness needs samples with gradients, found None")
    summed = samples.sum_per_ray(samples.weights[:, None] * F.normalize(samples.gradients, dim=-1))
    down, right = _steps(_in_patches(samples, F.normalize(summed, dim=-1), (2, 2), "NormalSmoothness"))
    return (down.abs() + right.abs()).sum(-1).mean()


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
    alpha = _in_patches(samples, samples.to_dense(alpha_of(samples)), (1, 2), "RayKL")
    share = alpha / (alpha.sum(-1, keepdim=True) + TINY) + TINY
    ray, neighbour = share[:, :, :-1], share[:, :, 1:]
    return (ray * (ray / neighbour).log()).sum(-1).mean()


@register
@dataclass(frozen=True)
class DepthSmoothness(SamplesPenalty):
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
    function = staticmethod(depth_smoothness)
    required = ("patch",)


@register
@dataclass(frozen=True)
class NormalSmoothness(SamplesPenalty):
    """Bends between neighbouring rays of patches are penalised: see `normal_smoothness`.

    Args:
        weight: factor of the loss.

    Formula: ``mean(|n_ij - n_{i+1,j}|_1 + |n_ij - n_{i,j+1}|_1)`` over patches, ``n`` the unit normal of a ray
    Unit: none
    Source: DN-Splatter (Turkulainen et al. 2024), normal smoothness; after UNISURF (Oechsle et al. 2021)
    """

    weight: Numeric = 0.01
    function = staticmethod(normal_smoothness)
    required = ("gradients", "patch")


@register
@dataclass(frozen=True)
class RayKL(SamplesPenalty):
    """Neighbouring rays should meet matter at the same steps: see `ray_kl`.

    Args:
        weight: factor of the loss; InfoNeRF: 1e-5.

    Formula: ``mean(sum_i p_i log(p_i / q_i))`` over rays and their right neighbours
    Unit: nats
    Source: InfoNeRF (Kim et al. 2022), information gain reduction
    """

    weight: Numeric = 1e-5
    function = staticmethod(ray_kl)
    required = ("patch",)
