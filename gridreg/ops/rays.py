"""The inner loops of volume rendering behind names, with plain PyTorch versions that run on any device.

Faster implementations register themselves under a name (`register_backend`); `use_backend` chooses. The plain
versions are the reference: a registered one must return the same samples, and the same values up to rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops import ray_reference as plain
from gridreg.ops.dispatch import (
    Backend,
    Marched,
    backend_for,
    chosen_backend,
    register_backend,
    registered_backends,
    takes_compiled,
    use_backend,
)

__all__ = [
    "Backend",
    "accumulate",
    "chosen_backend",
    "composite_weights",
    "march",
    "pixels",
    "pool",
    "register_backend",
    "registered_backends",
    "spread",
    "takes_compiled",
    "terminate",
    "use_backend",
]


def march(
    origins: Tensor,
    directions: Tensor,
    t_min: Tensor,
    t_max: Tensor,
    step: float,
    cells: Tensor,
    bounds: Tensor,
    jitter: Tensor | float,
) -> Marched:
    """Sample rays at a fixed step, keeping the samples that lie in occupied cells.

    Sample ``index`` of a ray lies at ``t = t_min + (index + jitter) * step`` and is kept when ``t < t_max``
    and the cell ``floor(u * cells.shape)`` of its position is occupied, ``u`` the position normalised to
    ``bounds``. Positions outside ``bounds`` are in no cell; within a thousandth of a cell of a face they
    count as inside. Every operation is rounded to the rays' dtype in the order of the formula, so all
    backends keep exactly the same samples.

    Args:
        origins, directions: ``(R, 3)``, world units; directions have length 1.
        t_min, t_max: ``(R,)`` entry and exit distance; a ray with ``t_min >= t_max`` has no samples.
        step: distance between samples, world units.
        cells: ``(X, Y, Z)`` uint8 or bool occupancy, nonzero = occupied.
        bounds: ``(2, 3)`` corners of the box that ``cells`` divides.
        jitter: in [0, 1): ``(R,)`` or one number; 0.5 for rendering.

    Returns:
        ``offsets (R + 1,)`` int64, ``index (N,)`` int64, ``t (N,)`` and ``positions (N, 3)``; the samples of
        ray r are ``offsets[r] : offsets[r + 1]`` in increasing ``t``. Not differentiable.

    Raises:
        InputError: for shapes that do not fit, a step that is not positive, or an infinite range.

    Example:
        >>> o, d = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]])
        >>> cells = torch.tensor([0, 1], dtype=torch.uint8).reshape(2, 1, 1)
        >>> bounds = torch.tensor([[0.0, -1.0, -1.0], [4.0, 1.0, 1.0]])
        >>> offsets, index, t, _ = march(o, d, torch.zeros(1), torch.full((1,), 4.0), 1.0, cells, bounds, 0.5)
        >>> offsets.tolist(), index.tolist(), t.tolist()
        ([0, 2], [2, 3], [2.5, 3.5])
    """
    plain.check_march(origins, directions, t_min, t_max, step, cells, bounds, jitter)
    backend = backend_for(origins, directions, t_min, t_max, bounds)
    return backend.march(origins, directions, t_min, t_max, step, cells, bounds, jitter)


def composite_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Volume rendering weights ``w_i = T_i (1 - exp(-tau_i))``, ``T_i = exp(-sum_{j < i} tau_j)``.

    Args:
        optical_depth: ``tau (N,)``, density x interval length, at least 0; ``inf`` is an opaque sample.
        offsets: ``(R + 1,)`` int64; the samples of ray r are ``offsets[r] : offsets[r + 1]``.

    Returns:
        ``(N,)`` weights, differentiable once.

    Raises:
        InputError: if ``offsets`` does not end at N.

    References:
        Max, "Optical models for direct volume rendering" (1995); Mildenhall et al., "NeRF" (2020), equation
        3.

    Example:
        >>> composite_weights(torch.tensor([0.6931472, 0.6931472]), torch.tensor([0, 2])).tolist()
        [0.5, 0.25]
    """
    plain.check_packed(optical_depth, offsets, "optical_depth")
    return backend_for(optical_depth).composite_weights(optical_depth, offsets)


