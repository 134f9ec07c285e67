"""A grasp that is noticed late, while the object is carried already, belongs to where the object was picked up."""

import pathlib

import numpy as np
import pytest

from congrasp.services.assets.captures.extract import _before_carried
from congrasp.services.assets.captures.sequence import Sequence


def motion(wrist, lift, present=None):
    """A wrist at heights (T,) over an object that does not turn and is itself at heights (T,), m."""
    count, up = len(lift), np.array([0.0, 0.0, 1.0])
    sequence = Sequence(
        name="lift",
        object_name="box",
        mesh=pathlib.Path("box.stl"),
        wrist_position=np.outer(wrist + lift, up),
        wrist_rotation=np.tile(np.eye(3), (count, 1, 1)),
        joints=np.zeros((count, 5, 4, 3)),
        object_position=np.outer(lift, up),
        object_rotation=np.tile(np.eye(3), (count, 1, 1)),
        present=np.ones(count, bool) if present is None else present,
    )
    return sequence, np.outer(wrist, up)


# For 11 frames the wrist comes down by 2 cm a frame; then the object rises by 6 mm a frame, 6 cm at frame 20.
WRIST = np.concatenate([np.arange(0.30, 0.095, -0.02), np.full(10, 0.10)])
LIFT = np.concatenate([np.zeros(11), 0.006 * np.arange(1, 11)])


def test_it_is_the_last_frame_within_a_centimetre_of_the_place():
    assert _before_carried(*motion(WRIST, LIFT), 20) == 11


def test_missing_frames_do_not_count():
    present = np.ones(21, bool)
    present[10:12] = False  # at frame 9 the wrist is 2 cm from where it will be
    assert _before_carried(*motion(WRIST, LIFT, present), 20) == 9


@pytest.mark.parametrize(
    ("wrist", "lift"),
    [
        (WRIST, 0.45 * LIFT),  # 2.7 cm: nudged
        (WRIST, 0 * LIFT),
        (np.linspace(0.30, 0.10, 21), LIFT),  # another hand lifts it while this one comes
    ],
)
def test_an_object_that_this_hand_does_not_carry_leaves_the_frame_as_it_is(wrist, lift):
    assert _before_carried(*motion(wrist, lift), 20) == 20
