"""A second process compiles kernels from the other end: which ones, how far, and when there is none."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import textwrap

import pytest

from gridreg.cores import usable_cores
from gridreg.ops.cpu.jit import cache, precompile
from gridreg.ops.cpu.jit.compiler import Kernel

NAMES = [name for entry in precompile._ORDER for name in ((entry,) if isinstance(entry, str) else entry)]


@pytest.mark.parametrize("name", NAMES)
def test_what_it_names_is_a_kernel(name):
    module, _, function = name.rpartition(".")
    found = getattr(importlib.import_module(f"gridreg.ops.{module}"), function)
    assert isinstance(found, Kernel)
    assert f"gridreg.ops.{name}".endswith(f".{found.name}")


def in_fresh_cache(folder, text, **variables):
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder), **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return sorted(file.name.rpartition("-")[0] for file in folder.glob("*/*.nbi"))


def test_it_compiles_until_it_meets_the_other_process(tmp_path):
    compiled = in_fresh_cache(
        tmp_path,
        """
        from gridreg.ops.cpu.jit import precompile
        from gridreg.ops.cpu import reductions as sums
        sums._round.address
        precompile._ORDER = ("cpu.reductions._measure", "cpu.composite._seen", "cpu.reductions._round")
        precompile.main()
        """,
        GRIDREG_COMPILE_AHEAD="0",
    )
    assert compiled == ["composite._seen", "reductions._measure", "reductions._round"]


@pytest.mark.skipif(
    usable_cores() < 2 or not cache.can_lock(),
    reason="needs a second processor and files that can be locked",
)
def test_an_empty_cache_starts_it(tmp_path):
    compiled = in_fresh_cache(
        tmp_path,
        """
        import time
        from gridreg.ops.cpu import reductions as sums
        from gridreg.ops.cpu.vm import _density
        sums._measure.address
        # Of the second process; this one has no use for it.
        end = time.monotonic() + 100
        while not _density.cached and time.monotonic() < end:
            time.sleep(0.1)
        assert _density.cached
        _density.address
        """,
        GRIDREG_COMPILE_AHEAD="1",
    )
    assert {"vm._density", "reductions._measure"} <= set(compiled)


def test_not_where_it_is_forbidden_or_of_no_use(monkeypatch):
    monkeypatch.setenv("GRIDREG_COMPILE_AHEAD", "0")
    assert precompile.start() is None
    monkeypatch.setenv("GRIDREG_COMPILE_AHEAD", "1")
    monkeypatch.setattr(precompile, "usable_cores", lambda: 1)
    assert precompile.start() is None
