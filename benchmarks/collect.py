"""Copy the finished runs of a study out of its store, as one file of JSON lines that stays with the project.

    python benchmarks/collect.py outputs/best_search best_search

writes `benchmarks/results/STUDY.jsonl`: of every run its metrics, the row's label, the study's baseline. Names of
machines and places of files stay behind. `docs/make_results.py` reads what it shows from there.
"""

from __future__ import annotations

import re
from pathlib import Path

import stored

from gridreg.ablation import Store
from gridreg.cli import run_cli


def collect(folder: Path, name: str, results: Path = stored.RESULTS) -> list[str]:
    """Store every finished run of a study, and return the names of the records.

    Args:
        folder: of the store.
        name: of the study.
        results: folder of the stored figures.

    Raises:
        InputError: for a store or a study that is not there.
    """
    store = Store.open(folder, create=False)
    study = store.study(name)
    names = []
    for run in store.results(study):
        if run.metrics is None:
            continue
        spec = run.spec
        record = {
            **run.metrics,
            "config": {**run.metrics["config"], "scene": spec.scene_name},
            "label": spec.label,
            "baseline": study.baseline,
            "command": ["examples/ablation.py", f"examples/studies/{name}.yaml"],
        }
        label = re.sub(r"[^\w.]+", "_", spec.label).strip("_")
        names.append(f"{spec.scene_name}-{label}-seed{spec.seed}")
        stored.save(name, names[-1], record, results)
    return names


def main() -> int:
    """Parse the command line, and print how many runs were stored."""
    parser = stored.parser_of(__doc__)
    parser.add_argument("store", type=Path, help="folder that an ablation has written")
    parser.add_argument("study", help="its name in the store")
    arguments = parser.parse_args()
    names = collect(arguments.store, arguments.study, arguments.results)
    print(f"{len(names)} runs in {arguments.results / arguments.study}.jsonl")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
