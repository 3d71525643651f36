"""Ablations: grids of compositions, scenes, view counts and seeds, run here or on many machines, kept in a store."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gridreg.ablation.records import RunResult, RunSpec, Study

if TYPE_CHECKING:
    from gridreg.ablation.processes import Processes
    from gridreg.ablation.ray_runner import RayRunner
    from gridreg.ablation.runners import InProcess
    from gridreg.ablation.store import Store
    from gridreg.ablation.study import load_study

__all__ = ["InProcess", "Processes", "RayRunner", "RunResult", "RunSpec", "Store", "Study", "load_study"]

# What trains brings the whole training room along, so it is imported when it is first asked for.
_LATER = {
    "InProcess": "runners",
    "Processes": "processes",
    "RayRunner": "ray_runner",
    "Store": "store",
    "load_study": "study",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
