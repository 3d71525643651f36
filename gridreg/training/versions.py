"""Versions and machine that a result was computed with, so that two results can be told apart."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

import torch

import gridreg
from gridreg.machine import usable_cores

_PACKAGES = ("torch", "numpy", "numba")


def versions() -> dict[str, str | int]:
    """Versions of Python and of the packages that compute, the machine, and the number of threads.

    Keys: ``gridreg``, ``torch``, ``numpy``, ``numba``, ``python``, ``platform``, ``cpu``, ``instructions``
    (the vector instructions that torch uses), ``cores`` (that this process may use), ``threads`` (of
    torch).

    Example:
        >>> sorted(versions())[:3]
        ['cores', 'cpu', 'gridreg']
    """
    found: dict[str, str | int] = {"gridreg": gridreg.__version__}
    found.update({name: package_version(name) for name in _PACKAGES})
    found["python"] = platform.python_version()
    found["platform"] = platform.platform()
    found["cpu"] = cpu_model()
    found["instructions"] = torch.backends.cpu.get_cpu_capability()
    found["cores"] = usable_cores()
    found["threads"] = torch.get_num_threads()
    return found


def package_version(name: str) -> str:
    """The installed version of a package, or ``"not installed"``, without importing it."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def cpu_model(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name, such as ``"AMD EPYC 7763"``; its architecture where the system does not tell."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip().lower() == "model name" and value.strip():
            return " ".join(value.split())
    return platform.processor() or platform.machine() or "unknown"
