"""Do the runs of a study that are missing, here or on a cluster, and write the table and the report.

python examples/ablation.py study.yaml --out DIR --runner processes --workers 2 --threads 1 --report
"""

from __future__ import annotations

import sys

import tyro

from gridreg.ablation.command import AblationOptions, run
from gridreg.cli.exit_status import run_cli

if __name__ == "__main__":
    sys.exit(run_cli(lambda: run(tyro.cli(AblationOptions))))
