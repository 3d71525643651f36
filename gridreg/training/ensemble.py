"""Trained runs made one: a checkpoint of several members, which every command reads like that of one run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gridreg.errors import InputError
from gridreg.training.checkpoint import has_checkpoint, save_checkpoint, sound
from gridreg.training.files import check_output_folder, one_writer
from gridreg.training.loading import checkpoint_of, members_in

_OF_TRAINER = ("step", "resolution", "field", "handle", "occupancy")
_OF_RUN = ("march", "warp", "background")


def save_ensemble(folders: Sequence[str | Path], out: str | Path) -> int:
    """Write the checkpoint of an ensemble: fields, masks and occupancies of several runs, without what trains them.

    Args:
        folders: output folders of runs of one scene, or their checkpoints; an ensemble counts as its members.
        out: output folder, which gets a ``checkpoint``; the runs may go afterwards.

    Returns:
        The number of members.

    Raises:
        InputError: for fewer than two runs, runs of different scenes, a missing or damaged checkpoint, a folder that
            holds a run already or that another run writes to, or a place that is not writable.
    """
    if len(folders) < 2:
        raise InputError(f"ensemble: found {len(folders)} run, expected at least two")
    target = check_output_folder(out)
    with one_writer(target):
        return _save(folders, target)


def _save(folders: Sequence[str | Path], target: Path) -> int:
    if has_checkpoint(target / "checkpoint"):
        raise InputError(f"{target}: holds a run already; choose another output folder")
    joined: list[dict[str, Any]] = []
    first = ""
    for folder in folders:
        path = checkpoint_of(folder)
        members, _, fingerprint = members_in(path)
        with sound(path):
            parts = [_part(member) for member in members]
        if joined and fingerprint != first:
            raise InputError(
                f"{folder}: trained on another scene than {folders[0]} (fingerprint {fingerprint[:12]}, expected "
                f"{first[:12]}); expected the same training images"
            )
        first = fingerprint
        joined += parts
    save_checkpoint(target / "checkpoint", {"members": joined}, config=joined[0]["config"], fingerprint=first)
    return len(joined)


def _part(member: dict[str, Any]) -> dict[str, Any]:
    state = member["state"]
    kept = {name: state[name] for name in _OF_RUN if name in state}
    trainer = {name: state["trainer"][name] for name in _OF_TRAINER}
    if "exposure" in state["trainer"]:
        trainer["exposure"] = {}
    if "surroundings" in state["trainer"]:
        around = state["trainer"]["surroundings"]
        trainer["surroundings"] = {"nodes": around["nodes"], "field": around["field"]}
    return {"config": member["config"], "state": {**kept, "trainer": trainer}}
