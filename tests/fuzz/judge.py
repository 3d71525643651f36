"""Judge of what becomes of an input: it is refused in one clear line, or what was read is sound, quickly."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from gridreg.errors import InputError
from gridreg.scenes import Scene
from tests.fuzz.formats import Input

__all__ = ["Verdict", "judge"]

SECONDS = 2.0
LONGEST_LINE = 500


class Verdict(NamedTuple):
    """What became of an input.

    Attributes:
        outcome: ``refused``, ``accepted`` or ``failed``.
        said: the refusal, or what is wrong.
    """

    outcome: str
    said: str = ""


def judge(item: Input, folder: Path, *, seconds: float = SECONDS) -> Verdict:
    """Write the files of an input into an empty folder, read them and judge.

    Args:
        item: the input.
        folder: an empty folder.
        seconds: processor time that it may take.
    """
    for name, content in item.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = item.read(folder)
        fault = _fault(found)
        verdict = Verdict("failed", fault) if fault else Verdict("accepted")
    except InputError as error:
        text = str(error)
        clear = text.isprintable() and 10 < len(text) <= LONGEST_LINE
        verdict = Verdict("refused", text) if clear else Verdict("failed", f"no clear line: {text[:200]!r}")
    except Exception as error:
        verdict = Verdict("failed", f"{type(error).__name__}: {str(error)[:200]}")
    took = time.process_time() - began
    if took > seconds:
        return Verdict("failed", f"took {took:.1f} s ({verdict.outcome})")
    return verdict


def _fault(found: Any) -> str:
    """Return what is not finite, positive or ordered in what was accepted; nothing for what is sound."""
    if isinstance(found, np.ndarray):
        return (
            ""
            if np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
            else "pixels outside of 0 to 1"
        )
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
