"""Runs the command line: `python -m congrasp`."""

import sys

if not sys.flags.safe_path:
    # The current folder, whose modules must not replace those of Python, comes last
    sys.path.append(sys.path.pop(0))

from congrasp.services.cli.main import main

main()
