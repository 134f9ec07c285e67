"""Chromium without a graphics card, and what a user sees and does in the studio's page."""

import contextlib
import io
import pathlib
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
from PIL import Image

from congrasp.common.errors import CongraspError

SIZE = {"width": 1280, "height": 760}
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--force-color-profile=srgb",
]


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """Chromium, drawing without a graphics card; raises a CongraspError if it or its package is
    absent.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        raise CongraspError(
            "The package playwright is not installed.", "Run 'make install'."
        ) from None
    with sync_playwright() as running:
        bundled = pathlib.Path(running.chromium.executable_path)
        installed = next(filter(None, map(shutil.which, BROWSERS)), None) or (
            str(bundled) if bundled.exists() else None
        )
        if installed is None:
            raise CongraspError("There is no browser here.", "Run tests/install_browser.sh.")
        started = running.chromium.launch(executable_path=installed, args=ARGUMENTS)
        yield started
        started.close()


def picture(page: Any) -> np.ndarray:
    """(H, W, 3) the three-dimensional picture, 0 to 255, once all requests are done."""
    page.wait_for_selector("body:not([data-busy])")
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    image = Image.open(io.BytesIO(page.locator("#scene").screenshot())).convert("RGB")
    return np.asarray(image).astype(int)


def orange(image: np.ndarray) -> np.ndarray:
    return (
        (image[..., 0] > 130)
        & (image[..., 0] > 1.25 * image[..., 1])
        & (image[..., 1] > 1.6 * image[..., 2])
    )


def on_object(page: Any) -> tuple[float, float]:
    """A point of the page on the object, away from the arrow."""
    is_object = orange(picture(page))
    rows, columns = np.nonzero(is_object)
    low = rows > np.percentile(rows, 70)
    box = page.locator("#scene").bounding_box()
    return box["x"] + float(np.median(columns[low])), box["y"] + float(np.median(rows[low]))


def drag(page: Any, points: list[tuple[float, float]]) -> None:
    page.mouse.move(*points[0])
    page.mouse.down()
    for point in points[1:]:
        page.mouse.move(*point, steps=4)
    page.mouse.up()
