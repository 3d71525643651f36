"""Grids, positions and comparisons for the tests of lookups."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from hypothesis import strategies as st
from scipy import ndimage

from gridreg.ops import use_backend

PLANE_AXES = ((0, 1), (0, 2), (1, 2))
LINE_AXES = (2, 1, 0)

edges = st.tuples(*[st.integers(2, 9)] * 3)
channels = st.integers(1, 20)
seeds = st.integers(0, 2**31)


def make_grids(seed, shape, count, dtype=torch.float32):
    """Planes and lines of a grid with ``shape`` nodes and ``count`` channels."""
    g = torch.Generator().manual_seed(seed)
    planes = [torch.randn(shape[a], shape[b], count, generator=g, dtype=dtype) for a, b in PLANE_AXES]
    lines = [torch.randn(shape[v], count, generator=g, dtype=dtype) for v in LINE_AXES]
    return planes, lines


def make_positions(seed, samples, dtype=torch.float32):
    """Positions inside, outside and exactly on faces, edges, corners and the middle of the box, some repeated."""
    g = torch.Generator().manual_seed(seed)
    u = torch.rand(samples, 3, generator=g, dtype=dtype) * 1.4 - 0.2
    special = torch.tensor(list(itertools.product((0.0, 0.5, 1.0), repeat=3)), dtype=dtype)
    u[::3] = special[torch.randint(27, (len(u[::3]),), generator=g)]
    u[1::4] = u[:1]
    return u


def numpy_plane(plane, ua, ub):
    """Bilinear interpolation by SciPy, ``(N, C)``."""
    values, (rows, columns) = plane.double().numpy(), plane.shape[:2]
    at = np.clip(np.stack([ua, ub]), 0, 1) * np.array([[rows - 1], [columns - 1]])
    return np.stack(
        [
            ndimage.map_coordinates(values[..., c], at, order=1, mode="nearest")
            for c in range(values.shape[2])
        ],
        1,
    )


def numpy_line(line, u):
    """Linear interpolation by NumPy, ``(N, C)``."""
    values = line.double().numpy()
    nodes = np.linspace(0, 1, values.shape[0])
    return np.stack([np.interp(u, nodes, values[:, c]) for c in range(values.shape[1])], 1)


def close(found, expected, tolerance, terms=None):
    """Equal up to a share of ``terms``, the sum of the magnitudes of what was added up; or of the largest value.

    Sums of numbers of both signs have no accuracy relative to themselves.
    """
    assert found.shape == expected.shape
    assert found.dtype == expected.dtype
    scale = expected.abs().max() if terms is None and expected.numel() else terms
    assert expected.numel() == 0 or bool(((found - expected).abs() <= tolerance * scale).all())


def evaluate(backend, function, tensors, seed=0, positive=False):
    """Output of ``function(*leaves)`` and the gradients of its leaves for a random upstream gradient."""
    leaves = [(x.abs() if positive else x.clone()).requires_grad_() for x in tensors]
    with use_backend(backend):
        out = function(*leaves)
        g = torch.Generator().manual_seed(seed)
        upstream = torch.randn(out.shape, generator=g, dtype=out.dtype)
        # As in training, where many samples are hidden.
        upstream[torch.rand(out.shape[0], generator=g) < 0.3] = 0
        out.backward(upstream.abs() if positive else upstream)
    return out.detach(), [leaf.grad for leaf in leaves]


def assert_same(function, tensors):
    """The compiled version has the values and gradients of the plain one."""
    found, found_gradients = evaluate("compiled", function, tensors)
    expected, expected_gradients = evaluate("torch", function, tensors)
    # All is sums of products, so that the same with magnitudes adds up the magnitudes.
    terms, gradient_terms = evaluate("torch", function, tensors, positive=True)
    close(found, expected, 1e-5, terms)
    for a, b, c in zip(found_gradients, expected_gradients, gradient_terms, strict=True):
        close(a, b, 1e-4, c)


class threads:
    """A number of threads for a block."""

    def __init__(self, count):
        self.count = count

    def __enter__(self):
        self.before = torch.get_num_threads()
        torch.set_num_threads(self.count)

    def __exit__(self, *error):
        torch.set_num_threads(self.before)
