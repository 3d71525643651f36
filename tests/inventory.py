"""What a user can name: commands with options, regularizers, presets, protocols, keys of a configuration, exports.

``python tests/inventory.py > tests/data/inventory-0.1.0.json`` wrote the list that `test_inventory` compares with.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from typing import Any

import gridreg


def inventory() -> dict[str, list[str]]:
    """Sorted names by kind; a name with a dot is a part of what stands before the dot."""
    from backbones.decoders import DECODERS
    from gridreg.cli import COMMANDS
    from gridreg.cli.main import options_of
    from gridreg.export.mesh_files import MESH_SUFFIXES
    from gridreg.scenes.protocols import PROTOCOLS
    from gridreg.schedules import SCHEDULES
    from gridreg.training import RunConfig, preset_names

    regularizers = gridreg.REGISTRY.values()
    return {
        "public": sorted(gridreg.__all__),
        "commands": sorted(COMMANDS),
        "options": sorted(
            f"{name}.{field.name}" for name in COMMANDS for field in dataclasses.fields(options_of(name))
        ),
        "regularizers": sorted(
            f"{cls.__name__}.{field.name}"
            for cls in regularizers
            for field in dataclasses.fields(cls)
            if field.init
        ),
        "compositions": gridreg.composition_names(),
        "presets": preset_names(),
        "protocols": sorted(PROTOCOLS),
        "schedules": sorted(SCHEDULES),
        "decoders": sorted(DECODERS),
        "meshes": sorted(MESH_SUFFIXES),
        "configuration": sorted(_keys(RunConfig)),
    }


def _keys(cls: Any, prefix: str = "") -> list[str]:
    kinds, found = typing.get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        kind = kinds[field.name]
        nested = dataclasses.is_dataclass(kind) and not field.name.startswith("_")
        found += _keys(kind, f"{prefix}{field.name}.") if nested else [prefix + field.name]
    return found


if __name__ == "__main__":
    print(json.dumps(inventory(), indent=1))