def accumulate(weights: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """Weighted sum of ``values`` along every ray.

    Args:
        weights: ``(N,)``.
        values: ``(N, K)``.
        offsets: ``(R + 1,)`` int64.

    Returns:
        ``(R, K)``, 0 for rays without samples; differentiable once in both.

    Raises:
        InputError: if the shapes do not fit.

    Example:
        >>> accumulate(torch.tensor([0.5, 0.25]), torch.ones(2, 1), torch.tensor([0, 2, 2])).tolist()
        [[0.75], [0.0]]
    """
    plain.check_packed(weights, offsets, "weights")
    if values.dim() != 2 or values.shape[0] != weights.shape[0]:
        raise InputError(f"values: found shape {tuple(values.shape)}, expected ({weights.shape[0]}, K)")
    return backend_for(weights, values).accumulate(weights, values, offsets)


def pixels(
    weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, opacity and depth of every ray.

    Args:
        weights: ``(N,)``.
        colours: ``(N, 3)``.
        t: ``(N,)`` distance along the ray, world units.
        background: ``(R, 3)``, seen through what is left.
        offsets: ``(R + 1,)`` int64.

    Returns:
        ``sum w c + (1 - sum w) background (R, 3)``, ``sum w (R,)`` and ``sum w t (R,)``, differentiable once.

    Raises:
        InputError: if the shapes do not fit.

    Example:
        >>> w, c, t = torch.tensor([0.5, 0.25]), torch.ones(2, 3), torch.tensor([1.0, 2.0])
        >>> [x.tolist() for x in pixels(w, c, t, torch.zeros(1, 3), torch.tensor([0, 2]))]
        [[[0.75, 0.75, 0.75]], [0.75], [1.0]]
    """
    plain.check_packed(weights, offsets, "weights")
    for name, value, shape in (
        ("colours", colours, (len(weights), 3)),
        ("t", t, (len(weights),)),
        ("background", background, (len(offsets) - 1, 3)),
    ):
        if tuple(value.shape) != shape:
            raise InputError(f"{name}: found shape {tuple(value.shape)}, expected {shape}")
    return backend_for(weights, colours, t, background).pixels(weights, colours, t, background, offsets)


def terminate(optical_depth: Tensor, offsets: Tensor, bound: float) -> Tensor:
    """Mask of the samples that are still seen: the transmittance before them is at least ``bound``.

    Args:
        optical_depth: ``(N,)``, as for `composite_weights`.
        offsets: ``(R + 1,)`` int64.
        bound: in [0, 1]; dropping the rest changes a colour in [0, 1] by less than this.

    Returns:
        ``(N,)`` bool; along a ray it never turns from False to True.

    Raises:
        InputError: if ``offsets`` does not end at N.

    Example:
        >>> terminate(torch.tensor([1.0, 9.0, 1.0]), torch.tensor([0, 3]), 1e-3).tolist()
        [True, True, False]
    """
    plain.check_packed(optical_depth, offsets, "optical_depth")
    return backend_for(optical_depth).terminate(optical_depth, offsets, bound)


def pool(
    weights: Tensor,
    offsets: Tensor,
    floor: float,
    bound: float,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples whose colour is evaluated, and those that share it: see `gridreg.ops.pooling`.

    Args:
        weights: ``(N,)``.
        offsets: ``(R + 1,)`` int64.
        floor: samples that do not weigh more have no colour.
        bound: lighter neighbours are pooled until they weigh this much; not above ``floor``: no pools.
        generator: draws the speakers, in proportion to weight; None: the one at half of the pool's weight.

    Returns:
        ``speakers (P,)`` int64, one sample of every pool, increasing; ``rays (P,)`` int64, theirs; ``pools (N,)``
        int64, the pool of each sample, -1 for none. Not differentiable.

    Raises:
        InputError: if ``offsets`` does not end at N.

    Example:
        >>> weights = torch.tensor([0.5, 0.001, 0.0, 0.004, 0.5])
        >>> [x.tolist() for x in pool(weights, torch.tensor([0, 4, 5]), 1e-4, 0.01)]
        [[0, 3, 4], [0, 0, 1], [0, 1, -1, 1, 2]]
    """
    plain.check_packed(weights, offsets, "weights")
    return backend_for(weights).pool(weights, offsets, floor, bound, generator)


def spread(colours: Tensor, pools: Tensor, speakers: Tensor) -> Tensor:
    """Colours of samples from those of their pools; 0 for a sample in none.

    Args:
        colours: ``(P, C)`` of the speakers.
        pools, speakers: from `pool`.

    Returns:
        ``(N, C)``, differentiable once.

    Example:
        >>> spread(torch.tensor([[0.5], [1.0]]), torch.tensor([0, -1, 1, 1]), torch.tensor([0, 2])).tolist()
        [[0.5], [0.0], [1.0], [1.0]]
    """
    return backend_for(colours).spread(colours, pools, speakers)
