"""A run from start to scored end, with everything it leaves in its output folder."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch

from gridreg.errors import InputError
from gridreg.ops.compilation import work_clock
from gridreg.scenes import Scene
from gridreg.scenes.doubts import trained_on
from gridreg.scenes.notebook import card
from gridreg.training.checkpoint import has_checkpoint
from gridreg.training.config import save_yaml
from gridreg.training.curves import History, draw_curves, draw_masks
from gridreg.training.evaluate import Scored, mean_psnr_of, score_views
from gridreg.training.exposure import AFFINE_CONVENTION, affine_psnr
from gridreg.training.files import check_output_folder, one_writer, write_json
from gridreg.training.metrics import image_metrics
from gridreg.training.outputs import save_contact_sheet, save_scored
from gridreg.training.progress import Interruption, Progress, compilation_shown, interruptible
from gridreg.training.record import metrics_record
from gridreg.training.run import build_trainer, resume_trainer, save_run
from gridreg.training.settings import RunConfig
from gridreg.training.trainer import StepReport, Trainer
from gridreg.training.typed_data import to_data


class Watch(Protocol):
    """Somebody who looks on while a run is under way, such as `gridreg.export.LiveView`."""

    def start(self, run: Execution, /) -> None:
        """Called once, before the first iteration and before anything is written."""
        ...

    def step(self, report: StepReport, /) -> None:
        """Called after every iteration, in the thread that trains."""
        ...


@dataclass(repr=False)
class Execution:
    """A run under way.

    Args:
        config: what determines it.
        scene: what it reconstructs.
        out: its folder.
        trainer: where it stands.
        history: its curves so far.
        seconds: by phase: ``setup``, ``train``, ``test``; compiling kernels, once a machine, is left out.
        stopping: whether somebody has asked it to stop.
    """

    config: RunConfig
    scene: Scene
    out: Path
    trainer: Trainer
    history: History
    seconds: dict[str, float]
    stopping: Callable[[], bool] = lambda: False

    @property
    def checkpoint(self) -> Path:
        """Folder of the checkpoint."""
        return self.out / "checkpoint"

    def __repr__(self) -> str:
        return f"Execution({str(self.out)!r}, {self.scene!r}, step {self.trainer.step} of {self.config.train.steps})"

    def _repr_html_(self) -> str:
        """The run as notebooks show it: where it stands, and its test views once they are scored."""
        metrics, sheet = self.out / "metrics.json", self.out / "test.png"
        score = json.loads(metrics.read_text(encoding="utf-8"))["mean"] if metrics.is_file() else {}
        facts = [f"step {self.trainer.step} of {self.config.train.steps}"]
        facts += [f"{name} {value}" for name, value in score.items()]
        return card(
            str(self.out), ", ".join(facts), [sheet.read_bytes()] if score and sheet.is_file() else []
        )

    def save(self) -> None:
        """Write the checkpoint.

        Raises:
            InputError: if a parameter is not finite; the last good checkpoint stays.
        """
        for name, value in self.trainer.field.named_parameters():
            if not bool(torch.isfinite(value).all()):
                raise InputError(f"step {self.trainer.step}: {name} is not finite; expected numbers")
        record = {"history": self.history.state_dict(), "seconds": self.seconds}
        save_run(self.checkpoint, self.trainer, self.config, record)

    def train(self, progress: Progress, interruption: Interruption, on_step: Any = None) -> bool:
        """Train to the end of the schedule; False if it was interrupted. Saves either way, and on the way."""
        trainer, settings = self.trainer, self.config.train
        began = saved = work_clock()
        before = self.seconds.get("train", 0.0)
        note = trainer.beside.note(self.scene, trainer.space.carves)
        if note:
            progress.message(note)

        def each(report: StepReport) -> bool:
            nonlocal saved
            self.history.record(trainer.step, report)
            now = work_clock()
            self.seconds["train"] = before + now - began
            progress.update(trainer.step, psnr=report["psnr"], loss=report["loss"])
            self._note_masks()
            if trainer.step in settings.evaluate_at and trainer.step < settings.steps:
                self._look(progress)
            if on_step is not None:
                on_step(report)
            if now - saved > 60 * settings.checkpoint_minutes and trainer.step < settings.steps:
                self.save()
                saved = work_clock()
            return not interruption.requested

        try:
            trainer.train(each=each)
            self.save()
        except InputError as error:
            kept = f"the last good checkpoint is {self.checkpoint}" if has_checkpoint(self.checkpoint) else ""
            raise InputError(f"{error}; {kept or 'no checkpoint was written before'}") from error
        return trainer.step >= settings.steps

    def _note_masks(self) -> None:
        step, total = self.trainer.step, self.config.train.steps
        if step % max(1, total // 100) == 0:
            masks = self.trainer.handle.masks()
            if masks:
                self.history.add(step, masks={name: mask.tolist() for name, mask in masks.items()})

    def _look(self, progress: Progress) -> None:
        views = self.scene.validation if self.scene.validation is not None else self.scene.test
        name = "validation_psnr" if self.scene.validation is not None else "test_psnr"
        stride = max(1, len(views) // 5)
        trainer = self.trainer
        began = work_clock()
        trainer.field.eval()
        value = mean_psnr_of(trainer.model, views, stride)
        trainer.field.train()
        # What a look costs is not training time.
        self.seconds["look"] = self.seconds.get("look", 0.0) + work_clock() - began
        self.history.add(trainer.step, {name: value, "seconds": self.seconds["train"]})
        progress.message(f"step {trainer.step}: {name.replace('_', ' ')} {value:.2f} dB")

    def score(self, progress: Progress, interruption: Interruption) -> list[Scored]:
        """Render and score the test views, each written as soon as it is done.

        Raises:
            KeyboardInterrupt: if it was interrupted; the training before it is saved.
        """
        trainer = self.trainer
        folder = check_output_folder(self.out / "test")
        began = work_clock()
        trainer.handle.step(self.config.train.steps)
        trainer.field.eval()

        def each(view: Scored) -> None:
            save_scored(folder, view)
            done.append(view)
            progress.update(len(done), psnr=view.metrics["psnr"])
            if interruption.requested:
                raise KeyboardInterrupt

        done: list[Scored] = []
        more = {} if trainer.beside.exposure is None else {"psnr_affine": affine_psnr}
        scored = score_views(trainer.model, self.scene.test, each, partial(image_metrics, more=more))
        trainer.field.train()
        self.seconds["test"] = work_clock() - began
        return scored

    def record(self, scored: Sequence[Scored], command: Sequence[str]) -> dict[str, Any]:
        """Write ``metrics.json``, the contact sheet and the curves; return the metrics."""
        scene = self.scene
        title = f"{scene.name}, {scene.protocol}, {self.config.preset or 'own configuration'}"
        save_contact_sheet(self.out / "test.png", scored)
        self.history.save(self.out / "history.jsonl")
        draw_curves(
            self.history.rows, self.out / "curves.png", title=title, events=self.config.train.resample_at
        )
        if any("masks" in row for row in self.history.rows):
            draw_masks(self.history.rows, self.out / "masks.png", title=title)
        metrics = metrics_record(
            {view.name: view.metrics for view in scored},
            scene=scene.name,
            protocol=scene.protocol,
            builtin=scene.builtin,
            seed=self.config.seed,
            steps=self.trainer.step,
            seconds=self.seconds,
            config=to_data(self.config),
            command=command,
            train_views=scene.train.names,
            conventions={} if self.trainer.beside.exposure is None else AFFINE_CONVENTION,
            trained_on=trained_on(scene.test, scene.train),
            uses_alpha=self.config.train.carve and scene.train.backdrop is None,
            device=str(self.trainer.bank.pixels.device),
        )
        write_json(self.out / "metrics.json", metrics)
        return metrics


def execute(
    config: RunConfig,
    scene: Scene,
    out: str | Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    on_step: Any = None,
    watch: Watch | Sequence[Watch] | None = None,
    make: Callable[[RunConfig, Scene], Trainer] = build_trainer,
) -> tuple[Execution, dict[str, Any] | None]:
    """Train, score and record one run.

    Leaves in ``out``: ``config.yaml``, ``checkpoint/``, ``metrics.json``, ``test/`` and ``test.png``, ``curves.png``,
    ``masks.png`` and ``history.jsonl``.

    Args:
        config: what determines the run.
        scene: opened as the configuration says, see `gridreg.training.open_scene`.
        out: the output folder.
        resume: go on from the checkpoint in ``out``.
        command: the command line, for the record.
        on_step: called with the `StepReport` of every iteration.
        watch: told when the run starts, and of every iteration; one or several.
        make: makes the trainer at step 0.

    Returns:
        The execution, and the metrics, or None if it was interrupted (its checkpoint is saved).

    Raises:
        InputError: for an unusable folder or checkpoint, a folder that another run writes to, or a training that has
            died.
    """
    folder = check_output_folder(out)
    with one_writer(folder), compilation_shown():
        checkpoint = folder / "checkpoint"
        if has_checkpoint(checkpoint) and not resume:
            raise InputError(
                f"{folder}: holds a run already; resume it with --resume, or choose another output folder"
            )
        began = work_clock()
        if resume:
            trainer, record = resume_trainer(checkpoint, config, scene, make)
            history, times = History(), dict(record["seconds"])
            history.load_state_dict(record["history"])
        else:
            trainer, history, times = (
                make(config, scene),
                History(max(1, config.train.steps // 200)),
                {},
            )
        times["setup"] = times.get("setup", 0.0) + work_clock() - began
        run = Execution(config, scene, folder, trainer, history, times)
        watching = () if watch is None else tuple(watch) if isinstance(watch, Sequence) else (watch,)
        for each in watching:
            each.start(run)
        save_yaml(
            folder / "config.yaml",
            config,
            comment="Everything that determines this run; pass it with --config.",
        )
        with interruptible() as interruption:
            run.stopping = lambda: interruption.requested
            with Progress(config.train.steps, start=trainer.step) as progress:
                finished = run.train(progress, interruption, _all(on_step, watching))
            if not finished:
                print(f"stopped at step {trainer.step}; go on with --resume --out {folder}", file=sys.stderr)
                return run, None
            with Progress(len(scene.test), label="test view") as progress:
                scored = run.score(progress, interruption)
        return run, run.record(scored, command)


def _all(on_step: Any, watching: Sequence[Watch]) -> Any:
    def each(report: StepReport) -> None:
        for watch in watching:
            watch.step(report)
        if on_step is not None:
            on_step(report)

    return each
