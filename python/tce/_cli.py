"""The command ``tce``, as the program without Python has it."""

from __future__ import annotations

import signal
import sys

from . import _tce
from ._sim import find_library


def main() -> None:
    """Runs the command line and ends the process with its exit code."""
    # The program listens to Ctrl-C itself, and ends at a checkpoint.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    find_library()
    sys.exit(_tce.main(["tce", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
