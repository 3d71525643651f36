"""Types of options as ``--help`` shows them: an optional one by what it holds, its default in words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["Checkpoint", "OptionalFile", "OptionalFloat", "OptionalFolder", "OptionalInt", "OptionalText"]

Checkpoint = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
"""Output folder of a run, or its checkpoint."""
# The hint is left out because it could only say "None": the text of each option says what holds without it.
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")]
OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
