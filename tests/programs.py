"""Programs outside the packages, such as ``docs/make_catalogue.py``, as modules for tests."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]


def module_at(path: Path) -> ModuleType:
    """Return the module that a file makes, under the name of the file; it finds what lies beside it."""
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses, and `inspect`, look for a class's module by its name.
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
