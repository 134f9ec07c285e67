"""Natural postures of fingers, with deviations worked out by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.task.posture import finger_deviations, finger_joints, unnatural

HUMAN = get_hand("human")
NAMES = [joint.name for joint in HUMAN.joints]
FREE = np.zeros(len(HUMAN.links), bool)
# Mean of the ways from the open hand to the fist: 1.1 (MCP), 0.95 (PIP) and 1.05 rad (DIP)
RANGE = 3.1 / 3


def posed(**angles: float) -> np.ndarray:
    """The open hand with other angles of some joints."""
    q = HUMAN.q_open.copy()
    for name, angle in angles.items():
        q[NAMES.index(name)] = angle
    return q


def bent(finger: str, share: float) -> dict[str, float]:
    """Angles of a finger that is bent by a share of the way to the fist."""
    return {
        f"{finger}_mcp_flexion": 0.25 + 1.1 * share,
        f"{finger}_pip": 0.25 + 0.95 * share,
        f"{finger}_dip": 0.15 + 1.05 * share,
    }


def deviations(q: np.ndarray, touching: np.ndarray = FREE) -> np.ndarray:
    """Deviations of index, middle, ring and little finger."""
    return np.asarray(finger_deviations(HUMAN, jnp.asarray(q[None]), jnp.asarray(touching[None])))[
        0
    ]


def in_contact(finger: int) -> np.ndarray:
    """Links of one finger that touch."""
    return HUMAN.link_fingers == finger


def test_open_hand_is_natural():
    assert deviations(HUMAN.q_open) == pytest.approx(np.zeros(4))


def test_idle_finger_apart_from_its_neighbour_counts():
    # 0.6 of the way ahead of the middle finger, of which 0.2 is natural. The middle finger is next
    # to the ring finger, which is open, too.
    q = posed(**bent("index", 0.6))
    assert deviations(q) == pytest.approx([0.4 * RANGE, 0, 0, 0], abs=1e-5)


def test_finger_in_contact_may_leave_its_neighbours():
    q = posed(**bent("index", 0.6))
    assert deviations(q, in_contact(1)) == pytest.approx(np.zeros(4), abs=1e-5)


def test_looped_finger_counts_more_than_a_bent_one():
    loop = posed(index_pip=1.75, index_dip=1.57)
    assert deviations(loop)[0] > 2 * deviations(posed(**bent("index", 0.6)))[0]


def test_distal_joint_follows_two_thirds_of_the_proximal_one():
    # 2/3 of 0.9 rad is 0.6 rad; 0.35 rad more is natural, the last 0.1 rad is not.
    q = posed(index_pip=0.9, index_dip=1.05)
    assert deviations(q, in_contact(1)) == pytest.approx([0.1, 0, 0, 0], abs=1e-5)


def test_looped_finger_counts_in_contact_too():
    # The middle joint is 1.3 rad ahead of the neighbour's 0.25 rad, of which 0.7 rad is natural; the
    # last joint is at two thirds of it.
    q = posed(index_pip=1.55, index_dip=1.03)
    assert deviations(q, in_contact(1)) == pytest.approx([0.6, 0, 0, 0], abs=1e-2)


def test_finger_between_two_may_bend_like_either():
    q = posed(index_pip=1.55, index_dip=1.03, middle_pip=1.2, middle_dip=0.8)
    touching = in_contact(1) | in_contact(2)
    assert deviations(q, touching) == pytest.approx(np.zeros(4), abs=1e-5)


def test_robot_hand_has_no_coupled_joints():
    allegro = get_hand("allegro")
    assert len(finger_joints(allegro).distal) == 0
    free = jnp.zeros((1, len(allegro.links)), bool)
    assert unnatural(allegro, jnp.asarray(allegro.q_open[None]), free) == pytest.approx(0.0)
