"""Launching kernels: arguments, teams, several Python threads, forks, and where compiled code is kept."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from threading import Thread

import pytest
import torch
from numba.core import caching

from gridreg.ops.cpu.jit import cache
from gridreg.ops.cpu.jit import launch as threading
from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, prefetch, scalar_zero, store, total, vector_zero
from gridreg.ops.cpu.jit.table import (
    cube,
    float32,
    int64,
    integer,
    matrix,
    next_task,
    real,
    scratch,
    size,
    uint8,
    vector,
)
from gridreg.ops.cpu.jit.workspace import workspace
from tests.kernel_grids import threads


@kernel
def _count(table):
    """How often each task was served."""
    served = vector(table, 0, int64)
    while True:
        task = next_task(table)
        if task < 0:
            break
        served[task] += 1


@kernel
def _read(table):
    """A vector, a matrix, a cube, an integer, a number; out."""
    a, b, c = vector(table, 0, float32), matrix(table, 1, int64), cube(table, 2, uint8)
    out = vector(table, 5, float32)
    kept = scratch(4, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(4):
            kept[i] = a[i]
        out[0] = kept[0] + kept[3]
        out[1] = b[1, 2]
        out[2] = c[1, 0, 2]
        out[3] = integer(table, 3)
        out[4] = real(table, 4)
        out[5] = a.shape[0] * 100 + b.shape[0] * 10 + c.shape[2]
        for place in range(3):
            out[6 + place] = size(table, place, 1)


@kernel
def _lanes(table):
    """x, y, sums: the arithmetic of vectors and of single numbers."""
    x, y, sums = vector(table, 0, float32), vector(table, 1, float32), vector(table, 2, float32)
    blocks = x.shape[0] - x.shape[0] % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(0, blocks, LANES):
            prefetch(x, i + LANES)
            v = load(x, i, vector_zero())
            store(y, i, (v - float32(1)) * v + float32(2) * v * (float32(3) - v))
            sums[0] += total(v)
            store(y, i, load(y, i, vector_zero()) + float32(0.5))
        for i in range(blocks, x.shape[0]):
            v = load(x, i, scalar_zero())
            store(y, i, (v - float32(1)) * v + float32(2) * v * (float32(3) - v))
            sums[0] += total(v)
            store(y, i, load(y, i, scalar_zero()) + float32(0.5))


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("tasks", [0, 1, 3, 1000])
def test_each_task_is_served_once(tasks, count):
    served = torch.zeros(max(tasks, 1), dtype=torch.int64)
    with threads(count):
        launch(_count, tasks, served)
    assert bool((served[:tasks] == 1).all())


def test_python_team(monkeypatch):
    monkeypatch.setitem(threading._state, "team", threading._python_team())
    for count in (2, 5):
        served = torch.zeros(1000, dtype=torch.int64)
        with threads(count):
            launch(_count, 1000, served)
        assert bool((served == 1).all())


def test_reads_arguments():
    a, b = torch.arange(10.0), torch.arange(12).reshape(3, 4)
    c = torch.arange(24, dtype=torch.uint8).reshape(2, 3, 4)
    out = torch.zeros(9)
    launch(_read, 1, a, b, c, 7, 2.5, out)
    assert out.tolist() == [3.0, 6.0, 14.0, 7.0, 2.5, 1034.0, 1.0, 4.0, 3.0]


@pytest.mark.parametrize("length", [0, 3, 8, 29])
def test_vector_arithmetic(length):
    x = torch.linspace(-2, 3, length)
    y, sums = torch.empty(length), torch.zeros(1)
    launch(_lanes, 1, x, y, sums)
    torch.testing.assert_close(y, (x - 1) * x + 2 * x * (3 - x) + 0.5)
    torch.testing.assert_close(sums[0], x.sum())


def test_refuses_strided_tensors():
    with pytest.raises(ValueError, match=r"argument 0: found cpu tensor .* expected a contiguous"):
        launch(_count, 1, torch.zeros(4, 4, dtype=torch.int64).t())


def test_work_space_is_kept_and_grows():
    small = workspace("test", 10)
    assert workspace("test", 2, 5).data_ptr() == small.data_ptr()
    assert workspace("test", 10, dtype=torch.int32).dtype == torch.int32
    assert workspace("test", 1000).shape == (1000,)
    assert workspace("test", 3, 4).is_contiguous()


def test_without_a_folder_for_the_cache(monkeypatch):
    def refuse(self):
        raise OSError("read-only")

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuse)
    fresh = kernel(_count.function)
    served = torch.zeros(3, dtype=torch.int64)
    launch(fresh, 3, served)
    assert served.tolist() == [1, 1, 1]


def test_kernels_of_other_versions_are_forgotten(tmp_path):
    stale, foreign = tmp_path / "vm._density-1.py311.nbi", tmp_path / "other.f-1.py311.nbi"
    for file in (stale, foreign):
        file.write_text("x")
    assert cache.forget_outdated(str(tmp_path))
    assert not stale.exists()
    assert foreign.exists()
    stale.write_text("fresh")
    cache.forget_outdated.cache_clear()
    assert not cache.forget_outdated(str(tmp_path))
    assert stale.exists()


@pytest.mark.skipif(not cache.can_lock(), reason="files cannot be locked here")
def test_one_process_compiles_while_others_wait(tmp_path):
    folder, order = str(tmp_path / "cache"), []

    def second():
        with cache.one_process(folder, "vm._density"):
            order.append("second")

    with cache.one_process(folder, "vm._density"):
        # A file opened anew has a lock of its own, as another process has.
        other = Thread(target=second)
        other.start()
        other.join(0.2)
        order.append("first")
    other.join(10)
    assert order == ["first", "second"]


def run_script(text):
    """Run a script in a process of its own, which must end well."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PRELUDE = """
    import threading, torch
    from gridreg import ops
    torch.set_num_threads(2)

    def work(seed):
        g = torch.Generator().manual_seed(seed)
        planes = [torch.randn(30, 30, 16, generator=g, requires_grad=True) for _ in range(3)]
        lines = [torch.randn(30, 16, generator=g, requires_grad=True) for _ in range(3)]
        u = torch.rand(4000, 3, generator=g)
        out = ops.vm_density(u, planes, lines)
        out.square().sum().backward()
        return [out.detach(), *(x.grad for x in (*planes, *lines))]
"""


def test_two_python_threads_at_once():
    run_script(
        PRELUDE
        + """
    expected = [work(seed) for seed in (0, 1)]
    wrong = []

    def repeat(seed):
        for _ in range(15):
            for a, b in zip(work(seed), expected[seed], strict=True):
                if not torch.equal(a, b):
                    wrong.append(seed)

    both = [threading.Thread(target=repeat, args=(seed,)) for seed in (0, 1)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert not wrong, wrong
    """
    )


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork on Windows")
def test_forked_process():
    out = run_script(
        PRELUDE
        + """
    import os, sys
    expected = work(0)
    child = os.fork()
    if child == 0:
        torch.set_num_threads(1)
        import gridreg.ops.cpu.jit.launch as team
        assert team._state["forked"]
        torch.set_num_threads(2)
        served = torch.zeros(500, dtype=torch.int64)
        from gridreg.ops.cpu.counting_sort import list_by_row
        u = torch.rand(3000, 3)
        list_by_row(u, torch.ones(3000), (5, 5, 5), 2)
        os._exit(7)
    _, status = os.waitpid(child, 0)
    print(os.waitstatus_to_exitcode(status))
    """
    )
    assert out.strip() == "7"
