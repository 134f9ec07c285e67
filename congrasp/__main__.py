"""Runs the command line: `python -m congrasp`."""

from congrasp.services.cli.main import main

main()
