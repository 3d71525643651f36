"""Ablations: grids of compositions, scenes, view counts and seeds, run here or on many machines, kept in a store."""

from __future__ import annotations

from gridreg.ablation.records import RunResult, RunSpec, Study

__all__ = ["RunResult", "RunSpec", "Study"]
