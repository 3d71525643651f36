"""The program: read a study, do what is missing, and write tables and the report."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from gridreg.ablation.processes import Processes
from gridreg.ablation.progress import StudyProgress, dry_run_lines
from gridreg.ablation.records import RunResult, Study
from gridreg.ablation.runners import InProcess, Runner
from gridreg.ablation.store import Store
from gridreg.ablation.study import load_study
from gridreg.errors import InputError, near_names
from gridreg.machine import DeviceName, choose_device, usable_cores


@dataclass
class AblationOptions:
    """Do the runs of a study that are missing in its store, and write tables and a report."""

    study: tyro.conf.Positional[Path | None] = None
    """YAML file of the study."""
    example: str | None = None
    """Name of a study that comes with gridreg, instead of a file, such as smoke."""
    out: Path | None = None
    """Folder of the store; default: outputs/NAME. What is finished there is not done again."""
    runner: Literal["local", "processes", "ray"] = "local"
    """One run after another in this process, several processes, or a Ray cluster."""
    workers: int | None = None
    """Runs at a time; default: as many as the cores hold with --threads each."""
    threads: int | None = None
    """Processor threads of each run; default: all with `local`, 1 otherwise."""
    device: DeviceName = "cpu"
    """Where runs compute, with `local` and `processes`; auto: a GPU where there is one."""
    address: str | None = None
    """Address of the Ray cluster: auto, or HOST:PORT; without it, one is started on this machine."""
    ship_scenes: bool = False
    """Send the views to Ray's workers instead of letting them find the scenes by path."""
    dry_run: bool = False
    """Print the runs and an estimate of their time, and end."""
    retry_failed: bool = False
    """Do failed runs again."""
    keep_checkpoints: bool = True
    """Leave the checkpoints of finished runs in their folders."""
    export: Path | None = None
    """Write the results to a .csv or .parquet file."""
    report: bool = False
    """Write report.html into the folder of the store."""


def run(options: AblationOptions) -> int:
    """Do it.

    Returns:
        0 if every run is done, 1 if some failed, 130 after Ctrl-C.

    Raises:
        InputError: for a study, store or runner that cannot be used; what is finished stays.
    """
    study = load_study(_study_file(options))
    out = options.out or Path("outputs") / study.name
    if options.dry_run:
        _print_runs(study, out, options)
        return 0
    if options.export is not None and options.export.suffix not in (".csv", ".parquet"):
        raise InputError(f"--export: found {options.export}, expected a name that ends in .csv or .parquet")
    runner = make_runner(options)
    store = Store.open(out)
    store.add(study)
    if options.retry_failed:
        print(f"failed runs that are tried again: {store.retry(study)}", file=sys.stderr)
    interrupted = False
    progress = StudyProgress(store.results(study))
    print(f"{study.title}: {progress.describe()} runs done; the store is {out}", file=sys.stderr, flush=True)
    try:
        runner.run(store, study, progress)
    except KeyboardInterrupt:
        interrupted = True
        print("stopped; the same command goes on from here", file=sys.stderr)
    return _conclude(store, study, options, interrupted)


def _study_file(options: AblationOptions) -> Path:
    """The file of the study; an example is installed beside this file, or in ``examples/studies`` of a checkout."""
    if (options.study is None) == (options.example is None):
        found = "nothing" if options.study is None else "both"
        raise InputError(f"study: found {found}, expected a YAML file, or --example NAME")
    if options.study is not None:
        return options.study
    folder = Path(__file__).parent / "studies"
    folder = folder if folder.is_dir() else Path(__file__).parents[2] / "examples" / "studies"
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if options.example not in names:
        near = near_names(options.example, names)
        raise InputError(f"--example: found {options.example!r}, expected one of {', '.join(names)}{near}")
    return folder / f"{options.example}.yaml"


def make_runner(options: AblationOptions) -> Runner:
    """The runner that the options ask for.

    Raises:
        InputError: for numbers below 1, options of another runner, or Ray if it is not installed.
    """
    for name in ("workers", "threads"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InputError(f"--{name}: found {value}, expected at least 1")
    if options.runner != "ray" and (options.address is not None or options.ship_scenes):
        name = "--address" if options.address is not None else "--ship-scenes"
        raise InputError(f"{name}: found with --runner {options.runner}, expected --runner ray")
    device = str(choose_device(options.device))
    if options.runner == "ray" and device != "cpu":
        raise InputError(f"--device: found {device} with --runner ray, expected cpu there")
    if options.runner == "local":
        if options.workers not in (None, 1):
            raise InputError(
                f"--workers: found {options.workers} with --runner local, expected --runner processes"
            )
        return InProcess(options.threads, options.keep_checkpoints, device)
    if options.runner == "processes":
        return Processes(options.workers, options.threads or 1, options.keep_checkpoints, device)
    from gridreg.ablation.ray_runner import RayRunner

    return RayRunner(
        address=options.address,
        workers=options.workers,
        threads=options.threads or 1,
        ship_scenes=options.ship_scenes,
        keep_checkpoints=options.keep_checkpoints,
    )


def _print_runs(study: Study, out: Path, options: AblationOptions) -> None:
    """Print the runs and an estimate of their time; nothing is written."""
    stored = Store.open(out, create=False).results() if (out / "store.sqlite").is_file() else []
    known = {result.spec.hash: result for result in stored}
    results = [
        replace(known[spec.hash], spec=spec)
        if spec.hash in known
        else RunResult(spec, "waiting", None, "", out, 0.0, "")
        for spec in study.runs
    ]
    workers = options.workers or (
        1 if options.runner == "local" else usable_cores() // (options.threads or 1)
    )
    print(f"{study.title}: {len(study.labels)} rows, compared with {study.baseline!r}")
    print("\n".join(dry_run_lines(results, max(1, workers))))


def _conclude(store: Store, study: Study, options: AblationOptions, interrupted: bool) -> int:
    counts = store.counts(study)
    shown = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    print(f"{study.title}: {shown}")
    for result in store.results(study):
        if result.status == "failed":
            print(f"failed: {result.spec.describe()}: {result.reason}", file=sys.stderr)
    if options.export is not None:
        print(f"table: {store.export(options.export, study)}")
    if options.report:
        from gridreg.ablation.report import write_report

        path = store.folder / "report.html"
        write_report(store, study, path)
        print(f"report: {path}")
    if interrupted:
        return 130
    return 1 if counts["failed"] else 0
