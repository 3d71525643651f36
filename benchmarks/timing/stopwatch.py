"""Seconds by stage: a stopwatch that stands in for functions for as long as it watches."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import torch

import gridreg.training.trainer as trainer_module
from gridreg import ops
from gridreg.ops.cpu import cp, lookups, vm_gradient
from gridreg.ops.cpu.mlp import fused as perceptron
from gridreg.rendering import render
from gridreg.training import Trainer

#: In the order of an iteration. What no stage accounts for is ``rest``: the loss, learning rates, the report.
STAGES = (
    "rays",
    "march",
    "density",
    "colour",
    "compositing",
    "penalties",
    "backward",
    "optimiser",
    "rest",
)


class Place(NamedTuple):
    """A function that belongs to a stage.

    Args:
        owner: an object, a class or a module.
        name: of the attribute that is called.
        stage: ``stage`` or ``stage/part``.
    """

    owner: Any
    name: str
    stage: str


class Stopwatch:
    """Adds up the seconds of stages. A stage that is called from within another one stops that one's clock.

    Only the thread that trains may call watched functions.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """The same function; its time without that of stages within it counts for ``stage``."""

        @functools.wraps(function)
        def run(*arguments: Any, **options: Any) -> Any:
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                took = time.perf_counter() - began
                self.seconds[stage] += took - self._inner.pop()
                if self._inner:
                    self._inner[-1] += took

        return run

    @contextmanager
    def watching(self, places: Iterable[Place]) -> Iterator[Stopwatch]:
        """Stand in for the functions at ``places``; afterwards all is as it was."""
        with ExitStack() as stack:
            for owner, name, stage in places:
                stack.enter_context(replaced(owner, name, self.timed(getattr(owner, name), stage)))
            yield self

    def by_stage(self) -> dict[str, float]:
        """Seconds of each of `STAGES`, parts added up."""
        found = dict.fromkeys(STAGES, 0.0)
        for name, seconds in self.seconds.items():
            found[name.partition("/")[0]] += seconds
        return found


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Let something else stand under a name for a while."""
    own = vars(owner)
    had, before = name in own, own.get(name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if had:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


def places_of(trainer: Trainer) -> list[Place]:
    """Return where the stages of a trainer's iteration begin and end, on the compiled and on the plain path."""
    field, handle = trainer.field, trainer.handle
    found = [
        Place(trainer.bank, "draw", "rays"),
        Place(render, "box_intersection", "rays"),
        Place(ops.march, "compiled", "march"),
        Place(ops.march, "reference", "march"),
        Place(lookups, "mark", "march"),
        Place(field, _first(field, "march_density", "density"), "density"),
        Place(field, _first(field, "colour_of_rays", "colour"), "colour/network"),
        Place(ops, "vm_features", "colour/lookup"),
        Place(ops, "cp_features", "colour/lookup"),
        # All of the rendering that is neither of the above: weights, sums along rays, packing.
        Place(trainer_module, "render_rays", "compositing"),
        Place(torch.Tensor, "backward", "backward/other"),
        Place(vm_gradient, "density_backward", "backward/density"),
        Place(cp, "density_backward", "backward/density"),
        Place(vm_gradient, "features_backward", "backward/lookup"),
        Place(cp, "features_backward", "backward/lookup"),
        Place(perceptron, "gradients", "backward/network"),
        Place(trainer.optimizer, "step", "optimiser"),
    ]
    hooks = ("step", "update_groups", "background", "near_far", "on_samples", "loss", "grid_terms")
    return found + [Place(handle, name, "penalties") for name in hooks]


def _first(field: Any, fused: str, otherwise: str) -> str:
    """The way that the renderer takes."""
    return fused if getattr(field, fused, None) is not None else otherwise


def watched_step(trainer: Trainer) -> tuple[float, Stopwatch]:
    """One iteration: its seconds from outside, and the stopwatch with the stages inside it."""
    watch = Stopwatch()
    with watch.watching(places_of(trainer)):
        step = watch.timed(trainer.train_step, "rest")
        began = time.perf_counter()
        step()
        whole = time.perf_counter() - began
    return whole, watch
