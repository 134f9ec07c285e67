"""Actions of the studio's user, and the effects of the priority rules."""

import dataclasses
import itertools

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.objects import procedural
from congrasp.common.objects.shapes import matrix
from congrasp.common.task.sampling.headings import BACK_OFF, INWARD
from congrasp.services.studio.page import describe
from congrasp.services.studio.state import ACTIONS, History, Studio
from tests.task import HAND, TASK

MUG = procedural.generate(1, "mug")


@pytest.fixture
def studio() -> Studio:
    return Studio(HAND, TASK, MUG)


def masks(studio: Studio) -> set[str]:
    return {name for name, on in describe(studio)["active"]["masks"].items() if on}


def test_a_new_object_can_be_grasped_from_above_at_once(studio: Studio) -> None:
    assert studio.trouble == ""
    request = studio.request
    assert tuple(request.constraints) == ("heading",)
    down = matrix(MUG.rest_poses[0][3:]) @ studio.arrow.direction
    np.testing.assert_allclose(down, [0, 0, -1], atol=1e-6)
    assert studio.explanation == ["The heading guides the wrist."]
    assert masks(studio) == set()


def test_drawing_tools_follow_from_goal_arrays(studio: Studio) -> None:
    tools = {row["name"]: row["tool"] for row in describe(studio)["constraints"]}
    assert {name: tool for name, tool in tools.items() if tool} == {
        "heading": "arrow",
        "affordance": "paint",
        "pose": "hand",
        "trajectory": "path",
    }
    lacking = Studio(HAND, dataclasses.replace(TASK, constraints=("heading",)), MUG)
    with pytest.raises(
        CongraspError,
        match=r"no constraint of the tool 'path'\. Choose from its constraints: heading",
    ):
        lacking.draw([[0.0, 0.0, 0.3], [0.0, 0.0, 0.1]])


def test_the_hand_begins_before_the_arrow_and_aligned_with_it(studio: Studio) -> None:
    studio.task = dataclasses.replace(studio.task, preshape=False)
    hand = studio.hand
    rest = MUG.rest_poses[0]
    start = describe(studio)["start"]
    wrist = np.array(start["position"][0])
    turn = matrix(np.array(start["quaternion"][0]))
    center = wrist + turn @ grasp_frame(hand).center
    target = rest[:3] + matrix(rest[3:]) @ studio.arrow.position
    np.testing.assert_allclose(center, target + np.array([0, 0, BACK_OFF]), atol=1e-4)
    np.testing.assert_allclose(turn @ grasp_frame(hand).heading, [0, 0, -1], atol=1e-4)


def test_the_brush_labels_points_and_requests_the_affordance(studio: Studio) -> None:
    center = MUG.points[0]
    studio.paint([center], 0.02, avoid=True)
    far = np.linalg.norm(MUG.points - center, axis=-1)
    np.testing.assert_array_equal(studio.canvas.avoid, far <= 0.02)
    distance = np.linalg.norm(studio.canvas.vertices - center, axis=-1)
    np.testing.assert_array_equal(studio.canvas.paint.shown, distance <= 0.02)
    assert studio.asked == masks(studio) == {"affordance"}
    np.testing.assert_array_equal(studio.labelled.non_graspable_points, studio.canvas.avoid)
    np.testing.assert_array_equal(studio.request.avoid, studio.canvas.avoid)
    studio.paint([center], 0.03, avoid=False)
    assert not studio.canvas.avoid.any()
    assert studio.asked == set()


def test_without_paint_the_affordance_takes_the_parts_of_the_object(studio: Studio) -> None:
    studio.ask("affordance", True)
    np.testing.assert_array_equal(studio.canvas.avoid, MUG.non_graspable_points)
    assert 0 < studio.canvas.paint.shown.mean() < 1


def test_the_rules_are_explained_and_set_the_masks(studio: Studio) -> None:
    studio.ask("affordance", True)
    studio.ask("pose", True)
    assert masks(studio) == {"pose_finger", "pose_wrist"}
    assert any("affordance is overridden" in line for line in studio.explanation)
    studio.ask("trajectory", True)
    assert masks(studio) == {"pose_finger", "trajectory"}
    assert "guides the wrist" in studio.explanation[0]
    assert "trajectory" in studio.explanation[0]
    studio.ask("pose", False)
    studio.ask("affordance", False)
    assert tuple(studio.request.constraints) == ("heading", "trajectory")


