"""Width of the terminal, which containers and serial lines report as zero or one."""

import os
import shutil

_LEAST = 40
"""Columns in which a table is still legible."""
_USUAL = 80
_MOST = 1000


def ensure_width() -> None:
    """Sets `COLUMNS`, which rich and tyro obey, where the terminal's width is unusable."""
    columns = shutil.get_terminal_size((_USUAL, 24)).columns
    if columns < _LEAST:
        os.environ["COLUMNS"] = str(_USUAL)
    elif columns > _MOST:
        os.environ["COLUMNS"] = str(_MOST)
    elif "COLUMNS" in os.environ:
        os.environ["COLUMNS"] = str(columns)  # also if it is zero or not a number
    if os.environ.get("LINES", "1").lstrip("0") == "":
        del os.environ["LINES"]
