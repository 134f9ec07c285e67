"""A headless browser for the tests of the page; the trace of a failed test is kept in
test-results/.
"""

import contextlib
import os
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import pytest

from congrasp.common.errors import CongraspError
from tests.browser import SIZE, chromium
from tests.studio import Site
from tests.waits import eventually

ROOT = pathlib.Path(__file__).resolve().parents[3]
RESULTS = ROOT / "test-results"


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """`chromium`, once for all tests, which skip without it."""
    with contextlib.ExitStack() as stack:
        try:
            started = stack.enter_context(chromium())
        except CongraspError as error:
            pytest.skip(str(error))
        yield started


@pytest.fixture
def page(browser: Any, request: pytest.FixtureRequest, tmp_path: pathlib.Path) -> Iterator[Any]:
    """A page whose console must stay empty: errors and warnings there fail the test."""
    context = browser.new_context(viewport=SIZE, accept_downloads=True)
    context.set_default_timeout(60_000)
    # Without a picture of every frame, which costs more than drawing them: a failure keeps the last
    # one.
    context.tracing.start(screenshots=bool(os.environ.get("KEEP_TRACES")), snapshots=True)
    opened = context.new_page()
    messages: list[str] = []
    opened.on(
        "console",
        lambda message: (
            messages.append(message.text) if message.type in ("error", "warning") else None
        ),
    )
    opened.on("pageerror", lambda error: messages.append(str(error)))
    opened.messages = messages
    yield opened
    # Chromium itself warns when a frame is read back from a processor that draws.
    messages[:] = [text for text in messages if "GL Driver Message" not in text]
    if messages or getattr(request.node, "failed", True) or os.environ.get("KEEP_TRACES"):
        name = re.sub(r"\W+", "-", request.node.name)
        RESULTS.mkdir(exist_ok=True)
        opened.screenshot(path=RESULTS / f"{name}.png")
        context.tracing.stop(path=RESULTS / f"{name}.zip")
    context.close()
    assert messages == getattr(opened, "expected", [])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    opened = Site(tmp_path_factory.mktemp("recordings"))
    yield opened
    opened.server.close()
    opened.session.close()


@pytest.fixture
def opened(page: Any, site: Site) -> Any:
    """The page with a fresh mug."""
    if site.studio["object"]["name"] != "mug_1":
        site.do("object", name="mug")
        eventually(lambda: site.studio["object"]["name"] == "mug_1")
    for constraint in ("affordance", "pose", "trajectory"):
        site.do("ask", constraint=constraint, on=False)
    site.do("fill", avoid=False)
    site.do("set_rest_pose", rest=0)
    page.goto(site.server.url)
    page.wait_for_selector("body[data-first-picture]")
    return page


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    """Stores for the fixture whether its test failed."""
    report = yield
    if report.when == "call":
        item.failed = report.failed  # type: ignore[attr-defined]
    return report
