"""The progress line on terminals and in logs, and the two-step Ctrl-C."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from gridreg.ops import compilation
from gridreg.training.progress import Interruption, Progress, clock_time, compilation_shown, interruptible


class Clock:
    """A clock that moves when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    return Terminal()


def test_a_log_gets_a_plain_line_every_few_seconds_and_the_last(clock):
    log = io.StringIO()
    with Progress(100, stream=log, seconds=10, clock=clock) as progress:
        for step in range(1, 101):
            clock.now += 0.5
            progress.update(step, psnr=20.0, loss=0.01)
    lines = log.getvalue().splitlines()
    assert len(lines) == 5
    assert lines[0] == "step 20/100 (20%), 2.00 it/s, left 0:40, PSNR 20.00 dB, loss 0.01"
    assert lines[-1] == "step 100/100 (100%), 2.00 it/s, took 0:50, PSNR 20.00 dB, loss 0.01"
    assert "\r" not in log.getvalue()
    assert "\x1b" not in log.getvalue()


def test_values_are_means_since_the_last_line(clock):
    log = io.StringIO()
    progress = Progress(4, stream=log, seconds=2, clock=clock)
    for step, psnr in enumerate([10.0, 20.0, 30.0, 50.0], start=1):
        clock.now += 1
        progress.update(step, psnr=psnr)
    assert re.findall(r"PSNR [0-9.]+", log.getvalue()) == ["PSNR 15.00", "PSNR 40.00"]


def test_time_left_follows_the_recent_rate(clock):
    """After the grid has grown, steps are slower; what is left is judged by those."""
    log = io.StringIO()
    progress = Progress(1000, stream=log, seconds=10, clock=clock)
    for step in range(1, 201):
        clock.now += 0.1 if step <= 100 else 1.0
        progress.update(step)
    assert "1.00 it/s, left 13:" in log.getvalue().splitlines()[-1]


def test_a_resumed_run_counts_its_own_steps_for_the_rate(clock):
    log = io.StringIO()
    progress = Progress(1000, start=900, stream=log, seconds=1, clock=clock)
    clock.now += 10
    progress.update(910)
    assert log.getvalue() == "step 910/1000 (91%), 1.00 it/s, left 1:30\n"


def test_no_time_and_no_steps_are_no_division_by_zero(clock):
    log = io.StringIO()
    Progress(0, stream=log, seconds=0, clock=clock).update(0)
    Progress(5, stream=log, seconds=0, clock=clock).update(0)
    assert log.getvalue().splitlines() == [
        "step 0/0 (100%), 0.00 it/s, took 0:00",
        "step 0/5 (0%), 0.00 it/s, left ?",
    ]


def test_a_terminal_gets_one_live_line(clock, terminal):
    with Progress(10, stream=terminal, clock=clock) as progress:
        for step in range(1, 11):
            clock.now += 0.15
            progress.update(step, loss=0.5)
    text = terminal.getvalue()
    assert text.count("\n") == 1
    assert text.endswith("\n")
    drawn = text.rstrip("\n").split("\r\x1b[K")[1:]
    assert len(drawn) == 5
    assert drawn[0].startswith("step 2/10 [####                ] (20%), 6.67 it/s")
    assert drawn[-1].startswith("step 10/10 [####################] (100%)")


def test_the_live_line_never_wraps(clock, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "30")
    terminal = Terminal()
    progress = Progress(10, stream=terminal, clock=clock)
    clock.now += 1
    progress.update(1, psnr=20, a_value_with_a_long_name=1.0)
    assert len(terminal.getvalue().removeprefix("\r\x1b[K")) == 29


def test_messages_stand_above_the_live_line(clock, terminal):
    with Progress(10, stream=terminal, clock=clock) as progress:
        progress.message("first")
        clock.now += 1
        progress.update(1)
        progress.message("resampled to 160^3")
    text = terminal.getvalue()
    assert text.startswith("first\n")
    line = "step 1/10 [##                  ] (10%), 1.00 it/s, left 0:09"
    assert text.endswith(f"\r\x1b[Kresampled to 160^3\n\r\x1b[K{line}\n")


def test_messages_in_a_log(clock):
    log = io.StringIO()
    Progress(10, stream=log, clock=clock).message("saved")
    assert log.getvalue() == "saved\n"


