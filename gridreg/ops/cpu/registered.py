"""Imports all compiled versions, which register themselves."""

from __future__ import annotations

from gridreg.ops.cpu import composite, lookups, march, merging
from gridreg.ops.cpu.adam import step
from gridreg.ops.cpu.mlp import fused

__all__ = ["composite", "fused", "lookups", "march", "merging", "step"]
