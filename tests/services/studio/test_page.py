"""The page in a real browser, operated with the mouse, and checked by its picture."""

import json
import pathlib
import time
from typing import Any

import numpy as np
import pytest
from PIL import Image

from congrasp.common.episode.motion_file import load_motion
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport.keys import Keys
from congrasp.services.record.reader import read_episodes
from congrasp.services.studio.server import PageServer
from tests import studio as fake
from tests.browser import drag, on_object, orange, picture
from tests.studio import DIP, Site
from tests.waits import eventually

pytestmark = pytest.mark.timeout(240)
REFERENCE = pathlib.Path(__file__).with_name("first_picture.png")


def red(image: np.ndarray) -> np.ndarray:
    return (
        (image[..., 0] > 90)
        & (image[..., 0] > 2.2 * image[..., 1])
        & (image[..., 0] > 2.2 * image[..., 2])
    )


def grasp(page: Any, site: Site) -> str:
    """Grasps; returns the motion's number once it is shown.

    Server and page have separate deadlines, since either may take long on a busy machine.
    """
    before = {motion["id"] for motion in site.session.state()["motions"]}
    page.click("#grasp")
    (file,) = eventually(
        lambda: {motion["id"] for motion in site.session.state()["motions"]} - before
    )
    page.wait_for_selector(f"[data-motion='{file}'][data-shown]")
    page.wait_for_selector("#player:not([hidden])")
    return str(file)


def handle(page: Any, name: str) -> tuple[float, float]:
    picture(page)
    x, y = json.loads(page.get_attribute("#scene", "data-handles"))[name]
    box = page.locator("#scene").bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


