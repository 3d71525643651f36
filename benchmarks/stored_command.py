"""How a result says which command made it."""

from __future__ import annotations

import sys
from pathlib import Path


def stored_command(program: str) -> list[str]:
    """The words of this command line, with places on this machine as ``DIR``.

    Args:
        program: such as ``benchmarks/bodies.py``.
    """
    return [program, *("DIR" if Path(word).is_absolute() else word for word in sys.argv[1:])]
