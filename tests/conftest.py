"""Settings of every test: Hypothesis draws the same examples every time, without a deadline."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("gridreg", deadline=None, derandomize=True, max_examples=50, database=None)
settings.load_profile("gridreg")
