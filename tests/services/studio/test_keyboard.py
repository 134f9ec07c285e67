"""The page operated by the keyboard, and what assistive technology and eyes find in it."""

import pathlib
from typing import Any

import numpy as np
import pytest

from tests.browser import picture
from tests.contrast import LEAST_TEXT, contrast
from tests.studio import DIP, Site
from tests.waits import eventually

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]

NAME = """(control) => {
  const name = control.getAttribute("aria-label") ?? control.labels?.[0]?.textContent ?? control.textContent;
  return [control.localName, control.id, ...Object.values(control.dataset), name.trim()].join(" ");
}"""
"""A name of a control that it has also after it was written again."""

CONTROLS = f"""() => {{
  const all = document.querySelectorAll("a, button, input, select, textarea, [tabindex]");
  return Array.from(all).filter((one) => one.checkVisibility() && !one.disabled).map({NAME});
}}"""
"""Names of the controls that are visible and enabled."""

FOCUSED = f"""() => {{
  const control = document.activeElement;
  if (control === document.body) return null;
  const ring = getComputedStyle(control.type === "file" ? control.parentElement : control);
  const box = control.getBoundingClientRect();
  const top = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
  return {{
    name: ({NAME})(control),
    ring: ring.outlineStyle === "none" ? 0 : parseFloat(ring.outlineWidth),
    seen: control.contains(top) || top?.contains(control) || control.labels?.[0]?.contains(top),
  }};
}}"""
"""The focused control: its name, the width of its ring, and true if no other element hides it."""

TEXTS = """() => {
  const hex = (colour) => "#" + colour.match(/[\\d.]+/g).slice(0, 3)
    .map((value) => Math.round(value).toString(16).padStart(2, "0")).join("");
  const clear = (colour) => colour === "transparent" || /, 0\\)$/.test(colour);
  const pairs = new Map();
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const parent = texts.currentNode.parentElement;
    const empty = !texts.currentNode.textContent.trim();
    if (empty || !parent.checkVisibility() || parent.closest("script, option, :disabled")) continue;
    let behind = parent;
    while (behind && clear(getComputedStyle(behind).backgroundColor)) behind = behind.parentElement;
    const front = hex(getComputedStyle(parent).color);
    const back = hex(getComputedStyle(behind ?? document.body).backgroundColor);
    pairs.set(front + back, [front, back, texts.currentNode.textContent.trim().slice(0, 40)]);
  }
  return [...pairs.values()];
}"""
"""Every pair of a text's colour and that of its background, with a text that has it."""


def walk(page: Any) -> list[dict[str, Any]]:
    """Presses Tab once round the page; returns the controls that had the focus."""
    controls = page.evaluate(CONTROLS)
    focused = []
    for _ in range(len(controls) + 5):
        page.keyboard.press("Tab")
        control = page.evaluate(FOCUSED)
        if control is not None:
            focused.append(control)
    assert set(controls) == {control["name"] for control in focused}
    return focused


