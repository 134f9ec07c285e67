"""Contact sheets, PNG files and videos."""

import io
import pathlib
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from congrasp.common.errors import CongraspError, need_package, os_errors_as
from congrasp.common.io.files import write_atomically
from congrasp.services.appearance.palette import INK

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

_QUIET = (96, 103, 116)
_PAPER = (251, 251, 252)
_MARGIN = 10
_LABEL_HEIGHT = 24
_TITLE_HEIGHT = 44
_LABEL_SIZE = 14
_TITLE_SIZE = 19
_SMALLEST_SIZE = 8
"""Sizes in pixels."""


def contact_sheet(
    images: Sequence[np.ndarray], labels: Sequence[str], columns: int, title: str = ""
) -> np.ndarray:
    """Pictures in rows, each with its label below it, under a title.

    Args:
      images: (height, width, 3) uint8, all of one size.
      labels: one for each picture; shrunk and cut until it fits, as is the title. Different ones
        that would then look equal get the picture's number.
      columns: pictures in a row.
      title: one line.

    Returns:
      (H, W, 3) uint8.

    Raises:
      CongraspError: there are no pictures, or not one label for each.
    """
    if not images or len(images) != len(labels):
        raise CongraspError(
            f"{len(images)} pictures and {len(labels)} labels do not make a contact sheet."
        )
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    top = _TITLE_HEIGHT if title else _MARGIN
    sheet_width = columns * (width + _MARGIN) + _MARGIN
    sheet_height = top + rows * (height + _LABEL_HEIGHT) + _MARGIN
    sheet = Image.new("RGB", (sheet_width, sheet_height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    if title:
        text, font = _fitted(title, _TITLE_SIZE, sheet_width - 2 * _MARGIN)
        draw.text((_MARGIN + 2, _TITLE_HEIGHT // 2), text, INK, font, anchor="lm")
    for i, (image, label) in enumerate(zip(images, _distinct(labels, width), strict=True)):
        row, column = divmod(i, columns)
        x = _MARGIN + column * (width + _MARGIN)
        y = top + row * (height + _LABEL_HEIGHT)
        sheet.paste(Image.fromarray(image), (x, y))
        text, font = _fitted(label, _LABEL_SIZE, width)
        middle = y + height + _LABEL_HEIGHT // 2
        draw.text((x + 2, middle), text, _QUIET, font, anchor="lm")
    return np.asarray(sheet)


def _distinct(labels: Sequence[str], width: int) -> list[str]:
    """Labels of pictures of a width; those that look equal when they are cut get a number."""
    cut = {label: _fitted(label, _LABEL_SIZE, width)[0] for label in labels}
    looks = list(cut.values())
    distinct = []
    for number, label in enumerate(labels, 1):
        is_unclear = looks.count(cut[label]) > 1
        distinct.append(f"{number}: {label}" if is_unclear else label)
    return distinct


def stacked(sheets: Sequence[np.ndarray]) -> np.ndarray:
    """Sheets (H, W, 3) stacked vertically, as wide as the widest one."""
    width = max(sheet.shape[1] for sheet in sheets)
    wide = [np.full((len(sheet), width, 3), _PAPER, np.uint8) for sheet in sheets]
    for whole, sheet in zip(wide, sheets, strict=True):
        whole[:, : sheet.shape[1]] = sheet
    return np.concatenate(wide)


def with_lines(sheet: np.ndarray, lines: Sequence[str]) -> np.ndarray:
    """A sheet (H, W, 3) with lines of text below it; long ones continue in the next line."""
    width = sheet.shape[1]
    font = ImageFont.load_default(_LABEL_SIZE)
    wrapped: list[str] = []
    for line in lines:
        wrapped += _wrapped(line, font, width - 2 * _MARGIN)
    if not wrapped:
        return sheet
    below = Image.new("RGB", (width, len(wrapped) * _LABEL_HEIGHT + _MARGIN), _PAPER)
    draw = ImageDraw.Draw(below)
    for i, line in enumerate(wrapped):
        middle = i * _LABEL_HEIGHT + _LABEL_HEIGHT // 2
        draw.text((_MARGIN + 2, middle), line, _QUIET, font, anchor="lm")
    return np.concatenate([sheet, np.asarray(below)])


def _wrapped(text: str, font: Font, width: int) -> list[str]:
    """A text in lines of at most a width in pixels, broken between words."""
    lines: list[str] = []
    line = ""
    for word in text.split():
        longer = f"{line} {word}".strip()
        if line and font.getlength(longer) > width:
            lines.append(line)
            longer = word
        line = longer
    return [*lines, line]


def _fitted(text: str, size: int, width: int) -> tuple[str, Font]:
    """A text and the largest font up to a size with which it fits a width in pixels.

    A text that is too long for the smallest font loses its middle.
    """
    font = ImageFont.load_default(size)
    while font.getlength(text) > width and size > _SMALLEST_SIZE:
        size -= 1
        font = ImageFont.load_default(size)
    half = len(text) // 2
    shortened = text
    for cut in range(1, half):
        if font.getlength(shortened) <= width:
            break
        shortened = f"{text[: half - cut]}…{text[half + cut :]}"
    return shortened, font


def png_of(image: np.ndarray) -> bytes:
    """(H, W, 3) uint8 as a PNG file's content."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def save_png(path: pathlib.Path, image: np.ndarray) -> None:
    """Writes (H, W, 3) uint8 as PNG, atomically; raises a CongraspError if the path cannot be
    written.
    """
    write_atomically(path, png_of(image))


def save_video(
    path: pathlib.Path,
    frames: Iterable[np.ndarray],
    size: tuple[int, int],
    frame_rate: float,
    encoding: Sequence[str] = (),
) -> None:
    """Writes pictures (height, width, 3) uint8 of `size` (width, height, both even) as an MP4
    (H.264).

    `encoding` are further options of ffmpeg for the file.

    Raises:
      CongraspError: the package for videos is absent, or the file cannot be written.
    """
    need_package("A video", "imageio_ffmpeg")
    import imageio_ffmpeg

    with os_errors_as(f"{path} could not be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = imageio_ffmpeg.write_frames(
            str(path),
            size,
            fps=frame_rate,
            quality=8,
            macro_block_size=2,
            output_params=[*encoding],
        )
        with (
            warnings.catch_warnings()
        ):  # JAX warns of forks, which are safe if another program is executed
            warnings.simplefilter("ignore", RuntimeWarning)
            writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
