"""A program of the user's as a run of a study: started with the run's values, its score read from a file."""

from __future__ import annotations

import json
import math
import shlex
import shutil
import string
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gridreg.ablation.records import RunSpec
from gridreg.errors import ConfigError, InputError
from gridreg.training import RunConfig
from gridreg.training.config import save_yaml
from gridreg.training.files import check_output_folder, output_errors
from gridreg.training.progress import interruptible
from gridreg.training.typed_data import from_data

VALUES = ("label", "scene", "protocol", "views", "seed", "steps", "out", "config")
"""What a command may ask for, each in braces: ``{config}`` is a YAML file with the run's configuration, its composition
as `gridreg.from_config` reads it; ``{out}`` the folder where ``metrics.json`` is expected."""


def words_of(command: str) -> tuple[str, ...]:
    """The words of a command, each with the braces that a run fills.

    Raises:
        ConfigError: if it has none, an open quote, or braces that name nothing.
    """
    try:
        words = tuple(shlex.split(command))
        names = [
            name for word in words for _, name, _, _ in string.Formatter().parse(word) if name is not None
        ]
    except ValueError as error:
        raise ConfigError(("command",), f"found {command!r}: {error}") from error
    unknown = [name for name in names if name not in VALUES]
    if not words or unknown:
        found = f"{{{unknown[0]}}}" if unknown else "nothing"
        known = ", ".join(f"{{{name}}}" for name in VALUES)
        raise ConfigError(("command",), f"found {found}, expected a program and of braces {known}")
    return words


def run_command(spec: RunSpec, folder: Path, watch: Callable[[], None]) -> dict[str, Any] | None:
    """Run the command of a run in the current folder until it ends.

    Args:
        spec: the run.
        folder: its folder, which gets ``config.yaml``.
        watch: called several times a second.

    Returns:
        Its metrics; None if somebody stopped it.

    Raises:
        InputError: if it cannot be started, fails, or leaves no ``metrics.json`` with a ``psnr``.
    """
    check_output_folder(folder)
    config, target = folder / "config.yaml", folder / "metrics.json"
    whole = from_data(RunConfig, spec.config, source=spec.describe())
    save_yaml(config, whole)
    target.unlink(missing_ok=True)
    scene, paths = spec.scene or "builtin", {"out": folder.resolve(), "config": config.resolve()}
    known = {"label": spec.label, "scene": scene, "protocol": spec.protocol, "views": spec.views}
    values: dict[str, Any] = {**known, **paths, "seed": spec.seed, "steps": whole.train.steps}
    words = [word.format(**values) for word in spec.command]
    began = time.perf_counter()
    log = folder / "log.txt"
    if shutil.which(words[0]) is None:
        raise InputError(f"command: found {words[0]!r}, expected a program that can be started")
    with output_errors(log), log.open("ab") as stream:
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream)
    with interruptible() as interruption:
        try:
            while process.poll() is None and not interruption.requested:
                watch()
                time.sleep(0.2)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    if interruption.requested:
        return None
    if process.returncode:
        raise InputError(f"command {words[0]!r}: ended with status {process.returncode}; see {log}")
    return _metrics(target, time.perf_counter() - began)


def _metrics(path: Path, seconds: float) -> dict[str, Any]:
    """Metrics as `gridreg.training.execute` writes them, or plain numbers by name."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        mean = found.get(
            "mean", {key: value for key, value in found.items() if not isinstance(value, (dict, list))}
        )
        scores = {name: float(value) for name, value in mean.items()}
        times = {name: float(value) for name, value in found.get("seconds", {"train": seconds}).items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f'{path}: no metrics, expected JSON such as {{"psnr": 27.1}}: {error}') from error
    if not math.isfinite(scores.get("psnr", math.nan)):
        raise InputError(f"{path}: found {', '.join(scores) or 'nothing'}, expected a number 'psnr' (dB)")
    return {**found, "mean": scores, "images": found.get("images", {}), "seconds": times}
