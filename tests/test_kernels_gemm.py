"""Matrix products in kernels: rounding to bfloat16, processors with fewer registers or without instructions
for it."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch

from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.table import float32, next_task, uint16, vector
from gridreg.ops.cpu.mlp import gemm_tile
from gridreg.ops.cpu.mlp.gemm import round_to_bf16

SPECIAL = [0.0, -0.0, 1.0, float("inf"), -float("inf"), 3.4e38, 1.00390625, 1.01171875]


def draw(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@kernel
def _round_trip(table) -> None:
    x, low, back = vector(table, 0, float32), vector(table, 1, uint16), vector(table, 2, float32)
    while next_task(table) >= 0:
        split = x.shape[0] - x.shape[0] % LANES
        for i in range(0, split, LANES):
            store(low, i, load(x, i, vector_zero()))
            store(back, i, load(low, i, vector_zero()))
        for i in range(split, x.shape[0]):
            store(low, i, load(x, i, scalar_zero()))
            store(back, i, load(low, i, scalar_zero()))


@kernel
def _rounded(table) -> None:
    x, low = vector(table, 0, float32), vector(table, 1, uint16)
    while next_task(table) >= 0:
        for i in range(0, x.shape[0], LANES):
            round_to_bf16(low, i, load(x, i, vector_zero()))


def test_numbers_round_to_bfloat16_as_torch_rounds_them():
    x = torch.cat([torch.tensor([*SPECIAL, float("nan"), 1e-40]), draw(1000) * 10.0 ** draw(1000, seed=1)])
    low, back = torch.empty(len(x), dtype=torch.bfloat16), torch.empty(len(x))
    launch(_round_trip, 1, x, low, back)
    np.testing.assert_array_equal(low.float().numpy(), x.bfloat16().float().numpy())
    np.testing.assert_array_equal(back.numpy(), low.float().numpy())


def test_results_of_a_tile_round_so_too():
    x = torch.cat([torch.tensor(SPECIAL), draw(800) * 10.0 ** draw(800, seed=1)])
    low = torch.empty(len(x), dtype=torch.bfloat16)
    launch(_rounded, 1, x, low)
    np.testing.assert_array_equal(low.float().numpy(), x.bfloat16().float().numpy())
    launch(_rounded, 1, torch.tensor([1e-40] * 4 + [float("nan")] * 4), low)
    # The instruction takes subnormal numbers for 0.
    assert low[:4].abs().max() <= 1e-39
    assert bool(low[4:8].isnan().all())


def test_an_emulated_processor_is_not_trusted(monkeypatch):
    """numba may be told to compile for another processor than this one."""
    gemm_tile.has.cache_clear()
    monkeypatch.setattr(gemm_tile.config, "CPU_NAME", "generic")
    try:
        assert gemm_tile.has("avx512bf16") is False
        assert gemm_tile.has("avx2") is False
    finally:
        gemm_tile.has.cache_clear()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names a processor of x86")
@pytest.mark.parametrize("unit", ["nehalem", "vectors"])
def test_smaller_tiles_give_the_same(tmp_path, unit):
    """As on a processor with 16 registers of 4 float32, or without a matrix unit: compiled in a process of its own."""
    if unit == "vectors" and not gemm_tile.BF16.matrix_unit:
        pytest.skip("without a matrix unit, vectors are what the other tests have")
    text = """
        from llvmlite import binding
        features = binding.get_host_cpu_features()
        features["amx-bf16"] = False
        binding.get_host_cpu_features = lambda: features
        import torch
        from gridreg.ops import Block, encoded_mlp
        from gridreg.ops.cpu.mlp.gemm_tile import BF16, F32
        from gridreg.ops.perceptron import Layer

        def draw(*shape, seed=0):
            return torch.randn(shape, generator=torch.Generator().manual_seed(seed))

        assert F32.rows == BF16.rows == ROWS
        x = draw(77, 9).requires_grad_()
        layers = [Layer(draw(40, 45, seed=1) / 7, draw(40, seed=2)), Layer(draw(5, 40, seed=3) / 6, None)]
        layers = [Layer(w.requires_grad_(), b if b is None else b.requires_grad_()) for w, b in layers]
        wanted = [x, layers[0].weight, layers[0].bias, layers[1].weight]
        value = torch.cat([x, x.sin(), x.cos(), (2 * x).sin(), (2 * x).cos()], 1)
        value = (value @ layers[0].weight.T + layers[0].bias).relu() @ layers[1].weight.T
        expected = [value, *torch.autograd.grad(value, wanted, draw(77, 5, seed=4))]
        for precision, bound in (("float32", 1e-5), ("bfloat16", 0.1)):
            found = encoded_mlp([Block(x, 2)], layers, precision=precision)
            found = [found, *torch.autograd.grad(found, wanted, draw(77, 5, seed=4))]
            for a, b in zip(found, expected):
                assert float((a - b).norm() / b.norm()) < bound, precision
    """
    small = {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": "+sse4.2"} if unit == "nehalem" else {}
    text = textwrap.dedent(text).replace("ROWS", "4" if small else "8")
    done = subprocess.run(
        [sys.executable, "-c", text],
        env={**os.environ, **small, "NUMBA_CACHE_DIR": str(tmp_path), "GRIDREG_COMPILE_AHEAD": "0"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