@pytest.mark.slow
def test_the_first_picture_shows_hand_object_and_arrow(opened: Any) -> None:
    seen = picture(opened)
    small = np.asarray(
        Image.fromarray(seen.astype(np.uint8)).resize((96, 72), Image.Resampling.BOX)
    ).astype(int)
    reference = np.asarray(Image.open(REFERENCE).convert("RGB")).astype(int)
    # Buttons lie over the picture's upper and lower edge; fonts differ between machines.
    difference = np.abs(small - reference).max(-1)[12:-6]
    assert (difference > 40).mean() < 0.02, (
        "the picture is another than tests/services/studio/first_picture.png"
    )
    assert orange(seen).mean() > 0.01
    grey = np.ptp(seen, axis=-1) < 14
    shadow = grey & (abs(seen.mean(-1) - 0.8 * 219) < 8)  # on the table, which is 219 bright
    assert shadow[: len(seen) // 2].sum() < shadow[len(seen) // 2 :].sum()
    assert shadow.mean() > 0.003


@pytest.mark.slow
def test_the_brush_paints_the_surface_along_its_stroke(opened: Any, site: Site) -> None:
    x, y = on_object(opened)
    before = red(picture(opened)).sum()
    opened.click("[data-tool=avoid]")
    opened.mouse.move(x, y)  # the brush shows its preview, and paints nothing
    hovered = red(picture(opened)).sum()
    assert hovered > before + 50
    assert site.studio["avoid_share"] == 0
    opened.mouse.move(x, 5)
    assert red(picture(opened)).sum() < before + 10
    drag(opened, [(x, y), (x + 12, y + 4)])
    opened.wait_for_selector("[data-mask=affordance][data-on=true]")
    painted = site.studio["avoid_share"]
    assert painted > 0
    assert red(picture(opened)).sum() > before + 100
    opened.keyboard.press("Control+z")
    opened.wait_for_selector("[data-mask=affordance][data-on=false]")
    assert site.studio["avoid_share"] == 0
    assert opened.is_disabled("#undo") is False
    opened.keyboard.press("Control+Shift+Z")
    opened.wait_for_selector("[data-mask=affordance][data-on=true]")
    assert site.studio["avoid_share"] == painted
    assert opened.is_disabled("#redo")
    opened.click("[data-tool=graspable]")
    drag(opened, [(x, y), (x + 12, y + 4)])
    eventually(lambda: site.studio["avoid_share"] < painted)


@pytest.mark.slow
def test_the_arrow_is_placed_by_a_click_and_turned_by_its_tail(opened: Any, site: Site) -> None:
    before = site.studio["arrow"]
    opened.click("[data-tool=arrow]")
    opened.mouse.click(*on_object(opened))
    eventually(lambda: site.studio["arrow"] != before)
    site.do("set_rest_pose", rest=0)  # from above again, where both ends are in the picture
    opened.reload()
    opened.wait_for_selector("body[data-first-picture]")
    tail = handle(opened, "tail")
    drag(opened, [tail, (tail[0] + 60, tail[1] + 10)])
    turned = eventually(lambda: (arrow := site.studio["arrow"]) != before and arrow)
    angle = np.arccos(np.clip(np.dot(turned["direction"], before["direction"]), -1, 1))
    assert 0.05 < angle < 1.5
    opened.fill("#roll-number", "45")
    opened.press("#roll-number", "Enter")
    eventually(lambda: site.studio["roll_deg"] == 45.0 and opened.input_value("#roll") == "45")
    opened.focus("#roll")
    opened.keyboard.press("ArrowRight")
    eventually(
        lambda: site.studio["roll_deg"] > 45.0 and opened.input_value("#roll-number") != "45"
    )
    opened.click("#undo")
    eventually(lambda: opened.input_value("#roll-number") == "45")


@pytest.mark.slow
def test_a_wrist_path_is_drawn_with_one_stroke(opened: Any, site: Site) -> None:
    x, y = handle(opened, "tail")
    opened.click("[data-tool=path]")
    drag(opened, [(x + 220, y - 40), (x + 140, y - 70), (x + 60, y - 60), (x + 10, y)])
    opened.wait_for_selector("[data-mask=trajectory][data-on=true]")
    (path,) = (
        np.array(marker["points"])
        for marker in site.studio["markers"]
        if marker["kind"] == "polyline"
    )
    assert len(path) == fake.FakePolicy().task.trajectory_points
    assert np.linalg.norm(np.diff(path, axis=0), axis=-1).sum() > 0.05
    assert "wrist trajectory guides the wrist" in opened.inner_text("#explanation")


@pytest.mark.slow
def test_constraints_without_a_drawing_tool_are_set_by_flags(page: Any) -> None:
    grasping = fake.FakePolicy()
    grasping.task = TaskConfig(constraints=("heading", "affordance", "fingers"))
    session = fake.session(grasping)
    server = PageServer(lambda browser: session.routes, "127.0.0.1", 0)

    def fingers() -> list[str]:
        row = session.state()["studio"]["constraints"][-1]
        return [name for name, on in row["flags"]["allowed"].items() if on]

    page.goto(server.url)
    page.wait_for_selector("body[data-first-picture]")
    assert page.is_visible("[data-ask=affordance]")
    assert not page.is_visible("[data-ask=pose]")
    page.check("[data-ask=fingers]")
    page.wait_for_selector("[data-mask=fingers][data-on=true]")
    assert "Only the named fingers" in page.inner_text("#explanation")
    assert fingers() == [
        "thumb",
        "index",
    ]
    page.check("#constraints label:has-text('middle') input")
    eventually(lambda: fingers() == ["thumb", "index", "middle"])
    assert page.is_checked("[data-ask=fingers]")
    for name in ("index", "middle"):
        page.uncheck(f"#constraints label:has-text('{name}') input")
        eventually(lambda name=name: name not in fingers())
    page.wait_for_selector("#trouble:has-text('needs the thumb and another finger. Allow both')")
    assert page.is_disabled("#grasp")
    page.uncheck("[data-ask=fingers]")
    page.wait_for_selector("[data-mask=fingers][data-on=false]")
    assert page.is_enabled("#grasp")
    page.route("**/api/**", lambda route: route.abort())
    page.click("#grasp")
    page.wait_for_selector("#error:has-text('Disconnected: start the studio again')")
    page.expected = ["Failed to load resource: net::ERR_FAILED"] * 2
    server.close()
    session.close()


def test_a_grasp_is_played_scrubbed_read_and_saved(
    opened: Any, site: Site, tmp_path: pathlib.Path
) -> None:
    assert opened.input_value("#hand") == "of the run"
    still = picture(opened)
    tail = handle(opened, "tail")
    opened.fill("[data-phase=lift]", "0.15")
    opened.press("[data-phase=lift]", "Enter")
    eventually(lambda: site.session.state()["phases"]["lift"] == 0.15)
    grasp(opened, site)
    assert [
        item.get_attribute("data-lane") for item in opened.locator("#lanes [data-lane]").all()
    ] == [
        "contact",
        "heading",
    ]
    opened.select_option("#speed", "1")
    opened.wait_for_selector("#play:has-text('Play')")  # it has come to its end
    opened.locator("#scrub").fill("0")
    first = picture(opened)
    # A click at the end of the lanes: the hand has closed, the table is removed, and the heading is
    # met.
    box = opened.locator("#timeline").bounding_box()
    opened.mouse.click(box["x"] + 0.97 * box["width"], box["y"] + 10)
    opened.wait_for_selector("[data-lane=heading][data-met=true]")
    assert opened.inner_text("#time") != "0.00 s"
    assert "7.5 N" in opened.inner_text("#lanes")
    assert "Contact force, N" in opened.inner_text("#values")
    assert "Reward per step" in opened.inner_text("#values")
    assert "w_c: for all links in contact" in opened.get_attribute(
        "#values tr:has-text('Contact') >> nth=-1", "title"
    )
    last = picture(opened)
    for one, other in ((still, first), (first, last)):
        rows = min(len(one), len(other))
        assert (np.abs(one[:rows] - other[:rows]).max(-1) > 40).mean() > 0.01
    for kind in ("npz", "mcap", "glb"):
        with opened.expect_download() as download:
            opened.select_option("#save", kind)
        download.value.save_as(tmp_path / f"motion.{kind}")
    assert load_motion(tmp_path / "motion.npz").hand == "human"
    assert len(list(read_episodes(tmp_path / "motion.mcap"))) == 1
    assert (tmp_path / "motion.glb").read_bytes()[:4] == b"glTF"
    with opened.expect_download() as download:
        opened.select_option("#save", "png")
    download.value.save_as(tmp_path / "motion.png")
    assert Image.open(tmp_path / "motion.png").size == (1280, 720)
    opened.click("#edit")
    opened.wait_for_selector("#player", state="hidden")
    assert site.grasping.asked[-1][0].name == "mug_1"
    assert site.grasping.asked[-1][2] == (
        0.0,
        0.15,
        2.0,
    )
    # The constraints are seen from where they were
    assert handle(opened, "tail") == pytest.approx(tail, abs=1.0)


@pytest.mark.slow
def test_two_motions_are_compared_and_one_is_deleted(opened: Any, site: Site) -> None:
    first = grasp(opened, site)
    opened.check("[data-ask=affordance]")  # closes the motion, so that the edit is visible
    opened.wait_for_selector("#player", state="hidden")
    second = grasp(opened, site)
    opened.select_option("#speed", "1")
    opened.click(f"[data-motion='{first}'] .compare")
    opened.wait_for_selector("#names:not([hidden])")
    opened.wait_for_selector("#play:has-text('Play')")
    both = picture(opened)
    left = both[:, : both.shape[1] // 2]
    right = both[:, both.shape[1] // 2 :]
    # The affordance was of the second alone
    assert red(left).mean() > 0.001
    assert red(right).mean() < 0.0002
    assert orange(right).mean() > 0.005
    assert opened.inner_text("#values tr").split() == ["motion", second, "motion", first]
    opened.select_option("#layout", "over")
    over = picture(opened)
    middle = over[:, over.shape[1] // 4 : 3 * over.shape[1] // 4]
    assert red(middle).sum() > 0.8 * red(over).sum() > 0
    assert red(over[:, : over.shape[1] // 4]).sum() == 0
    opened.click(f"[data-motion='{first}'] .delete")
    opened.wait_for_selector(f"[data-motion='{first}']", state="detached")
    opened.wait_for_selector("#player", state="hidden")
    assert first not in [motion["id"] for motion in site.session.state()["motions"]]


@pytest.mark.slow
def test_on_a_phone_and_in_the_dark_everything_is_within_reach(opened: Any) -> None:
    opened.set_viewport_size({"width": 390, "height": 844})
    opened.emulate_media(color_scheme="dark")
    assert opened.evaluate("document.documentElement.scrollWidth") == 390
    assert opened.locator("#scene").bounding_box()["width"] == 390
    for place in (0, 300, 10_000):
        opened.locator("#studio").evaluate("(aside, place) => aside.scrollTo(0, place)", place)
        box = opened.locator("#grasp").bounding_box()
        assert box["y"] > 0
        assert box["y"] + box["height"] <= 844
        assert box["width"] > 300
    corner = picture(opened)[60, 5]  # next to the hand, above the table
    assert corner.max() < 60
    opened.emulate_media(color_scheme="light")
    assert picture(opened)[60, 5].min() > 200


@pytest.mark.slow
def test_an_import_keeps_a_mass_that_is_being_typed(
    opened: Any, site: Site, tmp_path: pathlib.Path
) -> None:
    (tmp_path / "mug.stl").write_bytes(b"something")
    opened.locator("#mass").press_sequentially("250")
    opened.set_input_files("#file", tmp_path / "mug.stl")
    opened.wait_for_selector("#facts:has-text('a bit small')")
    assert opened.input_value("#mass") == "250"
    opened.press("#mass", "Enter")
    eventually(lambda: site.studio["object"]["mass_g"] == 250)
    opened.set_input_files("#file", tmp_path / "mug.stl")
    eventually(lambda: opened.input_value("#mass") == "")
    assert site.studio["object"]["mass_g"] != 250


def test_a_mesh_is_opened_and_a_wrong_file_is_explained(
    opened: Any, site: Site, tmp_path: pathlib.Path
) -> None:
    for name in ("mug.stl", "mug.docx"):
        (tmp_path / name).write_bytes(b"something")
    opened.set_input_files("#file", tmp_path / "mug.docx")
    opened.wait_for_selector("#error:has-text('mug.docx is not an STL file')")
    opened.set_input_files("#file", tmp_path / "mug.stl")
    opened.wait_for_selector("#facts:has-text('a bit small')")
    assert site.studio["object"]["name"] == "bottle_5"
    assert opened.input_value("#object") == "bottle_5"
    assert opened.input_value("#unit") == "m"
    assert orange(picture(opened)).mean() > 0.005
    (tmp_path / "unknown.stl").write_bytes(b"something")
    opened.set_input_files("#file", tmp_path / "unknown.stl")
    opened.wait_for_selector(
        "#unit-question:has-text('In which unit are the numbers of unknown.stl?')"
    )
    assert "inches: 2.29 x 2.29 x 7.62 cm" in opened.inner_text("#unit")
    opened.select_option("#unit", "in")
    eventually(lambda: max(site.studio["object"]["size_cm"]) < 8)
    opened.wait_for_selector("#unit-question:has-text('Unit of unknown.stl')")
    opened.click("[data-rest='1']")
    opened.wait_for_selector("[data-rest='1'][aria-pressed=true]")
    assert site.studio["rest"]["index"] == 1
    eventually(
        lambda: (
            opened.evaluate("document.querySelector('[data-rest=\"1\"] img').naturalWidth") == 150
        )
    )


@pytest.mark.slow
def test_a_training_page_leads_from_a_dip_to_its_episodes(opened: Any, site: Site) -> None:
    opened.click("#show-training")
    opened.wait_for_selector("tr[data-actor=a099]", state="attached")
    # The studio's policy may be older than the run's, which a tile shows
    assert not opened.is_visible("#policy")
    assert opened.locator("tr[data-actor]").count() == 100
    assert opened.inner_text("[data-tile='largest lag'] b") == "2 versions"
    assert "Throughput" in opened.inner_text("figure[data-curve=steps_per_second]")
    assert "100,000 control steps/s" in opened.inner_text("figure[data-curve=steps_per_second]")
    assert "50.0 %" in opened.inner_text("[data-constraint=pose]")
    opened.fill("#filter", "a04")
    opened.wait_for_selector("tr[data-actor=a099]", state="detached")
    assert opened.locator("tr[data-actor]").count() == 10
    opened.click("tr[data-actor=a042]")
    opened.wait_for_selector("#result:has-text('thing-42')")
    # A newer episode of the actor that is watched takes its place by itself.
    site.window.take(
        Keys("fake").log("episode", "actor", "a042"), fake.actor_episode(77), time.time()
    )
    opened.wait_for_selector("#result:has-text('thing-77')")
    curve = opened.locator("figure[data-curve='episode/success'] canvas")
    box = curve.bounding_box()
    curve.click(position={"x": box["width"] * DIP / 59, "y": 30})
    opened.wait_for_selector("#found [data-episode]")
    assert "2 episodes within" in opened.inner_text("#found")
    assert f"update {DIP}" in opened.inner_text("#found")
    opened.click("#found [data-episode]")
    opened.wait_for_selector("#result:has-text('thing-2')")
    opened.click("#show-studio")
    opened.wait_for_selector("#player", state="hidden")
    # After the end of the run, without its learner, everything is still shown, without a warning.
    assert opened.locator("#curves figure").count() == 4
    site.window.take_status(fake.status(100) | {"finished": True}, time.time())
    site.window.take_status(None, time.time())
    opened.click("#show-training")
    opened.wait_for_selector("[data-tile=state] b:has-text('finished')")
    eventually(
        lambda: opened.locator("#curves figure").count() == len(site.window.view()["names"]) == 6
    )
    assert opened.inner_text("#run-trouble") == ""
    assert opened.inner_text("[data-tile=update] b") == "59"
