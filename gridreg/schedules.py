"""Schedules: a number, or a function of the step.

Every numeric argument of a regularizer is a `Numeric`: a plain number, a `Schedule`, or any callable of the
step. Schedules are frozen dataclasses, so they compare by value and go to plain data and back.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from gridreg.errors import InputError


@dataclass(frozen=True)
class Schedule:
    """Base of all schedules: a number that depends on the step."""

    def at(self, step: int, total_steps: int) -> float:
        """Value at `step` (iterations) of a run of `total_steps`."""
        raise TypeError(f"{type(self).__name__} does not define at(step, total_steps)")

    def plot(self, total_steps: int, axes: Any = None) -> Any:
        """Draw the value over a run; return matplotlib's axes, new ones if none are given.

        Raises:
            InputError: matplotlib is not installed.
        """
        axes = drawing_axes(axes)
        steps = drawn_steps(total_steps)
        axes.plot(steps, [resolve(self, step, total_steps) for step in steps])
        axes.set_xlabel("iteration")
        return axes


def drawn_steps(total_steps: int) -> list[int]:
    """Steps of a run that a plot shows: all, or 400 of them."""
    return sorted({round(i * total_steps / 400) for i in range(401)})


def drawing_axes(axes: Any = None) -> Any:
    """The axes, or matplotlib's current ones of a new figure.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        pyplot = importlib.import_module("matplotlib.pyplot")
    except ImportError:
        raise InputError(
            "plot: matplotlib is not installed, expected it (`pip install matplotlib`)"
        ) from None
    return pyplot.subplots(layout="constrained")[1] if axes is None else axes


Numeric: TypeAlias = float | int | Schedule | Callable[[int], float]
"""Type of every numeric argument."""

ScheduleClass = TypeVar("ScheduleClass", bound=type[Schedule])

SCHEDULES: dict[str, type[Schedule]] = {}
"""Schedule classes by name, for configurations."""


def register_schedule(cls: ScheduleClass) -> ScheduleClass:
    """Class decorator: make a schedule known to `gridreg.from_config` under its class name."""
    SCHEDULES[cls.__name__] = cls
    return cls


def end_step(until: Numeric, step: int, total_steps: int) -> int:
    """Step at which something that runs `until` ends: a float is a fraction of `total_steps`, an int a step.

    >>> end_step(0.9, 0, 15_000), end_step(700, 0, 15_000)
    (13500, 700)

    Raises:
        InputError: `until` is not positive, not a number, or a fraction above 1.
    """
    if isinstance(until, int) and not isinstance(until, bool):
        if until <= 0:
            raise InputError(
                f"until={until}: expected a step above 0, or a fraction of total_steps in (0, 1]"
            )
        return until
    fraction = resolve(until, step, total_steps, "until")
    if not 0 < fraction <= 1:
        raise InputError(
            f"until={fraction}: a float is a fraction of total_steps in (0, 1]; write a step as an int"
        )
    # 0.07 * 100 is 7.000000000000001: without rounding, step 7 would still count as before the end.
    return max(1, math.ceil(round(fraction * total_steps, 6)))


def resolve(value: Numeric, step: int, total_steps: int, name: str = "value") -> float:
    """The number that `value` stands for at `step`.

    Args:
        value: a number, a `Schedule`, or a callable of the step.
        step: current step, iterations.
        total_steps: length of the run, iterations.
        name: what to call the argument in an error.

    >>> resolve(0.5, 10, 100), resolve(Linear(0, 1), 10, 100), resolve(lambda step: step / 5, 10, 100)
    (0.5, 0.1, 2.0)

    Raises:
        InputError: the result is not a finite number.
    """
    if isinstance(value, Schedule):
        result = value.at(step, total_steps)
    elif callable(value):
        result = value(step)
    else:
        result = value
    try:
        number = float(result)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}={result!r}: expected a number, a Schedule or a callable of the step"
        ) from None
    if not math.isfinite(number):
        raise InputError(f"{name}={number} at step {step}: expected a finite number")
    return number