def unnamed(page: Any) -> list[str]:
    """Roles of the focusable elements of the accessibility tree that have no name."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    missing = []
    for node in nodes:
        properties = {
            entry["name"]: entry["value"].get("value") for entry in node.get("properties", ())
        }
        role = node.get("role", {}).get("value", "")
        if node["ignored"] or role == "RootWebArea" or not properties.get("focusable"):
            continue
        if not node.get("name", {}).get("value", "").strip(" \u00d7"):
            missing.append(role)
    return missing


def check(page: Any) -> None:
    """Every control is reached, has a ring of 2 pixels, is seen and has a name; texts have
    sufficient contrast in light and dark.
    """
    for control in walk(page):
        assert control["ring"] >= 2, control["name"]
        assert control["seen"], control["name"]
    assert unnamed(page) == []
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        for front, back, text in page.evaluate(TEXTS):
            assert contrast(front, back) >= LEAST_TEXT, (scheme, front, back, text)


def press(page: Any, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


def changed(page: Any, before: np.ndarray) -> bool:
    return bool((np.abs(picture(page) - before).max(-1) > 40).mean() > 0.01)


def choose(page: Any, tool: str) -> None:
    """Chooses a tool by the keyboard and returns to the scene."""
    page.focus(f"[data-tool={tool}]")
    press(page, "Enter")
    page.focus("#scene")


def test_the_studio_is_accessible(opened: Any) -> None:
    check(opened)


def test_a_motion_is_accessible(opened: Any, site: Site) -> None:
    opened.focus("#grasp")
    press(opened, "Enter")
    opened.wait_for_selector("#player:not([hidden])")
    opened.wait_for_selector("#play:has-text('Play')")
    check(opened)
    opened.focus("#scene")
    before = picture(opened)
    press(opened, *["Shift+ArrowRight"] * 5)
    assert changed(opened, before)
    opened.focus("#motions .delete")
    count = len(site.session.state()["motions"])
    press(opened, "Enter")
    eventually(lambda: len(site.session.state()["motions"]) == count - 1)


def test_the_training_is_accessible(opened: Any) -> None:
    opened.focus("#show-training")
    press(opened, "Enter")
    opened.wait_for_selector("tr[data-actor=a099]", state="attached")
    opened.fill("#filter", "a04")
    opened.wait_for_selector("tr[data-actor=a099]", state="detached")
    opened.wait_for_selector("figure[data-curve='episode/success']")
    check(opened)
    opened.focus("tr[data-actor=a042] button")
    press(opened, "Enter")
    opened.wait_for_selector("#result:has-text('thing-')")
    # The table is written again every second.
    opened.wait_for_timeout(2500)
    assert opened.evaluate("document.activeElement.textContent") == "a042"
    curve = opened.locator("figure[data-curve='episode/success'] canvas")
    curve.focus()
    press(opened, "Home", *["ArrowRight"] * DIP)
    assert f"update {DIP}:" in curve.get_attribute("aria-valuetext")
    press(opened, "Enter")
    opened.wait_for_selector("#found [data-episode]")
    assert "2 episodes within" in opened.inner_text("#found")


def test_keys_turn_move_and_zoom_the_view(opened: Any) -> None:
    opened.focus("#scene")
    for key in ("ArrowRight", "ArrowUp", "Shift+ArrowLeft", "Control+ArrowDown", "+", "-"):
        before = picture(opened)
        press(opened, *[key] * 4)
        assert changed(opened, before), key


def test_the_crosshair_places_the_arrow(opened: Any, site: Site) -> None:
    before = site.studio["arrow"]["position"]
    choose(opened, "arrow")
    press(opened, "Enter", *["ArrowDown"] * 4, "Enter")
    eventually(lambda: site.studio["arrow"]["position"] != before)


def test_the_crosshair_paints(opened: Any, site: Site) -> None:
    choose(opened, "avoid")
    press(opened, *["ArrowDown"] * 4, "Enter", *["ArrowRight"] * 3, "Enter")
    eventually(lambda: site.studio["avoid_share"] > 0)


def test_the_crosshair_draws_a_path(opened: Any, site: Site) -> None:
    choose(opened, "path")
    press(opened, *["ArrowUp"] * 20, "Enter", *["ArrowDown"] * 15, "Enter")
    eventually(lambda: "trajectory" in site.studio["asked"])


def test_escape_drops_a_stroke(opened: Any, site: Site) -> None:
    choose(opened, "avoid")
    press(opened, *["ArrowDown"] * 4, "Enter", "ArrowRight", "Escape")
    opened.wait_for_selector("#crosshair", state="hidden")
    assert site.studio["avoid_share"] == 0


def test_a_mesh_is_opened_by_keyboard(opened: Any, site: Site, tmp_path: pathlib.Path) -> None:
    (tmp_path / "mug.stl").write_bytes(b"something")
    opened.focus("#file")
    with opened.expect_file_chooser() as chooser:
        press(opened, "Enter")
    chooser.value.set_files(tmp_path / "mug.stl")
    eventually(lambda: site.studio["object"]["name"] == "bottle_5")
