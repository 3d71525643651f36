"""Runs that are killed, gone on with, and compared with what nobody killed, byte by byte."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch._dynamo
from PIL import Image

import backbones  # noqa: F401
import gridreg.export.runs
from gridreg.ablation.store import Store
from gridreg.cli import main as gridreg_main
from gridreg.errors import InputError
from gridreg.training.checkpoint import has_checkpoint, load_checkpoint
from timing.moments import Moments

# What a run imports late is imported here once, not in each of the forked processes.
Image.init()

# Told apart in every run: seconds, dates, commands.
PASSING = {"seconds", "command", "date", "machine", "started", "ended", "versions"}


def in_child(act: Callable[[], int], log: Path) -> int:
    """Run something in a forked process, which has everything imported; returns its exit status."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            with log.open("ab", buffering=0) as stream:
                os.dup2(stream.fileno(), 1)
                os.dup2(stream.fileno(), 2)
            status = act()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def small_drawings() -> None:
    """Let the mesh and the video of a run be small; whoever writes them is the same."""
    write_mesh, video_path = gridreg.export.runs.write_mesh, gridreg.export.runs.video_path
    gridreg.export.runs.write_mesh = lambda *a, **k: write_mesh(*a, **k, resolution=16, threshold=1e-3)
    gridreg.export.runs.video_path = lambda model, views, **k: video_path(model, views, frames=3, width=16)


def end_of_run(out: Path) -> dict[str, Any]:
    """Return all that a finished run leaves, by name; images and files by their bytes."""
    found: dict[str, Any] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_dir() or name.startswith("checkpoint/"):
            continue
        if path.suffix in (".json", ".jsonl"):
            lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
            found[name] = [lasting(json.loads(line)) for line in lines]
        elif name == "curves.png" or name.endswith(("log.txt", ".html")):
            # Curves are drawn over seconds.
            found[name] = "is there"
        else:
            found[name] = path.read_bytes()
    if has_checkpoint(out / "checkpoint"):
        saved = load_checkpoint(out / "checkpoint")
        found["checkpoint"] = lasting({"state": saved.state, "config": saved.config})
    return found


def end_of_study(out: Path) -> dict[str, Any]:
    """Return the results of a study, and how often each of its runs has ended."""
    store = Store.open(out, create=False)
    ended = Counter(attempt["hash"] for attempt in store.attempts() if attempt["outcome"] == "done")
    runs = {result.spec.hash: lasting(result.metrics) for result in store.results()}
    folders = {hash: end_of_run(store.run_folder(hash)) for hash in runs}
    hidden = [path.name for path in out.rglob(".*") if path.name != ".writer"]
    return {"runs": runs, "ended": dict(ended), "folders": folders, "hidden": hidden}


def lasting(value: Any) -> Any:
    """Return plain data without what differs in every run; tensors as their type, shape and bytes."""
    if isinstance(value, dict):
        return {key: lasting(inner) for key, inner in value.items() if key not in PASSING}
    if isinstance(value, (list, tuple)):
        return [lasting(inner) for inner in value]
    if isinstance(value, torch.Tensor):
        return (
            str(value.dtype),
            tuple(value.shape),
            value.contiguous().view(-1).view(torch.uint8).numpy().tobytes(),
        )
    return value


def differences(one: Any, two: Any, name: str = "") -> list[str]:
    """Return the places where two ends differ."""
    if isinstance(one, dict) and isinstance(two, dict):
        keys = sorted({*one, *two}, key=str)
        return [
            place
            for key in keys
            for place in differences(one.get(key, "nothing"), two.get(key, "nothing"), f"{name}/{key}")
        ]
    return [] if one == two else [name]


def what_stands(out: Path) -> str:
    """Return what a kill has damaged, nothing if all that stands under its name is whole."""
    try:
        if has_checkpoint(out / "checkpoint"):
            load_checkpoint(out / "checkpoint")
        for name in ("metrics.json", "history.jsonl"):
            if (out / name).exists():
                [json.loads(line) for line in [(out / name).read_text()] if name.endswith("json")]
        if (out / "mesh.ply").exists():
            gridreg.export.read_mesh(out / "mesh.ply")
    except (InputError, ValueError) as error:
        return str(error)
    return ""


class Trial:
    """A command, what it leaves, and its moments.

    Args:
        name: ``train`` or ``study``.
        folder: for its outputs.
        words: of the command, for an output folder.
        end: of an output folder.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        words: Callable[[Path], list[str]],
        end: Callable[[Path], dict[str, Any]],
    ) -> None:
        self.name, self.folder, self.words, self.end = name, folder, words, end
        self.log = folder / "log.txt"
        # Kernels are compiled before anything is compared: code that a process has compiled itself may add in another
        # order than what it finds compiled.
        self.run(folder / "warm")
        whole = folder / "whole"
        status = self.run(whole, folder / "moments.txt")
        if status:
            raise InputError(f"{name}: ended with {status}: {self.log.read_text()[-400:]}")
        self.whole = end(whole)
        self.moments = [tuple(line.split("\t")) for line in (folder / "moments.txt").read_text().splitlines()]

    def run(self, out: Path, note: Path | None = None, die_at: int | None = None) -> int:
        """Run the command; returns its exit status."""
        words = self.words(out)

        def act() -> int:
            small_drawings()
            Moments(out, note, die_at).install()
            return gridreg_main(words)

        return in_child(act, self.log)

    def kill(self, moment: int) -> str:
        """Kill a run at a moment, go on, and return what is wrong with its end; nothing if it is the same."""
        out = self.folder / "broken"
        shutil.rmtree(out, ignore_errors=True)
        status = self.run(out, die_at=moment)
        if status != -signal.SIGKILL:
            return f"was not killed (exit status {status})"
        return what_stands(out) or self.go_on(out)

    def go_on(self, out: Path) -> str:
        """Go on with a run, and return what is wrong with its end; nothing if it is the same."""
        status = self.run(out)
        if status:
            return f"did not go on (exit status {status}): {self.log.read_text()[-200:]}"
        return self.compare(out)

    def compare(self, out: Path) -> str:
        """Return where the end of a run differs; nothing if it is the same."""
        places = differences(self.whole, self.end(out))
        return f"differs in {', '.join(places[:5])}" if places else ""


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[str]:
    """A disk of so many KB in a folder; says which kind."""
    folder.mkdir(parents=True, exist_ok=True)
    size = f"size={kilobytes}k"
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)], capture_output=True)
    if done.returncode == 0:
        try:
            yield "tmpfs"
        finally:
            subprocess.run(["umount", str(folder)], check=False)
        return
    yield "RLIMIT_FSIZE"
