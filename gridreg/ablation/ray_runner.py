"""Runs on a Ray cluster: workers share nothing with the store, they get a run and send back the files of its folder."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

from gridreg.ablation.claims import Claim, ClaimLostError, heartbeat
from gridreg.ablation.perform import Scenes, TaskResult, is_disk_full, scene_key
from gridreg.ablation.ray_cluster import connected, import_ray
from gridreg.ablation.ray_task import Task, read_folder, run_task, write_folder
from gridreg.ablation.records import Study
from gridreg.ablation.runners import Event, Kind, Report, settle
from gridreg.ablation.store import Store
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.machine import usable_cores
from gridreg.training.progress import Interruption, interruptible

_POLL = 0.5
_SAVING_SECONDS = 60.0


@dataclass(frozen=True)
class RayRunner:
    """Runs as Ray tasks, each of which declares ``threads`` processors.

    A run whose worker or node is lost goes to another one. What a worker computes comes back through this process, so
    nothing but Ray connects the machines; gridreg must be installed on all of them in the same version.

    Arguments: as the options of `gridreg ablate`. By default there are as many workers as the cluster has processors
    for, and a scene is found at its path, or by its name below the folder that GRIDREG_DATA names on that machine.

    Raises:
        InputError: if Ray is not installed.
    """

    address: str | None = None
    workers: int | None = None
    threads: int = 1
    ship_scenes: bool = False
    keep_checkpoints: bool = True

    def __post_init__(self) -> None:
        import_ray(self.address)

    def run(self, store: Store, study: Study, report: Report) -> None:
        """See `gridreg.ablation.runners.Runner.run`."""
        count = self.workers or max(1, usable_cores() // self.threads)
        with connected(self.address, cpus=count * self.threads) as ray:
            queue = _Queue(self, ray, store, study, report)
            # Inside the connection, because connecting installs handlers of Ray's.
            with interruptible() as interruption, heartbeat(store.beat, queue.pending.values()):
                queue.work(interruption)
        if interruption.requested:
            raise KeyboardInterrupt


class _Queue:
    """Hands out runs and takes results in."""

    def __init__(self, runner: RayRunner, ray: Any, store: Store, study: Study, report: Report) -> None:
        self.runner, self.ray, self.store, self.study, self.report = runner, ray, store, study, report
        self.worker = Worker.current()
        self.pending: dict[Any, Claim] = {}
        self.scenes = Scenes(store.folder / "scenes")
        self.shipped: dict[tuple[Any, ...], Any] = {}
        # Retries are the store's business: it knows what is finished, and keeps the checkpoint.
        self.task = ray.remote(num_cpus=runner.threads, max_retries=0)(_remote)

    def work(self, interruption: Interruption) -> None:
        """Until nothing is left, or somebody asks to stop."""
        try:
            while not interruption.requested:
                self._hand_out()
                if self.pending:
                    self._take_in(_POLL)
                elif self.store.counts(self.study)["running"] == 0:
                    return
                else:
                    time.sleep(_POLL)
        finally:
            self._stop()

    def _hand_out(self) -> None:
        while len(self.pending) < self._capacity():
            claim = self.store.claim(self.worker, self.study)
            if claim is None:
                return
            self.report(Event("started", claim.spec))
            runner, modules = self.runner, self.study.modules
            try:
                files = read_folder(claim.folder)
                scene = self._ship(claim) if runner.ship_scenes else []
            except InputError as error:
                settle(self.store, claim, TaskResult(reason=str(error)), self.report)
                continue
            task = Task(claim.spec.to_json(), files, runner.threads, runner.keep_checkpoints, modules)
            self.pending[self.task.remote(task, scene)] = claim

    def _capacity(self) -> int:
        """Runs that fit into the cluster as it is now."""
        if self.runner.workers is not None:
            return self.runner.workers
        return max(1, int(self.ray.cluster_resources().get("CPU", 0) // self.runner.threads))

    def _ship(self, claim: Claim) -> list[Any]:
        # In a list, because Ray would fetch a bare reference for the task, even where the scene is known already.
        key = scene_key(claim.spec)
        if key not in self.shipped:
            self.shipped[key] = self.ray.put(self.scenes.get(claim.spec))
        return [self.shipped[key]]

    def _take_in(self, seconds: float) -> None:
        ready, _ = self.ray.wait(list(self.pending), num_returns=1, timeout=seconds)
        for reference in ready:
            claim = self.pending.pop(reference)
            try:
                self._take(claim, reference)
            except ClaimLostError:
                self.report(Event("lost", claim.spec))

    def _take(self, claim: Claim, reference: Any) -> None:
        errors = self.ray.exceptions
        try:
            result: TaskResult = self.ray.get(reference)
        except errors.TaskCancelledError:
            result = TaskResult()
        except errors.RayTaskError as error:
            # The task itself catches what a run can raise; this is a worker that cannot even begin.
            result = TaskResult(reason=_line(error))
        except (errors.WorkerCrashedError, errors.OutOfMemoryError) as error:
            self.store.mark_lost(claim, _line(error))
            self.report(Event("lost", claim.spec))
            return
        except errors.RayError as error:
            # A node that went away is no fault of the run's.
            print(f"{claim.spec.describe()}: {_line(error)}", file=sys.stderr)
            self._give_back(claim, "lost")
            return
        if result.files and self.store.beat(claim):
            try:
                write_folder(result.files, claim.folder)
            except InputError as error:
                result = TaskResult(reason=str(error), disk_full=is_disk_full(error))
        settle(self.store, claim, result, self.report)

    def _give_back(self, claim: Claim, outcome: Kind) -> None:
        self.store.release(claim, outcome)
        self.report(Event(outcome, claim.spec))

    def _stop(self) -> None:
        """Ask the workers to save, and take in what they send; the rest waits in the store."""
        for reference in self.pending:
            self.ray.cancel(reference, force=False)
        end = time.monotonic() + _SAVING_SECONDS
        try:
            while self.pending and time.monotonic() < end:
                self._take_in(_POLL)
        finally:
            for claim in self.pending.values():
                self._give_back(claim, "interrupted")
            self.pending.clear()


def _remote(task: Task, scene: list[Any]) -> TaskResult:
    import ray

    return run_task(task, (lambda: ray.get(scene[0])) if scene else None)


def _line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0] if lines else 'no reason given'}"
