"""Captured sequences of which no episode is drawn: they are told by name, and why."""

import pathlib

import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.build import Report, _from_below
from congrasp.services.cli.constraints import _print_report


def test_from_below_is_what_only_the_direction_of_the_approach_excludes():
    """By hand: an object whose centre is 10 cm high; wrists 5 cm over it and 9 cm under, coming down, up and up."""
    frame = grasp_frame(HUMAN)
    own = rotations.frame_from_axes(jnp.array(frame.heading), jnp.array(frame.cross))
    turns = [
        rotations.multiply(
            rotations.frame_from_axes(jnp.array([0.0, 0, z]), jnp.array([1.0, 0, 0])), rotations.conjugate(own)
        )
        for z in (-1.0, 1.0, 1.0)
    ]
    path = np.zeros((2, 3, 15, 3), np.float32)
    path[..., 2] = np.array([0.05, 0.05, -0.09])[:, None]
    arrays = {
        "trajectory/position": path,
        "pose/quaternion": np.stack([np.stack(turns)] * 2),
        "rest": np.array([[0, 0, 0.1, 1, 0, 0, 0]], np.float32),
    }
    np.testing.assert_array_equal(_from_below(HUMAN, Message(arrays, {})), [False, True, False])


def test_the_report_names_them(capsys):
    def row(name: str, *, clear: bool, below: bool, overlap: float = 0.0, moved: float = 0.0) -> dict:
        place = {"clear_of_table": clear, "from_below": below, "split": "held-out" if name == "dig" else "training"}
        apart = {"overlap_m": overlap, "moved_apart_rad": moved}
        later = {"frames_after_touch": 4 if below else 0}
        return {"sequence": name, "object": "box", "residual_rad": 0.0} | place | apart | later

    kept = [
        row("lift", clear=True, below=False),
        row("scoop", clear=False, below=True, overlap=0.004, moved=0.1),
        row("push", clear=False, below=False, overlap=0.003, moved=0.2),
        row("dig", clear=False, below=True),
    ]
    _print_report(Report(kept), "human", pathlib.Path("sets"), pathlib.Path("objects"))
    said = capsys.readouterr().out
    assert "room for 1 of 4" in said
    assert "In 2 of 4, thumb and fingers oppose only after the first touch" in said
    assert "the reference is taken then, 4 frames later on average" in said
    assert "of 2 overlapped, by up to 4.0 mm (scoop)" in said
    assert "by 0.15 rad on average, at most 0.20 rad (push)" in said
    assert "No episode is drawn from 2, whose hand comes from below, which no episode does: scoop, dig." in said
    assert "No episode is drawn from 1, whose hand comes too near to the table: push." in said
    assert "3 sequences are for training, 1 held out." in said