def test_the_affordance_redirects_an_arrow_that_comes_to_the_paint(studio: Studio) -> None:
    studio.paint([studio.arrow.position - INWARD * studio.arrow.direction], 0.03, avoid=True)
    view = describe(studio)
    assert view["active"]["overruled"]
    assert any("redirected to the graspable region" in line for line in view["explanation"])
    # It goes elsewhere, the same way: the paint is left by a step aside.
    assert np.linalg.norm(np.subtract(view["active"]["position"], studio.arrow.position)) > 0.02
    np.testing.assert_allclose(view["active"]["direction"], studio.arrow.direction, atol=1e-6)


def test_the_arrow_has_the_depth_of_training_and_rolls(studio: Studio) -> None:
    studio.set_heading([0.01, 0.0, 0.02], [0.0, -3.0, 0.0])
    np.testing.assert_allclose(studio.arrow.position, [0.01, -INWARD, 0.02])
    before = studio.arrow.cross
    studio.set_roll(studio.arrow.roll(studio.up) + np.pi / 2)
    assert studio.arrow.cross @ before == pytest.approx(0.0, abs=1e-6)
    assert studio.arrow.cross @ studio.arrow.direction == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("direction", [[0.0, 0.0, -1.0], [0.3, -0.5, -0.4], [1.0, 0.0, 0.0]])
def test_the_roll_is_the_angle_of_the_cross_finger_axis_from_level(
    studio: Studio, direction: list[float]
) -> None:
    turn = matrix(MUG.rest_poses[0][3:])
    studio.set_heading([0.0, 0.0, 0.0], turn.T @ direction)
    studio.set_roll(0.0)
    assert (turn @ studio.arrow.cross)[2] == pytest.approx(0.0, abs=1e-9)
    level = studio.arrow.cross
    for degrees in (-150.0, -30.0, 75.0, 180.0):
        studio.set_roll(np.radians(degrees))
        assert describe(studio)["roll_deg"] == degrees
        assert studio.arrow.cross @ level == pytest.approx(np.cos(np.radians(degrees)))
        assert np.cross(level, studio.arrow.cross) @ studio.arrow.direction == pytest.approx(
            np.sin(np.radians(degrees))
        )


def test_a_drawn_path_keeps_its_beginning_and_ends_at_the_wrist_of_the_grasp(
    studio: Studio,
) -> None:
    up = matrix(MUG.rest_poses[0][3:])[2]
    drawn = [studio.arrow.position + up * h for h in (0.35, 0.25, 0.2)]
    studio.draw(drawn)
    studio.ask("trajectory", True)
    path = studio.fields["trajectory"]["position"]
    assert path.shape == (TASK.trajectory_points, 3)
    np.testing.assert_allclose(path[0], drawn[0], atol=1e-6)
    studio.close_hand()
    np.testing.assert_allclose(path[-1], studio.fields["pose"]["position"], atol=1e-6)
    studio.ask("pose", False)
    assert studio.trouble == ""
    assert studio.explanation[0].startswith("The wrist trajectory")


def test_suggestions_are_drawn_as_in_training(studio: Studio) -> None:
    first = studio.arrow
    studio.suggest("heading")
    assert np.linalg.norm(studio.arrow.position - first.position) > 1e-3
    assert studio.trouble == ""
    studio.suggest("trajectory")
    studio.ask("trajectory", True)
    assert studio.trouble == ""
    assert tuple(studio.request.constraints) == ("heading", "trajectory")


def test_suggestions_are_for_the_object_without_the_scale_of_training(studio: Studio) -> None:
    larger = Studio(studio.hand, dataclasses.replace(studio.task, object_scale=1.4), MUG)
    for one in (studio, larger):
        one.suggest("heading")
    np.testing.assert_array_equal(larger.arrow.position, studio.arrow.position)


