"""The command line: ``gridreg COMMAND --help``."""

from gridreg.cli.ending import ending
from gridreg.cli.main import COMMANDS, main

__all__ = ["COMMANDS", "ending", "main"]
