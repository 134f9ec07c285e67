"""Lanes are green where the hand keeps to a constraint, by errors worked out otherwise."""

import numpy as np
import pytest

from common.wire.codec import Message, decode, encode
from services.viz.studio.lanes import HEADING, TRAJECTORY, for_page, lanes
from tests.episodes import episode

STEPS, REMOVAL = 30, 18


def test_every_active_constraint_has_a_lane_and_no_other() -> None:
    assert set(lanes(episode(STEPS, removal=REMOVAL))) == {"contact", "heading", "affordance", "pose", "trajectory"}
    assert set(lanes(episode(STEPS, removal=REMOVAL, mask=(0, 0, 0, 0)))) == {"contact", "heading"}


def test_the_made_up_grasp_meets_what_it_was_made_for() -> None:
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


def test_a_wrist_beside_its_path_is_told_how_far() -> None:
    made = episode(STEPS, removal=REMOVAL)
    along = made.arrays["goal/heading_direction"]
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside = (TRAJECTORY[1] + 0.01) * aside / np.linalg.norm(aside)
    moved = {**made.arrays, "goal/trajectory_position": made.arrays["goal/trajectory_position"] + aside}
    lane = lanes(Message(moved, made.meta))["trajectory"]
    np.testing.assert_allclose(lane.errors["m"], TRAJECTORY[1] + 0.01, atol=1e-6)
    assert not lane.met.any()


def test_a_hand_beside_the_arrow_is_told_how_far() -> None:
    made = episode(STEPS, removal=REMOVAL)
    direction = made.arrays["goal/heading_direction"]
    aside = np.cross(direction, [0.0, 0.0, 1.0])
    aside = 0.05 * aside / np.linalg.norm(aside)
    moved = {**made.arrays, "goal/heading_position": (made.arrays["goal/heading_position"] + aside).astype(np.float32)}
    before, after = lanes(made)["heading"], lanes(Message(moved, made.meta))["heading"]
    assert before.errors["m"][-1] <= HEADING[1] and after.errors["m"][-1] > HEADING[1] and not after.met[-1]


def test_only_links_that_press_on_the_paint_break_the_affordance() -> None:
    made = episode(STEPS, removal=REMOVAL)
    nowhere = {**made.arrays, "surface_minus": np.zeros_like(made.arrays["surface_minus"])}
    everywhere = {**made.arrays, "surface_minus": np.ones_like(made.arrays["surface_minus"])}
    assert lanes(Message(nowhere, made.meta))["affordance"].met.all()
    lane = lanes(Message(everywhere, made.meta))["affordance"]
    touching = np.linalg.norm(made.arrays["contact_force"], axis=-1).max(-1) > 0.05
    np.testing.assert_array_equal(lane.met, ~touching)
    assert lane.errors["links on O-"][-1] == 5


def test_the_page_gets_one_message_with_everything_it_plays() -> None:
    message = decode(encode(for_page(episode(STEPS, removal=REMOVAL))))
    assert message.arrays["lane/heading/met"].shape == (STEPS,)
    assert "within" in message.meta["lanes"]["heading"]
    assert {"link_position", "object_quaternion", "reward/contact", "goal/mask"} <= message.arrays.keys()
    # The made-up grasp ends in its reference pose: the ghost is where the hand is, in the object's frame.
    last = message.arrays["link_position"][-1] - message.arrays["object_position"][-1]
    np.testing.assert_allclose(message.arrays["ghost_position"], last, atol=1e-5)
