"""Pictures that are composed of others: `python -m tests.pictures.composed NAME`."""

import pathlib
import sys
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

from congrasp.services.cli.parser import of_group
from congrasp.services.grasp.files import RECORDING
from congrasp.services.record.reader import pick_episode
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.sheets import contact_sheet, save_png, stacked

_ROWS = {
    "heading": "camera",
    "affordance": "mug",
    "pose": "bottle-pose",
    "trajectory": "bulb-path",
}
"""Grasps of the gallery, by their strongest constraint."""
_COLUMNS = 4
_SIZE = (360, 270)
_QUALITY = 88
"""Quality of JPEG files."""


def constraints(gallery: pathlib.Path, out: pathlib.Path) -> int:
    """A grasp under each constraint, in four steps.

    Args:
      gallery: Working folder of the gallery, with its grasps.
      out: The PNG file to write.
    """
    images: list[np.ndarray] = []
    labels: list[str] = []
    for constraint, name in _ROWS.items():
        (recording,) = (gallery / name).glob(f"*/{RECORDING}")
        episode = pick_episode(recording, -1, success=False)
        first = f"{constraint}: 0.00 s, {episode.object}"
        pictures, captions = episode_strip(episode, _COLUMNS, _SIZE, first, ", held")
        images += pictures
        labels += captions
    title = "human hand: one grasp under each constraint"
    save_png(out, contact_sheet(images, labels, columns=_COLUMNS, title=title))
    return 0


def stack(
    pictures: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional], out: pathlib.Path
) -> int:
    """Pictures below one another.

    Args:
      pictures: PNG files.
      out: The PNG file to write.
    """
    sheets = [np.asarray(Image.open(path).convert("RGB")) for path in pictures]
    save_png(out, stacked(sheets))
    return 0


def shrink(picture: Annotated[pathlib.Path, tyro.conf.Positional], out: pathlib.Path) -> int:
    """A picture as a JPEG file of two thirds of its size.

    Args:
      picture: PNG file.
      out: The JPEG file to write.
    """
    image = Image.open(picture).convert("RGB")
    image.resize((image.width * 2 // 3, image.height * 2 // 3)).save(out, quality=_QUALITY)
    return 0


if __name__ == "__main__":
    commands = {"constraints": constraints, "shrink": shrink, "stack": stack}
    sys.exit(of_group(commands, "python -m tests.pictures.composed", __doc__)(sys.argv[1:])())
