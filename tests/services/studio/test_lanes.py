"""Lanes are green where the errors that an episode has recorded are within their tolerances."""

import numpy as np
import pytest

from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.services.studio.page import for_page, lanes
from tests.episodes import episode, older

STEPS, REMOVAL = 30, 18
TOLERANCES = {(name, error.unit): error.tolerance for name in ("heading", "trajectory")
              for error in get_constraint(name).errors}  # fmt: skip


def with_error(made: Message, **values: float | np.ndarray) -> Message:
    """The episode with other errors in all steps."""
    own = {f"error/{name}": np.broadcast_to(np.float32(value), STEPS) for name, value in values.items()}
    return Message({**made.arrays, **own}, made.meta)


def test_every_active_constraint_has_a_lane_and_no_other() -> None:
    assert set(lanes(episode(STEPS, removal=REMOVAL))) == {"contact", "heading", "affordance", "pose", "trajectory"}
    assert set(lanes(episode(STEPS, removal=REMOVAL, mask=(0, 0, 0, 0)))) == {"contact", "heading"}


def test_the_fake_grasp_meets_its_constraints() -> None:
    found = lanes(episode(STEPS, removal=REMOVAL, mask=(0, 1, 1, 1)))
    heading = found["heading"]
    np.testing.assert_allclose(heading.errors["rad"], 0.0, atol=1e-3)
    assert heading.met[-1] and heading.counts.tolist() == [False] * REMOVAL + [True] * (STEPS - REMOVAL)
    pose = found["pose"]
    assert pose.errors["rad"][-1] == pytest.approx(0.0, abs=1e-6) and pose.errors["m"][-1] == pytest.approx(0, abs=1e-6)
    assert not pose.met[0] and pose.met[-1]
    trajectory = found["trajectory"]
    assert trajectory.counts.tolist() == [True] * REMOVAL + [False] * (STEPS - REMOVAL)
    np.testing.assert_allclose(trajectory.errors["m"], 0.0, atol=1e-6)
    assert trajectory.met.all()


def test_with_a_lift_contact_counts_from_the_lift_on() -> None:
    made = episode(STEPS, removal=REMOVAL)
    stays = {**made.arrays, "table": np.ones(STEPS, bool)}
    lifted = lanes(Message(stays, {**made.meta, "phases": {"grasp": 0.0, "lift": 0.2, "hold": 0.25}}))
    assert lifted["contact"].counts.tolist() == [False] * 20 + [True] * (STEPS - 20)
    assert lifted["trajectory"].counts.tolist() == [True] * 20 + [False] * (STEPS - 20)


@pytest.mark.parametrize("name", ["heading", "trajectory"])
@pytest.mark.parametrize("unit", ["rad", "m"])
def test_an_error_above_its_tolerance_breaks_its_lane(name: str, unit: str) -> None:
    made, most = episode(STEPS, removal=REMOVAL), TOLERANCES[name, unit]
    lane = lanes(with_error(made, **{f"{name}_{unit}": most + 0.001}))[name]
    np.testing.assert_allclose(lane.errors[unit], most + 0.001, atol=1e-6)
    assert not lane.met.any() and lanes(with_error(made, **{f"{name}_{unit}": most - 0.001}))[name].met.any()


def test_only_links_that_press_on_the_paint_break_the_affordance() -> None:
    made = episode(STEPS, removal=REMOVAL)
    assert lanes(made)["affordance"].met.all()
    touching = np.linalg.norm(made.arrays["contact_force"], axis=-1).max(-1) > 0.05
    lane = lanes(with_error(made, affordance_ratio=np.where(touching, 0.2, 0.0)))["affordance"]
    np.testing.assert_array_equal(lane.met, ~touching)
    assert lane.errors["share"][-1] == pytest.approx(0.2)


def test_only_the_fingers_of_a_pose_count_under_a_wrist_path() -> None:
    made = with_error(episode(STEPS, removal=REMOVAL, mask=(0, 1, 0, 1)), pose_m=0.2)
    pose = lanes(made)["pose"]
    assert pose.met[-1] and set(pose.errors) == {"rad"} and "distance" not in pose.legend


def test_every_constraint_with_recorded_errors_has_a_lane() -> None:
    made = with_error(episode(STEPS, removal=REMOVAL, mask=(0, 0, 0, 0)), fingers_ratio=0.25)
    lane = lanes(Message({**made.arrays, "active/fingers": np.bool_(True)}, made.meta))["fingers"]
    assert not lane.met.any() and lane.legend == "share of touching links of other fingers: 0 % at most"


def test_the_page_gets_one_message_with_everything_it_plays() -> None:
    message = decode(encode(for_page(episode(STEPS, removal=REMOVAL))))
    assert message.arrays["lane/heading/met"].shape == (STEPS,)
    assert "at most" in message.meta["lanes"]["heading"]
    assert {"link_position", "object_quaternion", "reward/contact", "arrow/heading/tip"} <= message.arrays.keys()
    # The fake grasp ends in its reference pose: the ghost is where the hand is, in the object's frame.
    last = message.arrays["link_position"][-1] - message.arrays["object_position"][-1]
    np.testing.assert_allclose(message.arrays["ghost/pose/position"], last, atol=1e-5)


def test_an_older_recording_has_its_markers_and_only_the_lane_of_contact() -> None:
    made = episode(STEPS, removal=REMOVAL, mask=(1, 1, 0, 1))
    found = lanes(older(made))
    assert set(found) == {"contact"}
    np.testing.assert_array_equal(found["contact"].met, lanes(made)["contact"].met)
    page, now = for_page(older(made)), for_page(made)
    kinds = ("arrow/", "polyline/", "ghost/", "paint/")
    drawn = {name: array for name, array in now.arrays.items() if name.startswith(kinds)}
    assert drawn.keys() == {name for name in page.arrays if name.startswith(kinds)}
    for name, array in drawn.items():
        np.testing.assert_array_equal(page.arrays[name], array)
