"""``python -m gridreg`` is the command ``gridreg``."""

import sys

from gridreg.cli import main

if __name__ == "__main__":
    sys.exit(main())
