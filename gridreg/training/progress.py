"""Progress of a run, on a terminal or in a log, and stopping it without losing anything.

A terminal gets one live line; a log file gets a plain line every few seconds, so that it stays readable.
The first Ctrl-C asks the loop to save and stop, the second one aborts.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, TextIO

from gridreg.machine import usable_cores
from gridreg.ops.compilation import telling_compilation, work_clock

_BAR = 20
_RATE_WINDOW = 20.0
_REFRESH = 0.2


class Progress:
    """Reports the step, the rate, the time left and a few values of a long loop.

    Values are averaged since the last line, because those of one batch scatter. Use it as a context
    manager, so that the live line is left alone at the end.

    Args:
        total: number of steps.
        start: steps done before, when a run is resumed.
        label: stands before the step.
        stream: where to write; standard error by default, because standard output may be data.
        seconds: between two lines of a log; a terminal is refreshed every 0.2 s.
        clock: seconds; stands still while kernels are compiled.
        notebook: show a bar of tqdm's instead; by default in a notebook.

    Example:
        >>> with Progress(3, stream=sys.stdout, seconds=0, clock=iter([0.0, 2.0, 4.0]).__next__) as progress:
        ...     progress.update(1, psnr=20.5, loss=0.01)
        ...     progress.update(3, psnr=21.0, loss=0.008)
        step 1/3 (33%), 0.50 it/s, left 0:04, PSNR 20.50 dB, loss 0.01
        step 3/3 (100%), 0.75 it/s, took 0:04, PSNR 21.00 dB, loss 0.008
    """

    def __init__(
        self,
        total: int,
        *,
        start: int = 0,
        label: str = "step",
        stream: TextIO | None = None,
        seconds: float = 10.0,
        clock: Callable[[], float] = work_clock,
        notebook: bool | None = None,
    ) -> None:
        self.total = total
        self._label = label
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._seconds = _REFRESH if self._live else seconds
        self._clock = clock
        self._begun = clock()
        self._marks: deque[tuple[float, int]] = deque([(self._begun, start)])
        self._shown = self._begun
        self._start = start
        self._sums: dict[str, tuple[float, int]] = {}
        self._line = ""
        self._bar: Any = None
        if ("ipykernel" in sys.modules and stream is None) if notebook is None else notebook:
            from tqdm.auto import tqdm

            self._bar = tqdm(total=total, initial=start, desc=label, file=stream, mininterval=0)
            self._seconds = _REFRESH

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self, step: int, **values: float) -> None:
        """Tell the number of steps done and the values of the last one (``psnr`` in dB, ``loss``, ...).

        Costs about a microsecond when no line is due.
        """
        for name, value in values.items():
            sum_, count = self._sums.get(name, (0.0, 0))
            self._sums[name] = (sum_ + value, count + 1)
        now = self._clock()
        if now - self._shown < self._seconds and step < self.total:
            return
        line = self._describe(step, now)
        averages = ", ".join(_shown(name, sum_ / count) for name, (sum_, count) in self._sums.items())
        self._shown = now
        self._sums.clear()
        if self._bar is not None:
            self._bar.set_postfix_str(averages, refresh=False)
            self._bar.update(step - self._bar.n)
        elif self._live:
            self._draw(line)
        else:
            self._write(line + "\n")

    def message(self, text: str) -> None:
        """A line that stays, above the live one."""
        if self._bar is not None:
            self._bar.write(text)
        elif self._live and self._line:
            self._write(f"\r\x1b[K{text}\n")
            self._draw(self._line)
        else:
            self._write(text + "\n")

    def close(self) -> None:
        """Leave the live line as it is and go on below it."""
        if self._bar is not None:
            self._bar.close()
        if self._live and self._line:
            self._write("\n")
            self._line = ""

    def _describe(self, step: int, now: float) -> str:
        # The rate of the last seconds, because a step costs more when the grid has grown.
        self._marks.append((now, step))
        while len(self._marks) > 2 and now - self._marks[1][0] > _RATE_WINDOW:
            self._marks.popleft()
        before, done = self._marks[0]
        rate = (step - done) / (now - before) if now > before else 0.0
        share = step / self.total if self.total else 1.0
        if step >= self.total:
            left = f"took {clock_time(now - self._begun)}"
        else:
            left = f"left {clock_time((self.total - step) / rate) if rate > 0 else '?'}"
        values = [_shown(name, sum_ / count) for name, (sum_, count) in self._sums.items()]
        bar = ""
        if self._live:
            full = min(_BAR, int(_BAR * share))
            bar = f" [{'#' * full}{' ' * (_BAR - full)}]"
        head = f"{self._label} {step}/{self.total}{bar} ({int(100 * share)}%)"
        return ", ".join([head, f"{rate:.2f} it/s", left, *values])

    def _draw(self, line: str) -> None:
        # A line that wraps cannot be overwritten by a carriage return.
        self._line = line
        self._write("\r\x1b[K" + line[: shutil.get_terminal_size().columns - 1])

    def _write(self, text: str) -> None:
        # A closed pipe or a full disk behind the log is no reason to lose the run.
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
            self._stream.flush()


def clock_time(seconds: float) -> str:
    """Seconds as ``m:ss`` or ``h:mm:ss``.

    Example:
        >>> clock_time(75), clock_time(3723.4)
        ('1:15', '1:02:03')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _shown(name: str, value: float) -> str:
    return f"PSNR {value:.2f} dB" if name == "psnr" else f"{name} {value:.4g}"


