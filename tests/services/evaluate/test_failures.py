"""Causes of failures."""

import numpy as np
import pytest

from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.pictures import cause


def episode(heights, **metrics) -> Message:
    """Two steps with the table, then one without for every further height."""
    position = np.zeros((len(heights), 3))
    position[:, 2] = heights
    table = np.arange(len(heights)) < 2
    known = {"diverged": 0.0, "held": 0.0, "moved_at_removal": 0.01, "links_at_removal": 3.0}
    return Message({"object_position": position, "table": table}, {"metrics": known | metrics, "control_dt": 0.01})


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        ({"held": 1.0}, "held"),
        ({"diverged": 1.0, "links_at_removal": 0.0}, "the physics diverged"),
        ({"moved_at_removal": 0.06}, "pushed away before the table was removed"),
        ({"links_at_removal": 0.0}, "not touched when the table was removed"),
        ({}, "slipped 0.03 s after the table was removed"),
    ],
)
def test_every_cause_has_its_label(metrics, said):
    assert cause(episode([0.3, 0.3, 0.2, 0.19, 0.16, 0.149, 0.1], **metrics), 0.05) == said


def test_what_slips_in_a_lift_is_measured_from_the_wrist():
    made = episode([0.1] * 8)
    wrist = np.array([0.2, 0.2, 0.2, 0.22, 0.24, 0.26, 0.28, 0.3])[:, None, None] * [0.0, 0.0, 1.0]
    arrays = {**made.arrays, "link_position": wrist, "table": np.ones(8, bool)}
    lifted = Message(arrays, {**made.meta, "phases": {"grasp": 0.0, "lift": 0.02}})
    assert cause(lifted, 0.05) == "slipped 0.03 s after the lift began"
