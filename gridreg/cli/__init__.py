"""The command line: ``gridreg COMMAND --help``."""

from gridreg.cli.exit_status import run_cli
from gridreg.cli.main import COMMANDS, main

__all__ = ["COMMANDS", "run_cli", "main"]
