"""Motions of episodes, recorded or in memory."""

from typing import Any

import numpy as np

from congrasp.common.hands import known_hand
from congrasp.common.io.inputs import file_name
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion import GraspMotion, hand_arrays
from congrasp.services.export.motion_file import GOAL_ARRAYS
from congrasp.services.record.episode import active_constraints, arm_of_episode

_GOAL_PREFIX = "goal/"
"""Prefix of goal arrays in episodes."""
_ROUNDING = 1e-2
"""Largest difference of a quaternion's length from one that is due to rounding in a recording."""


def motion_of_episode(episode: Message) -> GraspMotion:
    """Returns the motion of an episode, in memory or read from MCAP
    (`services.record.reader.read_episodes`).
    """
    arrays = {name: np.asarray(value) for name, value in episode.arrays.items()}
    meta = dict(episode.meta)
    hand = known_hand(meta.pop("hand"))
    dt = float(meta.pop("control_dt"))
    arm = arm_of_episode(episode)
    meta.pop("arm", None)
    hand_columns: dict[str, Any] = hand_arrays(hand)
    link_quaternion = _normalised(arrays["link_quaternion"])
    colours = None
    if "colour_values" in arrays:
        colours = Colours(arrays["colour_points"], arrays["colour_values"])
    return GraspMotion(
        hand=hand.name,
        object=file_name(meta.pop("object"), "the object of a motion"),
        success=bool(meta.pop("success")),
        control_dt=dt,
        constraints=active_constraints(arrays),
        metrics={name: float(value) for name, value in meta.pop("metrics", {}).items()},
        about=meta,
        time=dt * np.arange(len(arrays["table"])),
        table=arrays["table"].astype(bool),
        wrist_position=arrays["link_position"][:, 0],
        wrist_quaternion=link_quaternion[:, 0],
        joint_position=arrays["q"],
        joint_target=arrays["q_target"],
        link_position=arrays["link_position"],
        link_quaternion=link_quaternion,
        link_force=arrays["contact_force"],
        object_position=arrays["object_position"],
        object_quaternion=_normalised(arrays["object_quaternion"]),
        object_vertices=arrays["visual_vertices"],
        object_faces=arrays["visual_faces"],
        object_file_origin=np.asarray(meta.pop("object_file_origin", (0.0, 0.0, 0.0)), np.float64),
        object_file_scale=np.asarray(meta.pop("object_file_scale", 1.0), np.float64),
        **hand_columns,
        surface_points=arrays["surface_points"],
        surface_avoid=arrays["surface_avoid"].astype(bool),
        colours=colours,
        goal=_goal_arrays(arrays),
        arm=arm,
    )


def _goal_arrays(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Goal arrays of an episode, by their names in motions."""
    goal = {}
    for name, values in arrays.items():
        goal_name = name.removeprefix(_GOAL_PREFIX)
        if goal_name in GOAL_ARRAYS:
            goal[goal_name] = values
    return goal


def _normalised(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of length one; those whose length differs by more than `_ROUNDING` are
    unchanged.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return quaternions / np.where(np.abs(lengths - 1) <= _ROUNDING, lengths, 1)
