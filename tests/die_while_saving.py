"""Saves checkpoints in child processes that die at every operation in turn, then at random moments.

Run by test_checkpoint.py in a process of its own, because forking a process that has threads is not safe.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from gridreg.training.checkpoint import load_checkpoint, save_checkpoint

FOLDER = Path(sys.argv[1]) / "checkpoint"
OPERATIONS = [
    (os, ("rename", "replace", "fsync", "unlink", "rmdir")),
    (Path, ("mkdir", "write_bytes")),
    (safetensors.torch, ("save_file",)),
]
DEAD = 9


def save(step: int) -> None:
    """A checkpoint whose every part tells its step."""
    save_checkpoint(FOLDER, {"step": step, "x": torch.full((1000,), float(step))})


def check() -> int:
    """The step of the checkpoint that a reader finds, which must be whole."""
    state = load_checkpoint(FOLDER).state
    assert torch.equal(state["x"], torch.full((1000,), float(state["step"])))
    return int(state["step"])


def save_and_die(operation: int, step: int) -> None:
    """Save, but die before the given operation on the file system, a write half-way through."""
    left = operation

    def dying(function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                if function is write_bytes:
                    function(arguments[0], arguments[1][: len(arguments[1]) // 2])
                if function is save_file:
                    function(*arguments)
                    os.truncate(arguments[1], os.path.getsize(arguments[1]) // 2)
                os._exit(DEAD)
            return function(*arguments, **options)

        return wrapper

    write_bytes, save_file = Path.write_bytes, safetensors.torch.save_file
    for owner, names in OPERATIONS:
        for name in names:
            setattr(owner, name, dying(getattr(owner, name)))
    save(step)


def in_child(function: Callable[..., None], *arguments: Any) -> int:
    """Run a function in a forked process; its process number."""
    child = os.fork()
    if child == 0:
        try:
            function(*arguments)
        except BaseException as error:
            print(repr(error), file=sys.stderr)
            os._exit(1)
        os._exit(0)
    return child


def die_everywhere() -> tuple[int, int]:
    """Numbers of operations died at, and of deaths after which the new checkpoint was the one found."""
    step, operation, found_new, status = 0, 0, 0, DEAD
    save(step)
    survivor = check()
    while status == DEAD:
        # Twice in a row, so that a save also starts from what a death left behind.
        for _ in range(2):
            step += 1
            status = os.waitstatus_to_exitcode(os.waitpid(in_child(save_and_die, operation, step), 0)[1])
            assert status in (0, DEAD), status
            before, survivor = survivor, check()
            assert survivor in (before, step), (before, survivor, step)
            found_new += status == DEAD and survivor == step
        operation += 1
    assert survivor == step
    save(step + 1)
    assert check() == step + 1
    assert [path.name for path in FOLDER.parent.iterdir()] == ["checkpoint"]
    return operation, found_new


def save_for_ever() -> None:
    """Save without a pause."""
    step = 0
    while True:
        save(step)
        step += 1


def kill_at_random(times: int) -> None:
    """SIGKILL a saving process at random moments; whatever is left must be whole."""
    moments = random.Random(0)
    for _ in range(times):
        child = in_child(save_for_ever)
        time.sleep(moments.uniform(0.005, 0.05))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        check()


if __name__ == "__main__":
    print("{} operations, the new one found after {} deaths".format(*die_everywhere()))
    kill_at_random(12)
    print("12 kills")
