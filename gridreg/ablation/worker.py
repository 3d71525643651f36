"""A worker process: does runs of a study in a store until none is left.

    python -m gridreg.ablation.worker --store DIR --study NAME --threads 1

`gridreg.ablation.processes` starts these; they may be started by hand as well, on every machine that sees the folder.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Sequence

EXIT_DISK_FULL = 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Work; returns 0 when there is nothing left to do, 130 when told to stop, 2 for bad input, 3 for a full disk."""
    parser = argparse.ArgumentParser(description="Do the runs of a study that wait in a store.")
    parser.add_argument("--store", required=True, help="folder of the store")
    parser.add_argument("--study", required=True, help="name of the study in it")
    parser.add_argument("--threads", type=int, default=1, help="processor threads")
    parser.add_argument("--device", default="cpu", help="where to compute")
    parser.add_argument("--no-checkpoints", action="store_true", help="remove those of finished runs")
    parser.add_argument("--end-with-input", action="store_true", help="stop when standard input ends")
    options = parser.parse_args(arguments)
    if options.end_with_input:
        # Whoever started this process holds the other end; when it dies, however it dies, the pipe ends.
        threading.Thread(target=_stop_with_input, name="input", daemon=True).start()
    # After the thread has started: these take seconds, in which a parent may die.
    from gridreg.ablation.database import DiskFullError
    from gridreg.ablation.runners import InProcess
    from gridreg.ablation.store import Store
    from gridreg.errors import InputError
    from gridreg.fields import import_modules

    try:
        store = Store.open(options.store, create=False)
        study = store.study(options.study)
        import_modules(study.modules, study.name)
        runner = InProcess(max(1, options.threads), not options.no_checkpoints, options.device, log=True)
        runner.run(store, study, lambda event: None)
    except KeyboardInterrupt:
        return 130
    except InputError as error:
        # Where the disk is full, so is the log that this may go to.
        with contextlib.suppress(OSError):
            print(f"error: {error}", file=sys.stderr)
        return EXIT_DISK_FULL if isinstance(error, DiskFullError) else 2
    return 0


def _stop_with_input() -> None:
    # Not through sys.stdin, whose lock a thread must not hold when the interpreter ends.
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
