"""``gridreg board``: the sheet that an object is photographed on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gridreg.cli.arguments import OptionalFolder


@dataclass
class BoardOptions:
    """Draw the sheet to print: markers around a free middle, which tell where photographs were taken from, in metres.

    Print it at 100 %, stand the object on it, take photographs from all around, and give them to `gridreg reconstruct`.
    """

    out: Path
    """PDF to write."""
    paper: str = "a4"
    """What it is printed on: a4, letter or a3."""
    photographs: OptionalFolder = None
    """Folder to put example photographs in as well, of the built-in scene on this sheet, with the truth about them."""
    count: int = 8
    """How many photographs."""
    size: int = 1200
    """Longer edge of the photographs, pixels."""


def run(options: BoardOptions) -> int:
    """Write the sheet and say how large its page is.

    Raises:
        InputError: for an unknown paper, or what cannot be written.
    """
    from gridreg.scenes import builtin_photographs
    from gridreg.scenes.board import draw_board

    board = draw_board(options.out, options.paper)
    size = f"{1e3 * board.width:g} x {1e3 * board.height:g} mm"
    print(f"{options.out}: {board.paper}, {size}; print at 100 % and check its ruler")
    if options.photographs is not None:
        made = builtin_photographs(
            options.photographs, count=options.count, size=options.size, paper=board.paper
        )
        print(f"{made / 'photographs'}: {options.count} photographs; the truth about them: {made / 'truth'}")
    return 0
