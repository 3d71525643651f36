"""Time, memory and roofline of training and rendering on a processor; tables on the screen, JSON in results/speed.

    python benchmarks/speed.py COMMAND [OPTIONS]
    python benchmarks/speed.py step --scene DIR
    python benchmarks/speed.py table

The code is in the folder of the same name; docs/speed.md explains the commands.
"""

from __future__ import annotations

import sys
from pathlib import Path

# A folder with an __init__.py comes before a file of the same name.
sys.path.insert(0, str(Path(__file__).parent))
from speed.main import main

from gridreg.cli import run_cli

if __name__ == "__main__":
    sys.exit(run_cli(main))
