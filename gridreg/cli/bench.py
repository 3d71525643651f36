"""``gridreg bench``: the benchmarks of a checkout by name."""

from __future__ import annotations

import ast
import runpy
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import gridreg
from gridreg.errors import InputError


@dataclass
class BenchOptions:
    """List the benchmarks of a checkout, or run one: gridreg bench NAME [ITS OWN OPTIONS]."""

    name: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME", help_behavior_hint="")
    ] = None
    """Benchmark to run; without it they are listed."""
    arguments: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="...", help_behavior_hint="")
    ] = ()
    """Passed on; `gridreg bench NAME --help` shows its own options."""


def benchmarks() -> dict[str, Path]:
    """The benchmark programs by name: of the checkout that gridreg is imported from, or that one stands in.

    Raises:
        InputError: where there is no checkout.
    """
    places = [Path(gridreg.__file__).parents[1], Path.cwd()]
    for place in places:
        folder = place / "benchmarks"
        if (place / "pyproject.toml").is_file() and folder.is_dir() and (place / "gridreg").is_dir():
            # Beside the programs lie the modules that they share.
            programs = [path for path in sorted(folder.glob("*.py")) if "__main__" in path.read_text("utf-8")]
            return {path.stem: path for path in programs}
    raise InputError(
        f"bench: gridreg is installed in {places[0]} without its benchmarks; "
        "expected a checkout of the repository: run it from there"
    )


def run(words: Sequence[str]) -> int:
    """List the benchmarks, or run the one that the first word names with the other words.

    Raises:
        InputError: without a checkout, or for an unknown name.
    """
    if words and words[0] in ("-h", "--help"):
        tyro.cli(BenchOptions, args=list(words[:1]), prog="gridreg bench")
    found = benchmarks()
    if not words:
        width = max(map(len, found), default=0)
        for name, path in found.items():
            print(f"{name:<{width}}  {_about(path)}")
        return 0
    name, rest = words[0], list(words[1:])
    if name not in found:
        raise InputError(f"bench: found {name!r}, expected one of {', '.join(found)}")
    before, places = sys.argv, sys.path[:]
    sys.argv = [str(found[name]), *rest]
    sys.path.insert(0, str(found[name].parent))
    try:
        runpy.run_path(str(found[name]), run_name="__main__")
    except SystemExit as status:
        if isinstance(status.code, str):
            raise InputError(f"bench {name}: {status.code}") from None
        return int(status.code or 0)
    finally:
        sys.argv, sys.path[:] = before, places
    return 0


def _about(path: Path) -> str:
    """The first line of a program's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
