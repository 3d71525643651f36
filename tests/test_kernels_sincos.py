"""Sine and cosine in kernels, against float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.simd_math import sine_and_cosine
from gridreg.ops.cpu.jit.table import float32, next_task, vector


@kernel
def _both(table) -> None:
    x, sine, cosine = vector(table, 0, float32), vector(table, 1, float32), vector(table, 2, float32)
    while next_task(table) >= 0:
        split = x.shape[0] - x.shape[0] % LANES
        for i in range(0, split, LANES):
            s, c = sine_and_cosine(load(x, i, vector_zero()))
            store(sine, i, s)
            store(cosine, i, c)
        for i in range(split, x.shape[0]):
            s, c = sine_and_cosine(load(x, i, scalar_zero()))
            sine[i], cosine[i] = s, c


def sine_and_cosine_of(x):
    sine, cosine = torch.empty_like(x), torch.empty_like(x)
    launch(_both, 1, x, sine, cosine)
    return sine, cosine


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0, 1e4, 1e6])
def test_they_are_those_of_float64(scale):
    x = scale * (2 * torch.rand(10007, generator=torch.Generator().manual_seed(0)) - 1)
    sine, cosine = sine_and_cosine_of(x)
    np.testing.assert_allclose(sine.double(), x.double().sin(), atol=2e-7, rtol=0)
    np.testing.assert_allclose(cosine.double(), x.double().cos(), atol=2e-7, rtol=0)


def test_multiples_of_a_quarter_turn_and_what_has_none():
    x = torch.cat([torch.arange(-40, 41) * (torch.pi / 2), torch.tensor([0.0, -0.0, 1e-40])]).float()
    sine, cosine = sine_and_cosine_of(x)
    np.testing.assert_allclose(sine.double(), x.double().sin(), atol=2e-7, rtol=0)
    np.testing.assert_allclose(cosine.double(), x.double().cos(), atol=2e-7, rtol=0)
    for found in sine_and_cosine_of(torch.tensor([float("nan"), float("inf"), -float("inf")] * 5)):
        assert bool(found.isnan().all())
