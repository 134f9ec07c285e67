"""A thumb, an open and a closed pose for a hand whose file names none."""

import dataclasses

import mujoco
import numpy as np

from common.errors import CongraspError
from common.hands.spec import Hand, Link, chain_of, wrist_gains
from services.assets.hands.kinematics import mujoco_link_poses

_ALIKE = 0.3  # a range is as long on both sides if its middle is nearer to zero than this share of it
_TOWARDS = 0.5  # a thumb's joint closes if at least this share of its tip's motion leads to the fingers
_CLOSED, _OPEN = 0.8, 0.2  # shares of a joint's range


def thumb_of(links: list[Link], tips: list[str], wanted: str) -> str:
    """The finger that is called so, or else the one whose root is farthest from the others'."""
    if wanted:
        if wanted not in tips:
            raise CongraspError(f"'{wanted}' is not the last link of a finger.", f"Name one of: {', '.join(tips)}.")
        return wanted
    whole = Hand("", tuple(links), tips[0], {}, {}, wrist_gains(1.0))
    named = [tip for tip in tips if any("thumb" in name.lower() for name in chain_of(whole, tip))]
    if named:
        return named[0]
    origins = {link.name: np.array(link.joints[0].anchor) for link in links if link.joints}
    roots = np.array([origins[chain_of(whole, tip)[0]] for tip in tips])
    apart = [np.linalg.norm(np.delete(roots, i, 0).mean(0) - root) for i, root in enumerate(roots)]
    return tips[int(np.argmax(apart))]


def propose_poses(hand: Hand) -> Hand:
    """The hand with an open and a closed pose.

    A joint closes towards the longer side of its range. Where the sides are much alike, a finger's joint spreads and
    stays; one of the thumb closes the way that brings it to the half closed fingers, if most of its motion does.
    """
    flat = np.clip(0.0, hand.lower, hand.upper).astype(float)
    thumb = chain_of(hand, hand.thumb)
    roots = [chain_of(hand, link.name)[0] for link in hand.links for _ in link.joints]
    own = [j for j, root in enumerate(roots) if root == thumb[0]]
    both = np.abs(hand.upper + hand.lower) < _ALIKE * (hand.upper - hand.lower)
    way = np.where(both, 0.0, np.sign(hand.upper + hand.lower))

    def closing() -> np.ndarray:
        """(F,) the closed pose by the present ways of closing."""
        ends = np.where(way > 0, hand.upper, hand.lower)
        return np.where(way != 0, flat + _CLOSED * (ends - flat), flat)

    for j in own:
        if both[j]:
            gain, speed = _approach(hand, 0.5 * (flat + closing()), j)
            way[j] = np.sign(gain) if abs(gain) > _TOWARDS * speed else 0.0
    closed = closing()
    share = np.full(len(flat), _OPEN)
    if len(own) > 2:  # the first joint of such a thumb turns it against the fingers
        share[own[0]] = 1.0
    opened = flat + share * (closed - flat)
    names = [joint.name for joint in hand.joints]

    def pose(q: np.ndarray) -> dict[str, float]:
        """Angles (F,) by the names of their joints, without zeros."""
        q = np.clip(q.round(3), hand.lower, hand.upper)
        return {name: round(float(x), 6) for name, x in zip(names, q, strict=True) if x}

    return dataclasses.replace(hand, open_pose=pose(opened), closed_pose=pose(closed))


def _tips(hand: Hand, q: np.ndarray) -> np.ndarray:
    """(tips, 3) in the wrist frame, thumb first."""
    position, quaternion = mujoco_link_poses(hand, q)
    found = []
    for i in hand.tip_links:
        link, turn = hand.links[i], np.empty(9)
        assert link.tip is not None
        mujoco.mju_quat2Mat(turn, quaternion[i])
        found.append(position[i] + turn.reshape(3, 3) @ np.subtract(link.tip, link.joints[0].anchor))
    return np.array(found)


def opening(hand: Hand) -> float:
    """Distance between the thumb's tip and the mean of the others in the open pose, m."""
    tips = _tips(hand, hand.q_open)
    return float(np.linalg.norm(tips[1:].mean(0) - tips[0]))


def _approach(hand: Hand, q: np.ndarray, joint: int) -> tuple[float, float]:
    """By how much a radian of a thumb's joint brings its tip to the mean of the others, and moves it at all, m."""
    step = np.zeros(len(q))
    step[joint] = 0.05
    before, after = _tips(hand, q - step), _tips(hand, q + step)
    gaps = [np.linalg.norm(tips[1:].mean(0) - tips[0]) for tips in (before, after)]
    return float(gaps[0] - gaps[1]) / 0.1, float(np.linalg.norm(after[0] - before[0])) / 0.1