# Of a run with a VM field: kernels, and seconds of one core (benchmarks/speed.py compile).
_KERNELS, _COMPILING = 29, 25


@contextmanager
def compilation_shown(stream: TextIO | None = None) -> Iterator[None]:
    """A block in which a first run says that it compiles kernels: with a bar on a terminal, in a log once.

    Args:
        stream: where to write; standard error by default.
    """
    target = sys.stderr if stream is None else stream
    live, said = target.isatty() and os.environ.get("TERM") != "dumb", False
    text = f"compiling kernels (once, about {round(_COMPILING / min(2, usable_cores()))} s)"

    def tell(ready: int | None) -> None:
        nonlocal said
        if live:
            full = _BAR * min(ready or 0, _KERNELS) // _KERNELS
            line = "\r\x1b[K" if ready is None else f"\r\x1b[K{text} [{'#' * full}{' ' * (_BAR - full)}]"
        else:
            line = "" if said or ready is None else f"{text}\n"
        said = True
        with contextlib.suppress(OSError, ValueError):
            target.write(line)
            target.flush()

    with telling_compilation(tell):
        yield


_STOPPING = tuple(
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__
)


class Interruption:
    """Whether somebody asked the run to stop; read ``requested``, which the first signal sets, after every step."""

    requested = False


@contextmanager
def interruptible(
    signals: Sequence[signal.Signals] = _STOPPING,
) -> Iterator[Interruption]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP inside into a request; the second one raises ``KeyboardInterrupt``.

    Save inside the block, so that the second one can still cut the saving short. Outside the main thread,
    where Python allows no signal handlers, the request never comes.

    Example:
        >>> with interruptible() as interruption:
        ...     for step in range(10):
        ...         if step == 2:
        ...             signal.raise_signal(signal.SIGINT)
        ...         if interruption.requested:
        ...             break
        >>> step
        2
    """
    interruption = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return

    def handle(_: int, __: FrameType | None) -> None:
        if interruption.requested:
            raise KeyboardInterrupt
        interruption.requested = True
        # Not through sys.stderr: the signal may have come in the middle of a write to it.
        with contextlib.suppress(OSError):
            os.write(2, b"\nstopping after this step and saving; once more to abort\n")

    before: dict[signal.Signals, Any] = {}
    try:
        for number in signals:
            # Under nohup a closed terminal is no reason to stop.
            if number != signal.SIGINT and signal.getsignal(number) is signal.SIG_IGN:
                continue
            before[number] = signal.signal(number, handle)
        yield interruption
    finally:
        for number, handler in before.items():
            # None stands for a handler that was not installed from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
