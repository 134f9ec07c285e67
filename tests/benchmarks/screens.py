"""The pictures of the studio in docs/images: the page in a browser, with the pretrained
policies.
"""

import contextlib
import pathlib
import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from tests.browser import SIZE, chromium, drag, on_object, picture
from tests.children import following

_PHONE = {"width": 390, "height": 844}
_HELD = 6
"""Most grasps until one is held."""
_SCRUB = 0.32
_SCRUB_RUN = 0.8
"""Shares of a motion, and of an episode of a training, at which they are shown."""


def screens(
    run: pathlib.Path | None = None, out: pathlib.Path = pathlib.Path("docs/images"), rest: int = 2
) -> int:
    """Screenshots of the studio: constraints, a motion, two motions, on a phone, and a training.

    Args:
      run: Folder of a finished training (`make quickstart` leaves one); without it that picture
        stays.
      out: Folder for the pictures.
      rest: Resting pose of the mug, counted from 0.

    Examples:
      python -m tests.benchmarks screens --run runs/quickstart
    """
    with chromium() as browser:
        if run:
            with _served(str(run)) as url:
                _training(_opened(browser, url, SIZE), out)
        with _served() as url:
            page = _opened(browser, url, SIZE)
            page.select_option("#object", "mug")
            page.click(f"[data-rest='{rest}']")
            page.wait_for_selector(f"[data-rest='{rest}'][aria-pressed=true]")
            _studio(page, out)
            phone = _opened(browser, url, _PHONE)
            loaded = (
                "() => [...document.querySelectorAll('#rests img')].every((one) => "
                "one.naturalWidth)"
            )
            phone.wait_for_function(loaded)
            phone.screenshot(path=out / "studio-phone.png")
    return 0


@contextlib.contextmanager
def _served(*arguments: str) -> Iterator[str]:
    """Address of a page of `congrasp view`."""
    command = [sys.executable, "-m", "congrasp", "view", *arguments, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=following()) as server:
        assert server.stdout
        try:
            yield next(
                address[0] for line in server.stdout if (address := re.search(r"http://\S+", line))
            )
        finally:
            server.terminate()


def _opened(browser: Any, url: str, size: dict[str, int]) -> Any:
    """The page in a window of this size."""
    page = browser.new_context(viewport=size).new_page()
    page.set_default_timeout(300_000)
    page.goto(url)
    page.wait_for_selector("body[data-first-picture]")
    return page


def _studio(page: Any, out: pathlib.Path) -> None:
    """Pictures of constraints, of a motion, and of two, in the dark."""
    page.check("[data-ask=pose]")
    page.wait_for_selector("[data-mask=pose_wrist][data-on=true]")
    page.click("[data-tool=avoid]")
    x, y = on_object(page)
    drag(page, [(x - 30, y - 60), (x - 25, y - 20), (x - 15, y + 10)])
    page.wait_for_selector("[data-mask=affordance]")
    page.mouse.move(x + 25, y - 30)
    picture(page)  # once everything is drawn
    page.screenshot(path=out / "studio.png")
    page.click("#clear-paint")
    page.uncheck("[data-ask=pose]")
    page.click("[data-tool=look]")
    first = _grasped(page)
    page.screenshot(path=out / "studio-motion.png")
    page.click("#edit")
    page.emulate_media(color_scheme="dark")
    page.click("button:has-text('Suggest') >> nth=0")
    _grasped(page)
    page.click(f"[data-motion='{first}'] .compare")
    page.wait_for_selector("#names:not([hidden])")
    _stopped(page, _SCRUB)
    page.locator("#values").scroll_into_view_if_needed()
    page.screenshot(path=out / "studio-compare.png")


def _grasped(page: Any) -> str:
    """Grasps until the object is held, and stops the motion in the grasp; returns the motion's
    number.
    """
    for _ in range(_HELD):
        before = {item.get_attribute("data-motion") for item in page.locator("[data-motion]").all()}
        page.click("#grasp")
        page.wait_for_function(
            "(n) => document.querySelectorAll('[data-motion]').length > n", arg=len(before)
        )
        (motion,) = {
            item.get_attribute("data-motion") for item in page.locator("[data-motion]").all()
        } - before
        page.wait_for_selector(f"[data-motion='{motion}'][data-shown]")
        if "not held" not in page.inner_text("#result") and "held" in page.inner_text("#result"):
            break
        page.click("#edit")
    _stopped(page, _SCRUB)
    return str(motion)


def _stopped(page: Any, share: float) -> None:
    """Waits for the end of the motion, and shows it at a share of its length."""
    page.select_option("#speed", "1")
    page.wait_for_selector("#play:has-text('Play')")
    page.locator("#scrub").fill(str(round(share * float(page.get_attribute("#scrub", "max")))))
    picture(page)  # once everything is drawn


def _training(page: Any, out: pathlib.Path) -> None:
    """Picture of a finished training with its newest episode."""
    page.click("#show-training")
    page.wait_for_selector("#curves figure")
    page.click("tr[data-actor] >> nth=0")
    page.wait_for_selector("#player:not([hidden])")
    _stopped(page, _SCRUB_RUN)
    page.locator("#training").evaluate("(aside) => aside.scrollTo(0, 0)")
    page.screenshot(path=out / "training-window.png")