def test_a_dumb_terminal_is_treated_as_a_log(clock, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    terminal = Terminal()
    clock.now += 1
    Progress(1, stream=terminal, clock=clock).update(1)
    assert "\r" not in terminal.getvalue()


def test_a_closed_stream_does_not_stop_the_run(clock):
    log = io.StringIO()
    progress = Progress(1, stream=log, seconds=0, clock=clock)
    log.close()
    progress.update(1)
    progress.message("still alive")
    assert log.closed


def test_an_update_costs_microseconds():
    progress = Progress(10**9, stream=io.StringIO(), seconds=1000)
    begun = time.perf_counter()
    for step in range(1000):
        progress.update(step, psnr=1.0, loss=1.0)
    assert time.perf_counter() - begun < 0.2


def test_compiling_is_shown_with_a_bar_and_leaves_the_line(terminal):
    with compilation_shown(terminal):
        with compilation.timed(), compilation.compiling():
            pass
        with compilation.timed():  # out of the cache: not a word
            pass
    before, first, last = terminal.getvalue().split("\r\x1b[K")
    assert before == ""
    assert re.fullmatch(r"compiling kernels \(once, about \d+ s\) \[#* *\]", first)
    assert last == ""


def test_a_log_is_told_of_compiling_once():
    log = io.StringIO()
    with compilation_shown(log):
        for _ in range(3):
            with compilation.timed(), compilation.compiling():
                pass
    assert re.fullmatch(r"compiling kernels \(once, about \d+ s\)\n", log.getvalue())


def test_the_clock_stands_still_while_kernels_are_compiled():
    """Or the first line of a first run says "left 9:29:22"."""
    log = io.StringIO()
    with Progress(1000, stream=log, seconds=0) as progress:
        with compilation.timed():
            time.sleep(0.5)
        progress.update(1)
    before, spent = compilation.work_clock(), compilation.compile_seconds()
    with compilation.timed():
        time.sleep(0.05)
    assert compilation.compile_seconds() - spent >= 0.05
    assert compilation.work_clock() - before < 0.04
    assert float(re.search(r"([\d.]+) it/s", log.getvalue())[1]) > 5


def test_a_notebook_gets_a_bar_of_tqdm(clock):
    file = io.StringIO()
    with Progress(10, start=4, label="step", stream=file, clock=clock, notebook=True) as progress:
        clock.now += 1
        progress.update(7, psnr=20.0)
        progress.message("above the bar")
        clock.now += 1
        progress.update(10, psnr=22.0)
    text = file.getvalue()
    assert "7/10" in text
    assert "PSNR 22.00 dB" in text
    assert "step: 100%" in text
    assert "left" not in text


def test_clock_time():
    assert clock_time(0) == "0:00"
    assert clock_time(59.6) == "1:00"
    assert clock_time(3599.7) == "1:00:00"


# ---- Ctrl-C


def test_the_first_signal_asks_and_the_second_aborts(capfd):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    aborted = False
    with interruptible() as interruption:
        assert not interruption.requested
        os.kill(os.getpid(), signal.SIGINT)
        assert interruption.requested
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt:
            aborted = True
    assert aborted
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert capfd.readouterr().err.count("stopping after this step and saving") == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_termination_and_a_closed_terminal_are_requests_as_well(number):
    with interruptible() as interruption:
        os.kill(os.getpid(), number)
        assert interruption.requested


def test_a_closed_terminal_under_nohup_is_none():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interruption.requested
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_handlers_come_back_after_an_exception():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(RuntimeError), interruptible():
        raise RuntimeError
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_may_use_it_without_signals():
    seen: list[Interruption] = []

    def work() -> None:
        with interruptible() as interruption:
            seen.append(interruption)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert [i.requested for i in seen] == [False]


LOOP = textwrap.dedent(
    """
    import sys, time
    from gridreg.training.progress import Progress, interruptible
    with interruptible() as interruption, Progress(10**6, seconds=1000) as progress:
        print("ready", flush=True)
        for step in range(10**6):
            time.sleep(0.01)
            progress.update(step)
            if interruption.requested:
                if "--slow" in sys.argv:
                    print("saving", flush=True)
                    time.sleep(30)
                print("saved", flush=True)
                break
    sys.exit(130 if interruption.requested else 0)
    """
)


@pytest.mark.parametrize("arguments", [[], ["--slow"]])
def test_a_program_saves_and_stops_with_status_130(arguments):
    child = subprocess.Popen(
        [sys.executable, "-c", LOOP, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    child.send_signal(signal.SIGINT)
    if arguments:
        assert child.stdout.readline() == "saving\n"
        child.send_signal(signal.SIGINT)
    output, errors = child.communicate(timeout=20)
    assert "stopping after this step and saving; once more to abort" in errors
    if arguments:
        assert "saved" not in output
        assert "KeyboardInterrupt" in errors
        # Python ends by the signal itself after an unhandled Ctrl-C.
        assert child.returncode in (130, -signal.SIGINT)
    else:
        assert output == "saved\n"
        assert child.returncode == 130
