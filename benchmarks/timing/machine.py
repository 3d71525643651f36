"""Rates of this processor, measured: memory bandwidth and arithmetic rate."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Machine:
    """Rates of the whole processor with the present number of threads.

    Args:
        memory: bytes a second of a triad on arrays larger than the caches.
        cache: bytes a second of the same triad on arrays that stay in them.
        float32, bfloat16: operations a second of a matrix product.
    """

    memory: float
    cache: float
    float32: float
    bfloat16: float


def best(run: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest of some runs, after one that does not count (STREAM's rule)."""
    run()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)


def triad(elements: int, repeats: int = 10) -> float:
    """Bytes a second of ``a = b + 3 c`` (McCalpin, STREAM, 1995): two arrays are read and one is written.

    As in STREAM, what the processor reads of ``a`` before it writes it does not count.
    """
    a, b, c = torch.zeros(elements), torch.ones(elements), torch.ones(elements)
    return 3 * 4 * elements / best(lambda: torch.add(b, c, alpha=3.0, out=a), repeats)


def products(size: int, dtype: torch.dtype, repeats: int = 5) -> float:
    """Operations a second of a product of two square matrices: ``2 n^3`` of them."""
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(size, size, generator=generator).to(dtype) for _ in range(2))
    return 2 * size**3 / best(lambda: x @ y, repeats)


def measure(megabytes: int = 256, size: int = 1024) -> Machine:
    """Measure all rates.

    Args:
        megabytes: of each of the three large arrays; more than all caches together.
        size: edge of the matrices.
    """
    return Machine(
        memory=triad(megabytes * 250_000),
        # Three arrays of a quarter of a megabyte for each thread: a second-level cache holds them.
        cache=triad(62_500 * torch.get_num_threads(), repeats=200),
        float32=products(size, torch.float32),
        bfloat16=products(size, torch.bfloat16),
    )
