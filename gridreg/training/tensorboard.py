"""Figures of a run for TensorBoard, beside the curves that every run leaves."""

from __future__ import annotations

import importlib.util
from typing import Any

from gridreg.errors import InputError
from gridreg.training.execute import Execution
from gridreg.training.trainer import StepReport


class TensorBoard:
    """Writes the figures of a run into ``tensorboard/`` in its folder; pass it to `execute` as ``watch``.

    Args:
        every: iterations between two points; values are means since the last.

    Raises:
        InputError: without the package ``tensorboard`` (extra ``tensorboard``).
    """

    def __init__(self, every: int = 20) -> None:
        if importlib.util.find_spec("tensorboard") is None:
            raise InputError(
                "tensorboard: not installed, expected: pip install 'gridreg[tensorboard]'; or train without it"
            )
        self._every, self._sums, self._count = every, dict[str, float](), 0
        self._run: Execution | None = None
        self._writer: Any = None

    def start(self, run: Execution) -> None:
        """Open the folder; a run that goes on replaces what it had written beyond this step."""
        from torch.utils.tensorboard import SummaryWriter

        self._run = run
        self._writer = SummaryWriter(str(run.out / "tensorboard"), purge_step=run.trainer.step)  # type: ignore[no-untyped-call]

    def step(self, report: StepReport) -> None:
        """Take in an iteration, and write where it is due."""
        assert self._run is not None
        trainer, steps = self._run.trainer, self._run.config.train.steps
        self._count += 1
        for name, value in report.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        if trainer.step % self._every and trainer.step != steps:
            return
        for name, value in self._sums.items():
            kind = name if name in ("loss", "mse", "psnr") else f"penalties/{name}"
            self._writer.add_scalar(kind, value / self._count, trainer.step)
        for name, mask in trainer.handle.masks().items():
            self._writer.add_scalar(f"open/{name}", float(mask.mean()), trainer.step)
        self._sums, self._count = {}, 0
        if trainer.step == steps:
            self._writer.close()
