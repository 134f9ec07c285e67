"""Transfers captured grasps to any hand by the motion of the point between the fingertips.

A human's finger angles and wrist do not apply to a robot hand. Its hand centre is placed at the human one, with the
grasp axes v and w (`common.hands.kinematics.grasp_frame`) along the human ones; the fingers then close around the
object. Lengths scale with the object, which is scaled for the hand.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.rotations import continuous
from congrasp.common.task.sampling.closed_poses import closed_poses
from congrasp.common.task.sampling.headings import Headings
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.fit import joint_positions

_AT_ONCE = 20
"""Number of poses closed in one compiled call."""


def demonstrated_headings(demonstrations: Sequence[Demonstration], scale: float) -> Headings:
    """Hand centres (M, 3) m, heading axes and cross-finger axes (M, 3) of the captured grasps, object frame.

    Args:
      demonstrations: M demonstrations on one object.
      scale: factor on the object's lengths.
    """
    frame = grasp_frame(HUMAN)
    turns = Rotation.from_quat([d.quaternion[-1] for d in demonstrations], scalar_first=True)
    center = turns.apply(_centers(demonstrations)) + [d.position[-1] for d in demonstrations]
    rows = scale * center, turns.apply(frame.heading), turns.apply(frame.cross)
    return Headings(*(row.astype(np.float32) for row in rows))


def transferred(
    hand: Hand, demonstrations: Sequence[Demonstration], obj: GraspObject, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference poses and wrist trajectories of another hand that follow M demonstrations on one object.

    Args:
      hand: any hand.
      demonstrations: demonstrations on one object.
      obj: object scaled for the hand.
      scale: factor of this scaling.

    Returns:
      Finger angles (M, F) that close the hand at the last waypoint, and waypoints (M, K, 3) m and (M, K, 4) of its
      wrist in the object frame.
    """
    headings = demonstrated_headings(demonstrations, scale)
    surface = obj.points.astype(np.float32), obj.normals.astype(np.float32)
    rows = np.resize(np.arange(len(demonstrations)), (-(-len(demonstrations) // _AT_ONCE), _AT_ONCE))
    parts = [closed_poses(hand, *surface, *(field[some] for field in headings)) for some in rows]
    q, end = (np.concatenate([np.asarray(part[i]) for part in parts])[: len(demonstrations)] for i in (0, 1))
    onto = _onto_human(hand)
    positions, quaternions = [], []
    for demonstration, center, last in zip(demonstrations, _centers(demonstrations), end, strict=True):
        human = Rotation.from_quat(demonstration.quaternion, scalar_first=True)
        turn = human * onto
        path = scale * (human.apply(center) + demonstration.position)
        # The hand centre of the closed hand in the wrist frame follows from the last pose.
        positions.append(path - turn.apply(turn[-1].inv().apply(path[-1] - last)))
        quaternions.append(continuous(turn.as_quat(scalar_first=True)))
    return q, np.array(positions), np.array(quaternions)


def followed(hand: Hand, position: np.ndarray, rotation: Rotation) -> tuple[np.ndarray, Rotation]:
    """Path of the wrist of a hand whose open grasp moves like that of a human hand, for captures without fingers.

    Args:
      hand: any hand.
      position: (T, 3) positions of the human wrist, m.
      rotation: T orientations of its frame, that of the `human` hand.
    """
    turn = rotation * _onto_human(hand)
    return position + rotation.apply(grasp_frame(HUMAN).center) - turn.apply(grasp_frame(hand).center), turn


def _centers(demonstrations: Sequence[Demonstration]) -> np.ndarray:
    """Centres (M, 3) of the human hand in its wrist frame, m: between the thumb's tip and the mean of the others."""
    tips = joint_positions(np.stack([d.q for d in demonstrations]))[:, :, 3]
    return (tips[:, 0] + tips[:, 1:].mean(1)) / 2


def _onto_human(hand: Hand) -> Rotation:
    """Rotation from the hand's wrist frame to the human one that aligns the grasp axes."""
    return Rotation.from_matrix(_axes(HUMAN) @ _axes(hand).T)


def _axes(hand: Hand) -> np.ndarray:
    """Axes v, w and v x w as columns (3, 3), in the wrist frame."""
    frame = grasp_frame(hand)
    return np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)], -1)
