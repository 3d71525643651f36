"""Settings of every test: Hypothesis draws the same examples every time and has no deadline on a busy machine."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("gridreg", deadline=None, derandomize=True, max_examples=50, database=None)
settings.load_profile("gridreg")
