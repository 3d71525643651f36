"""Settings of every test: Hypothesis draws the same examples every time, without a deadline."""

from __future__ import annotations

import os

import torch
from hypothesis import settings

settings.register_profile("gridreg", deadline=None, derandomize=True, max_examples=50, database=None)
settings.load_profile("gridreg")

# Several test processes beside each other must not each ask for all processors.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)
