"""Measures the page in a headless browser: python -m tests.services.studio.measure [URL]

Without the address of a studio it opens one on a made-up grasp of an object of 10,000 faces. Prints how long the first
frame takes, and the frames drawn in each second while the grasp is played.
"""

import contextlib
import dataclasses
import shutil
import sys
from collections.abc import Iterator

import numpy as np
import trimesh
from playwright.sync_api import sync_playwright

from congrasp.actors.attempts import Phases
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.wire.codec import Message
from congrasp.services.studio.catalogue import Catalogue
from congrasp.services.studio.server import PageServer
from congrasp.services.studio.session import Session
from tests.services.studio.conftest import BROWSERS, SIZE
from tests.studio import MadeUpGrasping, MadeUpImporter

SECONDS = 8
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
"""As on a machine without a graphics card: the processor draws the scene, and puts the page together."""


def many_faces() -> trimesh.Trimesh:
    """A bumpy ball of as many faces."""
    mesh = trimesh.creation.uv_sphere(0.04, count=(51, 100))
    mesh.vertices *= 1 + 0.05 * np.sin(300 * mesh.vertices).sum(-1, keepdims=True)
    return mesh


class Fine(MadeUpGrasping):
    """Its grasps are of that object."""

    def grasp(self, obj: GraspObject, request: GraspRequest, phases: Phases, progress: object) -> Message:
        made, mesh = super().grasp(obj, request, phases, lambda text, share: None), many_faces()
        arrays = {**made.arrays, "visual_vertices": np.asarray(mesh.vertices, np.float32)}
        return Message(arrays | {"visual_faces": np.asarray(mesh.faces, np.int32)}, made.meta)


def fine_object() -> GraspObject:
    mesh, ball = many_faces(), procedural.generate(1, "ball")
    faces = np.asarray(mesh.faces, np.int32)
    return dataclasses.replace(ball, visual_vertices=np.asarray(mesh.vertices, np.float32), visual_faces=faces)


@contextlib.contextmanager
def studio() -> Iterator[str]:
    """The address of a studio on that object."""
    session = Session({"human": Fine}, Catalogue({"ball": fine_object}), MadeUpImporter())
    server = PageServer(lambda browser: session.routes, "127.0.0.1", 0)
    yield server.url
    server.close()
    session.close()


def main() -> None:
    """Measures and prints."""
    with contextlib.ExitStack() as stack:
        url = sys.argv[1] if len(sys.argv) > 1 else stack.enter_context(studio())
        playwright = stack.enter_context(sync_playwright())
        found = next(filter(None, map(shutil.which, BROWSERS)), None)
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        page = browser.new_page(viewport=SIZE)
        errors: list[str] = []
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(url)
        page.wait_for_selector("body[data-first-picture]")
        print(f"{page.inner_text('#facts')}; first frame after {page.get_attribute('body', 'data-first-picture')} ms")
        page.click("#grasp")
        page.wait_for_selector("#player:not([hidden])", timeout=120_000)
        page.select_option("#speed", "0.1")
        rates = []
        for _ in range(SECONDS):
            page.wait_for_timeout(1000)
            if page.inner_text("#play") == "Play":  # the motion has come to its end
                page.click("#play")
                page.wait_for_timeout(1000)
            rates.append(int((page.inner_text("#frames") or "0").split()[0]))
        print(f"fps while playing: {rates[1:]}; median {int(np.median(rates[1:]))}")
        print(f"errors on the console: {len(errors)}")
        browser.close()


if __name__ == "__main__":
    main()
