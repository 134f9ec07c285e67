"""Contact sheets, PNG files and videos."""

import io
import pathlib
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from congrasp.common.errors import CongraspError, need_package, os_errors_as
from congrasp.common.io.files import write_atomically
from congrasp.services.record.palette import INK

_QUIET, _PAPER = (96, 103, 116), (251, 251, 252)
_MARGIN, _LABEL, _TITLE = 10, 24, 44  # pixels


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
    top = _TITLE if title else _MARGIN
    sheet = Image.new(
        "RGB",
        (columns * (width + _MARGIN) + _MARGIN, top + rows * (height + _LABEL) + _MARGIN),
        _PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    if title:
        title, font = _fitted(title, 19, sheet.width - 2 * _MARGIN)
        draw.text((_MARGIN + 2, _TITLE // 2), title, INK, font, anchor="lm")
    cut = {label: _fitted(label, 14, width)[0] for label in labels}
    for i, (image, label) in enumerate(zip(images, labels, strict=True)):
        x, y = _MARGIN + i % columns * (width + _MARGIN), top + i // columns * (height + _LABEL)
        sheet.paste(Image.fromarray(image), (x, y))
        alike = [*cut.values()].count(cut[label]) > 1
        label, font = _fitted(f"{i + 1}: {label}" if alike else label, 14, width)
        draw.text((x + 2, y + height + _LABEL // 2), label, _QUIET, font, anchor="lm")
    return np.asarray(sheet)


def stacked(sheets: Sequence[np.ndarray]) -> np.ndarray:
    """Sheets (H, W, 3) stacked vertically, as wide as the widest one."""
    width = max(sheet.shape[1] for sheet in sheets)
    wide = [np.full((len(sheet), width, 3), _PAPER, np.uint8) for sheet in sheets]
    for whole, sheet in zip(wide, sheets, strict=True):
        whole[:, : sheet.shape[1]] = sheet
    return np.concatenate(wide)


def _fitted(
    text: str, size: int, width: int
) -> tuple[str, ImageFont.FreeTypeFont | ImageFont.ImageFont]:
    """A text and the largest font up to a size with which it fits a width in pixels; a longer one
    loses its middle.
    """
    while (font := ImageFont.load_default(size)).getlength(text) > width and size > 8:
        size -= 1
    half, shown = len(text) // 2, text
    for cut in range(1, half):
        if font.getlength(shown) <= width:
            break
        shown = f"{text[: half - cut]}…{text[half + cut :]}"
    return shown, font


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
