"""What of a captured grasp holds for a hand of any build: how the point between the fingertips came to the object.

A human's finger angles and wrist mean nothing to a robot hand. Its hand centre takes the place of the human one, with
the grasp axes v and w (`common.hands.kinematics.grasp_frame`) along the human ones; the fingers then close around the
object. Lengths grow with the object, which is brought to the hand's size.
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
"""Poses that are closed in one compiled call."""


def demonstrated_headings(demonstrations: Sequence[Demonstration], scale: float) -> Headings:
    """Hand centre (M, 3) m, heading axis and cross-finger axis (M, 3) of the captured grasps, object frame.

    Args:
      demonstrations: M of one object.
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
      demonstrations: of one object.
      obj: the object in the hand's size.
      scale: factor by which it was brought to that size.

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
        # The hand centre of the closed hand, in the wrist frame, is what the last pose leaves between the two.
        positions.append(path - turn.apply(turn[-1].inv().apply(path[-1] - last)))
        quaternions.append(continuous(turn.as_quat(scalar_first=True)))
    return q, np.array(positions), np.array(quaternions)


def followed(hand: Hand, position: np.ndarray, rotation: Rotation) -> tuple[np.ndarray, Rotation]:
    """The wrist's path of a hand whose open grasp moves as that of a human hand; where there are no fingers to go by.

    Args:
      hand: any hand.
      position: (T, 3) m, of the human wrist.
      rotation: T orientations of its frame, that of the `human` hand.
    """
    turn = rotation * _onto_human(hand)
    return position + rotation.apply(grasp_frame(HUMAN).center) - turn.apply(grasp_frame(hand).center), turn


def _centers(demonstrations: Sequence[Demonstration]) -> np.ndarray:
    """(M, 3) m, the human hand's centre in its wrist frame: between the thumb's tip and the mean of the others."""
    tips = joint_positions(np.stack([d.q for d in demonstrations]))[:, :, 3]
    return (tips[:, 0] + tips[:, 1:].mean(1)) / 2


def _onto_human(hand: Hand) -> Rotation:
    """From the hand's wrist frame to the human one, with the grasp axes on one another."""
    return Rotation.from_matrix(_axes(HUMAN) @ _axes(hand).T)


def _axes(hand: Hand) -> np.ndarray:
    """(3, 3) v, w and v x w as columns, in the wrist frame."""
    frame = grasp_frame(hand)
    return np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)], -1)
