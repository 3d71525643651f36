"""A second process compiles kernels from the other end: which ones, how far, and when there is none."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import textwrap

import pytest

from gridreg.machine import usable_cores
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


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0, 40])
def test_a_damaged_cache_is_made_anew(tmp_path, kind, left):
    """A power failure leaves files that are empty or cut; they are replaced, which is said once."""
    use = "from gridreg.ops.cpu import reductions; reductions._round.address"
    quiet = {"GRIDREG_COMPILE_AHEAD": "0"}
    before = in_fresh_cache(tmp_path, use, **quiet)
    for file in tmp_path.glob(f"*/*.{kind}"):
        file.write_bytes(file.read_bytes()[:left])
    said = (
        "import contextlib, io\nwith contextlib.redirect_stderr(io.StringIO()) as said:\n    "
        + use.replace("; ", "\n    ")
    )
    told = f"{said}\nassert said.getvalue().count('damaged cache of') == 1, said.getvalue()"
    assert in_fresh_cache(tmp_path, told, **quiet) == before
    assert in_fresh_cache(tmp_path, told.replace("== 1", "== 0"), **quiet) == before
    assert all(file.stat().st_size > left for file in tmp_path.glob(f"*/*.{kind}"))


def test_a_kernel_is_told_of_where_it_is_compiled_and_its_time_is_known(tmp_path):
    use = """
        from gridreg.ops import compilation
        from gridreg.ops.cpu import reductions
        told = []
        with compilation.telling_compilation(told.append):
            reductions._round.address, reductions._round.address
        assert told == {expected}, told
        assert 0 < compilation.compile_seconds() < 60
        """
    for expected in ([0, None], []):  # compiled, then read from the cache
        in_fresh_cache(tmp_path, use.format(expected=expected), GRIDREG_COMPILE_AHEAD="0")
