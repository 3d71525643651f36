"""Imports all compiled versions, which register themselves."""

from __future__ import annotations

from gridreg.ops.cpu import composite, lookups, march, merging
from gridreg.ops.cpu.adam import step

__all__ = ["composite", "lookups", "march", "merging", "step"]
