"""Do the runs of a study that are missing, here or on a cluster, and write the table and the report.

python examples/ablation.py study.yaml --out DIR --runner processes --workers 2 --threads 1 --report
"""

from __future__ import annotations

import sys

import tyro

from gridreg.ablation.command import AblationOptions, run
from gridreg.errors import InputError

if __name__ == "__main__":
    try:
        sys.exit(run(tyro.cli(AblationOptions)))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
