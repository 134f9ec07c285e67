"""Summary of the grasps of many objects: a JSON file and a contact sheet of the last frames."""

import json
import pathlib
from collections.abc import Sequence

import numpy as np
from PIL import Image

from congrasp.common.io.files import write_atomically
from congrasp.services.grasp.files import THUMBNAIL
from congrasp.services.grasp.result import Result
from congrasp.services.viz.sheets import contact_sheet, save_png

SHEET = "summary.png"
_SUMMARY = "summary.json"
_COLUMNS = 6


def save_summary(out: pathlib.Path, hand: str, results: Sequence[Result]) -> None:
    """Writes the results of a hand as JSON, and the last frames of all grasps as one picture.

    Raises:
      CongraspError: a file cannot be written.
    """
    held = sum(result.held for result in results)
    rows = [_row(result) for result in results]
    summary = {"hand": hand, "objects": len(rows), "succeeded": held, "results": rows}
    write_atomically(out / _SUMMARY, json.dumps(summary, indent=2).encode())
    images = []
    labels = []
    for result in results:
        thumbnail = out / result.name / THUMBNAIL
        if result.error or not thumbnail.exists():
            continue
        images.append(np.asarray(Image.open(thumbnail).convert("RGB")))
        labels.append(_label(result))
    if not images:
        return
    title = f"{hand} hand: {held} of {len(rows)} objects held for two seconds without the table"
    columns = min(_COLUMNS, len(images))
    save_png(out / SHEET, contact_sheet(images, labels, columns=columns, title=title))


def _row(result: Result) -> dict[str, object]:
    """Entry of a result in the summary."""
    if result.error:
        return {"name": result.name, "error": result.error}
    return {"name": result.name, **result.facts}


def _label(result: Result) -> str:
    """Label of a picture: name, outcome and number of attempts that hold the object."""
    if not result.facts["shape_reliable"]:
        verdict = "SHAPE UNRELIABLE"
    elif result.held:
        verdict = "held"
    else:
        verdict = "NOT HELD"
    held = result.facts["attempts_held"]
    attempts = result.facts["attempts"]
    return f"{result.name}: {verdict}, {held} of {attempts}"
