"""Workers that share a store and are killed at random, forked by a process of their own that has no threads.

python tests/ablation_writers.py STORE KILLS
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from gridreg.ablation.store import Store
from gridreg.ablation.workers import Worker
from tests.ablation_runs import metrics


def work(folder: str) -> None:
    """Claim and finish runs until nobody has any."""
    store, worker = Store.open(folder, create=False), Worker.current()
    while True:
        claim = store.claim(worker)
        if claim is not None:
            claim.folder.mkdir(parents=True, exist_ok=True)
            with (claim.folder / "begun.txt").open("a") as log:
                log.write("once\n")
            store.finish(claim, metrics(float(claim.spec.seed)))
        elif store.counts()["running"] == 0:
            return


def fork(folder: str) -> int:
    child = os.fork()
    if child == 0:
        try:
            work(folder)
        except BaseException as error:
            print(repr(error), file=sys.stderr)
            os._exit(1)
        os._exit(0)
    return child


def main(folder: str, kills: int) -> None:
    moments = random.Random(0)
    children = [fork(folder) for _ in range(3)]
    for _ in range(kills):
        time.sleep(moments.uniform(0.01, 0.05))
        victim = children.pop(0)
        os.kill(victim, signal.SIGKILL)
        os.waitpid(victim, 0)
        children.append(fork(folder))
    for child in children:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert status == 0, status


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