@pytest.mark.parametrize(
    ("do", "says"),
    [
        (lambda s: s.set_heading([0, 0, np.nan], [0, 0, 1]), "three numbers"),
        (lambda s: s.set_heading([0, 0, 0], [0, 0, 0]), "no direction"),
        (lambda s: s.set_heading("up", [0, 0, 1]), "three numbers"),
        (lambda s: s.paint([[0, 0]], 0.01, True), "brush stroke"),
        (lambda s: s.paint([[0, 0, 0]], 9.0, True), "radius"),
        (lambda s: s.draw([[0, 0, 0.1], [0, 0, 0.101]]), "0.1 cm long"),
        (lambda s: s.ask("touch", True), "no constraint 'touch'"),
        (lambda s: s.ask("heading", True), "heading is always active. Set it with the arrow"),
        (lambda s: s.set_rest_pose(99), "no resting pose"),
        (lambda s: s.suggest("affordance"), "Nothing can be suggested"),
        (lambda s: s.set_roll(np.inf), "three numbers"),
    ],
)
def test_an_impossible_action_is_an_error(studio: Studio, do, says) -> None:
    with pytest.raises(CongraspError, match=says):
        do(studio)


def test_an_impossible_request_is_explained_before_it_is_sent(studio: Studio) -> None:
    up = matrix(MUG.rest_poses[0][3:]).T @ np.array([0.0, 0.0, 1.0])
    studio.set_heading(studio.arrow.position, up)
    assert "under the table" in studio.trouble
    with pytest.raises(CongraspError, match="under the table"):
        _ = studio.request
    studio.suggest("heading")
    studio.fill(avoid=True)
    assert studio.trouble.startswith("Everything is painted")


def test_another_object_resets_the_request(studio: Studio) -> None:
    studio.ask("pose", True)
    studio.take(dataclasses.replace(MUG, name="other"))
    assert studio.asked == set()
    assert "pose" not in studio.fields
    assert describe(studio)["object"]["name"] == "other"


def same(one: Studio, edit: object) -> bool:
    """True if the request equals that of an edit exactly."""
    return all(np.array_equal(a, b) for a, b in zip(leaves(one.edit), leaves(edit), strict=True))


def leaves(tree: object) -> list[object]:
    if isinstance(tree, dict):
        return list(itertools.chain(*(leaves(tree[key]) for key in sorted(tree))))
    if isinstance(tree, tuple):
        return list(itertools.chain(*map(leaves, tree)))
    return [tree]


def test_edits_are_undone_and_redone_until_a_new_one(studio: Studio) -> None:
    studio.take(MUG)
    history = History(studio)
    up = matrix(MUG.rest_poses[0][3:])[2]
    edits = [
        ("set_rest_pose", {"rest": 0}),
        ("set_heading", {"surface": MUG.points[0], "direction": -MUG.normals[0]}),
        ("set_roll", {"angle": 0.5}),
        ("paint", {"points": [MUG.points[0]], "radius": 0.02, "avoid": True}),
        ("close_hand", {}),
        ("draw", {"points": [studio.arrow.position + up * h for h in (0.35, 0.2)]}),
        ("suggest", {"constraint": "pose"}),
        ("ask", {"constraint": "pose", "on": False}),
        ("fill", {"avoid": False}),
    ]
    assert {name for name, _ in edits} == ACTIONS.keys() - {"choose"}
    states = [studio.edit]
    for name, values in edits:
        history.do(name, **values)
        states.append(studio.edit)
        assert history.view() == {"undo": ACTIONS[name], "redo": ""}
    assert studio.asked == {"trajectory"}
    assert "trajectory" in studio.fields
    for state in states[-2::-1]:
        history.undo()
        assert same(studio, state)
    assert history.view() == {"undo": "", "redo": ACTIONS["set_rest_pose"]}
    assert studio.asked == set()
    history.undo()  # there is nothing more
    for state in states[1:]:
        history.redo()
        assert same(studio, state)
    history.undo()
    history.undo()
    history.do("ask", constraint="trajectory", on=False)
    assert history.view()["redo"] == ""
    before = studio.edit
    history.redo()
    assert same(studio, before)


def test_a_gesture_is_one_edit_and_a_failed_action_is_none(studio: Studio) -> None:
    history = History(studio)
    first = studio.edit
    for gesture, angle in ((1, 0.1), (1, 0.2), (1, 0.3), (2, 0.4)):
        history.do("set_roll", gesture=gesture, angle=angle)
    with pytest.raises(CongraspError, match="at least 3 cm"):
        history.do("draw", points=[[0, 0, 0.1], [0, 0, 0.101]])
    assert studio.arrow.roll(studio.up) == pytest.approx(0.4)
    history.undo()
    assert studio.arrow.roll(studio.up) == pytest.approx(0.3)
    history.undo()
    assert same(studio, first)
    assert history.view()["undo"] == ""
