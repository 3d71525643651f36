"""Inputs that failed once, one a file: what reads them, and their bytes."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gridreg.ablation.study import load_study
from gridreg.ablation.table_report import read_table
from gridreg.export import load_cameras, read_mesh
from gridreg.scenes.images import read_mask, read_rgba
from gridreg.training.strict_yaml import read_yaml
from tests.fuzz.formats import IMAGES, Input, scene
from tests.fuzz.formats_of_runs import (
    STATE,
    TENSORS,
    changed_store,
    loaded,
    read_configuration,
    read_history,
    resumed,
    signed,
    small_run,
)

__all__ = ["CORPUS", "load", "store"]

CORPUS = Path(__file__).parent / "corpus"

_FILES: dict[str, Callable[[Path], Any]] = {
    "mask": read_mask,
    "image": lambda path: read_rgba(path, opaque=True),
    "camera path": load_cameras,
    "mesh": read_mesh,
    "YAML": read_yaml,
    "configuration": read_configuration,
    "study": load_study,
    "table": read_table,
    "history": read_history,
}
_FOLDERS: dict[str, Callable[[Path], Any]] = {
    "store": changed_store,
    "checkpoint": loaded,
    "resumed": resumed,
}


def _reader(kind: str, files: dict[str, bytes]) -> Callable[[Path], Any]:
    if kind in _FILES:
        (name,) = files
        return lambda folder: _FILES[kind](folder / name)
    return _FOLDERS.get(kind, scene)


def store(item: Input, said: str, path: Path) -> None:
    """Write an input that failed; the images and tensors that many share are left out."""
    kind = "resumed" if item.read is resumed else item.kind
    known = {**IMAGES, TENSORS: small_run()[2][TENSORS]}
    files = {
        name: base64.b64encode(data).decode() for name, data in item.files.items() if known.get(name) != data
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"format": kind, "failed with": said, "files": files}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> Input:
    """Return an input that `store` wrote."""
    content = json.loads(path.read_bytes())
    kind = content["format"]
    files = {name: base64.b64decode(data) for name, data in content["files"].items()}
    read = _reader(kind, files)
    if read is scene:
        return Input(kind, {**IMAGES, **files}, read)
    if TENSORS not in files and STATE in files:
        # Those of today's gridreg, under right checksums.
        files[TENSORS] = small_run()[2][TENSORS]
        try:
            content = json.loads(files[STATE])
            content.pop("sha256")
            files[STATE] = signed(content, files[TENSORS])
        except (ValueError, LookupError, AttributeError):
            pass
    return Input(kind, files, read)
