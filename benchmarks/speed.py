"""Time, memory and roofline of training and rendering on a processor; figures are kept in results/speed.jsonl.

    python benchmarks/speed.py COMMAND [OPTIONS]
    python benchmarks/speed.py step --scene DIR
    python benchmarks/speed.py table

The code is in the folder timing; docs/speed.md explains the commands.
"""

from __future__ import annotations

from timing.main import main

from gridreg.cli import run_cli

if __name__ == "__main__":
    raise SystemExit(run_cli(main))
