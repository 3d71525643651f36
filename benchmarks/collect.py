"""Copy the finished runs of a study out of its store, as small JSON files that stay with the project.

    python benchmarks/collect.py outputs/best_search best_search

writes `benchmarks/results/STUDY/SCENE-LABEL-seedN.json`: the run's metrics, the row's label, the study's baseline.
Names of machines and places of files stay behind. `docs/make_results.py` reads what it shows from there.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from gridreg.ablation import Store
from gridreg.cli import run_cli
from gridreg.training.files import write_json

RESULTS = Path(__file__).parent / "results"


def collect(folder: Path, name: str, results: Path = RESULTS) -> list[Path]:
    """Write a file for every finished run of a study, and return them.

    Args:
        folder: of the store.
        name: of the study.
        results: where the study gets a folder of its own.

    Raises:
        InputError: for a store or a study that is not there.
    """
    store = Store.open(folder, create=False)
    study = store.study(name)
    written = []
    for run in store.results(study):
        if run.metrics is None:
            continue
        spec = run.spec
        label = re.sub(r"[^\w.]+", "_", spec.label).strip("_")
        record = {
            **run.metrics,
            "config": {**run.metrics["config"], "scene": spec.scene_name},
            "label": spec.label,
            "baseline": study.baseline,
            "command": ["examples/ablation.py", f"examples/studies/{name}.yaml"],
        }
        path = results / name / f"{spec.scene_name}-{label}-seed{spec.seed}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, record)
        written.append(path)
    return written


def main() -> int:
    """Parse the command line, and say what was written."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", type=Path, help="folder that an ablation has written")
    parser.add_argument("study", help="its name in the store")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the study's own")
    arguments = parser.parse_args()
    written = collect(arguments.store, arguments.study, arguments.results)
    print(f"{len(written)} runs of {arguments.study} in {arguments.results / arguments.study}")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
