"""Judge of what becomes of an input: refused in one clear line, or sound; quickly, and in little memory."""

from __future__ import annotations

import logging
import math
import re
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from gridreg.errors import InputError
from gridreg.export import Mesh
from gridreg.rendering import Camera
from gridreg.scenes import Scene
from gridreg.training import LoadedRun, Trainer
from tests.fuzz.formats import Input

__all__ = ["Verdict", "judge", "memory", "restart_peak"]

SECONDS = 2.0
MEGABYTES = 300.0
LONGEST_LINE = 500


def memory() -> tuple[float, float]:
    """Return what this process holds now, and the most it held since `restart_peak`, in MB; 0 if nobody says."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0.0, 0.0
    now, peak = (re.search(rf"{name}:\s+(\d+)", status) for name in ("VmRSS", "VmHWM"))
    return (float(now[1]) / 1e3, float(peak[1]) / 1e3) if now and peak else (0.0, 0.0)


def restart_peak() -> None:
    """Begin to count the peak of this process anew (Linux); elsewhere it stays that of its whole life."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


class Verdict(NamedTuple):
    """What became of an input.

    Attributes:
        outcome: ``refused``, ``accepted`` or ``failed``.
        said: the refusal, or what is wrong.
        seconds: of the processor.
        megabytes: the most memory that was held above what the process held at ``base``.
    """

    outcome: str
    said: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0


def judge(item: Input, folder: Path, *, seconds: float = SECONDS, base: float | None = None) -> Verdict:
    """Write the files of an input into an empty folder, read them and judge.

    Args:
        item: the input.
        folder: an empty folder.
        seconds: processor time that it may take.
        base: memory in MB that it may exceed by `MEGABYTES`: that of a process that has imported everything and read
            something of each format; None: what this one holds now.
    """
    for name, content in item.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    if base is None:
        base = memory()[0]
    told = _Told()
    restart_peak()
    logging.getLogger().addHandler(told)
    began = time.process_time()
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            found = item.read(folder)
        fault = _fault(found)
        verdict = Verdict("failed", fault) if fault else Verdict("accepted")
    except InputError as error:
        text = str(error)
        clear = text.isprintable() and 10 < len(text) <= LONGEST_LINE
        verdict = Verdict("refused", text) if clear else Verdict("failed", f"no clear line: {text[:200]!r}")
    except Exception as error:
        verdict = Verdict("failed", f"{type(error).__name__}: {str(error)[:200]}")
    finally:
        logging.getLogger().removeHandler(told)
    told.lines += [str(warning.message) for warning in warned]
    if told.lines:
        verdict = Verdict("failed", f"a line of another's: {told.lines[0][:200]}")
    took, peak = time.process_time() - began, memory()[1] - base
    if took > seconds:
        verdict = Verdict("failed", f"took {took:.1f} s ({verdict.outcome})")
    elif peak > MEGABYTES:
        verdict = Verdict("failed", f"took {peak:.0f} MB ({verdict.outcome})")
    return verdict._replace(seconds=took, megabytes=peak)


class _Told(logging.Handler):
    """Lines that libraries would put on standard error by themselves."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.name}: {record.getMessage()}")


def _fault(found: Any) -> str:
    """Return what is not finite, positive or ordered in what was accepted; nothing for what is sound."""
    if isinstance(found, np.ndarray):
        return (
            ""
            if np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
            else "pixels outside of 0 to 1"
        )
    if isinstance(found, (LoadedRun, Trainer)):
        return _fault_of_run(found)
    if isinstance(found, Mesh):
        sound = len(found.faces) and np.isfinite(found.vertices).all() and found.faces.min() >= 0
        return "" if sound and found.faces.max() < len(found.vertices) else "a mesh that is not finite"
    if isinstance(found, (list, tuple)) and found and isinstance(found[0], Camera):
        lenses = [(*c.lens.intrinsics[:2], c.lens.width, c.lens.height) for c in found]
        sound = all(0 < value < 1e9 for lens in lenses for value in lens)
        return (
            ""
            if sound and all(torch.isfinite(c.pose).all() for c in found)
            else "cameras that are not finite"
        )
    if isinstance(found, dict):
        return "" if _finite(found) else "a configuration that is not finite"
    if not isinstance(found, Scene):
        return ""
    for views in (found.train, found.test):
        rotation = views.poses[:, :3, :3]
        if not bool(torch.isfinite(views.poses).all() and torch.isfinite(views.intrinsics).all()):
            return "cameras that are not finite"
        if not bool((views.intrinsics[:, :2] > 0).all() and (torch.linalg.det(rotation) > 0.9).all()):
            return "focal lengths that are not positive, or mirrored cameras"
        if not bool(torch.isfinite(views.rgba).all()):
            return "pixels that are not finite"
    if not bool(torch.isfinite(found.bounds).all() and (found.bounds[0] < found.bounds[1]).all()):
        return "a box that is not finite or not ordered"
    return "" if 0 <= found.near < found.far < float("inf") else "near and far that are not ordered"


def _fault_of_run(found: LoadedRun | Trainer) -> str:
    """Return what cannot be rendered in a run that was read."""
    for name, value in found.field.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            return f"a field whose {name} is not finite"
    low, high = found.field.bounds
    if not bool((low < high).all()):
        return "a field whose box is not ordered"
    if isinstance(found, Trainer):
        return ""
    if not (0 <= found.march.near < found.march.far < math.inf and 0 < found.march.step < math.inf):
        return "near, far and step that are not ordered"
    colour = torch.as_tensor(found.background)
    sound = colour.shape == (3,) and bool(((colour >= 0) & (colour <= 1)).all())
    return "" if sound and 0 < found.world.unit < math.inf else "a background or world that is none"


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