def check_numeric(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> None:
    """Refuse at construction what can be refused then: numbers outside [low, high], NaN, and non-numbers.

    Schedules and callables are checked when they are read (`gridreg.base.Context.at`).

    Raises:
        InputError: naming the argument, its value and the range.
    """
    if isinstance(value, Schedule) or (callable(value) and not isinstance(value, type)):
        return
    expected = f"expected a number in [{low:g}, {high:g}], a Schedule or a callable of the step"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{name}={value!r}: {expected}")
    if not low <= value <= high or math.isinf(value):
        raise InputError(f"{name}={value}: {expected}")


def check_until(value: object, name: str = "until") -> None:
    """Refuse ends that are neither a positive step nor a fraction of the run.

    Raises:
        InputError: naming the argument and its value.
    """
    if isinstance(value, (int, float)):
        try:
            end_step(value, 0, 1)
        except InputError as error:
            raise InputError(str(error).replace("until", name, 1)) from None
    check_numeric(name, value)


def fixed_end(until: Numeric, total_steps: int) -> int | None:
    """The step that `until` stands for, or None where that depends on the step itself."""
    if isinstance(until, Schedule) or callable(until):
        return None
    return end_step(until, 0, total_steps)


def _progress(step: int, begin: Numeric, until: Numeric, total_steps: int) -> float:
    """Fraction in [0, 1] of the way from `begin` to `until`."""
    start = 0 if begin == 0 else end_step(begin, step, total_steps)
    end = end_step(until, step, total_steps)
    if step >= end:
        return 1.0
    return max(0.0, (step - start) / (end - start)) if end > start else 0.0


@register_schedule
@dataclass(frozen=True)
class Linear(Schedule):
    """Straight line from `start` to `end`, between the steps `begin` and `until`, constant outside.

    Args:
        start: value up to `begin`.
        end: value from `until` on.
        until: fraction of the run (float) or step (int).
        begin: fraction of the run (float) or step (int).

    >>> [Linear(0.0, 0.2).at(step, 100) for step in (0, 50, 100, 120)]
    [0.0, 0.1, 0.2, 0.2]
    """

    start: float
    end: float
    until: float | int = 1.0
    begin: float | int = 0

    def at(self, step: int, total_steps: int) -> float:
        """Value at `step`."""
        progress = _progress(step, self.begin, self.until, total_steps)
        # The ends exactly, whatever rounding does in between.
        return self.end if progress == 1 else self.start + (self.end - self.start) * progress


@register_schedule
@dataclass(frozen=True)
class Cosine(Schedule):
    """Half a cosine from `start` to `end`, flat at both ends; arguments as in `Linear`.

    >>> round(Cosine(0.0, 1.0).at(25, 100), 4)
    0.1464
    """

    start: float
    end: float
    until: float | int = 1.0
    begin: float | int = 0

    def at(self, step: int, total_steps: int) -> float:
        """Value at `step`."""
        progress = _progress(step, self.begin, self.until, total_steps)
        rise = (1 - math.cos(math.pi * progress)) / 2
        return self.end if progress == 1 else self.start + (self.end - self.start) * rise


@register_schedule
@dataclass(frozen=True)
class Geometric(Schedule):
    """Constant ratio per step from `start` to `end`, both positive; arguments as in `Linear`.

    >>> Geometric(400.0, 0.1, until=512).at(512, 10_000)
    0.1
    """

    start: float
    end: float
    until: float | int = 1.0
    begin: float | int = 0

    def __post_init__(self) -> None:
        """Refuse ends that have no ratio."""
        for name, value in (("start", self.start), ("end", self.end)):
            if not value > 0:
                raise InputError(f"{name}={value}: a Geometric schedule needs numbers above 0")

    def at(self, step: int, total_steps: int) -> float:
        """Value at `step`."""
        progress = _progress(step, self.begin, self.until, total_steps)
        return self.end if progress == 1 else self.start * (self.end / self.start) ** progress


@register_schedule
@dataclass(frozen=True)
class Piecewise(Schedule):
    """Constant pieces: `values[i]` until `steps[i]`, then the next; one value more than steps.

    >>> l1 = Piecewise(values=(8e-5, 4e-5), steps=(2000,))
    >>> l1.at(1999, 15_000), l1.at(2000, 15_000)
    (8e-05, 4e-05)
    """

    values: tuple[float, ...]
    steps: tuple[float | int, ...]

    def __post_init__(self) -> None:
        """Accept lists, refuse lengths that do not fit."""
        object.__setattr__(self, "values", tuple(self.values))
        object.__setattr__(self, "steps", tuple(self.steps))
        if len(self.values) != len(self.steps) + 1:
            raise InputError(f"values={self.values}, steps={self.steps}: expected one value more than steps")

    def at(self, step: int, total_steps: int) -> float:
        """Value at `step`."""
        passed = sum(step >= end_step(end, step, total_steps) for end in self.steps)
        return self.values[passed]
