"""Width of the terminal, which containers and serial lines report as zero or one."""

import os
import shutil

_MIN_COLUMNS = 40
"""Fewest columns in which a table is still legible."""
_DEFAULT_COLUMNS = 80
_MAX_COLUMNS = 1000
"""Most columns; a greater number is not the width of a terminal."""


def ensure_width() -> None:
    """Sets `COLUMNS`, which rich and tyro obey, if the terminal's width is unusable."""
    columns = shutil.get_terminal_size((_DEFAULT_COLUMNS, 24)).columns
    if columns < _MIN_COLUMNS:
        os.environ["COLUMNS"] = str(_DEFAULT_COLUMNS)
    elif columns > _MAX_COLUMNS:
        os.environ["COLUMNS"] = str(_MAX_COLUMNS)
    elif "COLUMNS" in os.environ:
        os.environ["COLUMNS"] = str(columns)  # the variable may be zero or not a number
    if os.environ.get("LINES", "1").lstrip("0") == "":  # zero or empty
        del os.environ["LINES"]
