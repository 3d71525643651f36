"""Presets: complete configurations by name, kept as YAML."""

from __future__ import annotations

from pathlib import Path

from gridreg.errors import ConfigError, near_names
from gridreg.training.config import from_yaml
from gridreg.training.settings import RunConfig


def _folder() -> Path:
    """Installed beside this file; in a checkout, ``examples/configs``, where a reader looks for them."""
    installed = Path(__file__).parent / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "examples" / "configs"


def preset_names() -> list[str]:
    """Names that `load_preset` accepts."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def preset_text(name: str) -> str:
    """The text of a preset's file, which begins with what it is."""
    return (_folder() / f"{name}.yaml").read_text(encoding="utf-8")


def load_preset(name: str) -> RunConfig:
    """The configuration of a preset.

    Raises:
        ConfigError: if there is none of this name, with the names there are.
    """
    names = preset_names()
    if name not in names:
        raise ConfigError(
            ("preset",), f"found {name!r}, expected one of {', '.join(names)}{near_names(name, names)}"
        )
    config = from_yaml(_folder() / f"{name}.yaml", RunConfig)
    return RunConfig(**{**config.__dict__, "preset": name})
