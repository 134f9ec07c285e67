"""Computes a thumb, an open and a closed pose from kinematics, for a hand whose file has none.

First a pinch is computed: the pose nearest to zero in which the thumb's tip meets the others'. It
determines the closing direction of joints. The open hand is then turned and spread so that thumb
and fingers face each other over an opening of slightly more than a finger's length. It closes by
every joint that brings them together.
"""

import dataclasses
import itertools
import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from congrasp.common.errors import CongraspError
from congrasp.common.hands.mjcf import add_hand
from congrasp.common.hands.motors import joint_positions, motor_limits, motor_positions
from congrasp.common.hands.spec import Hand, chain_of, link_origin
from congrasp.common.runtime.physics_library import mujoco

_CLOSED = 0.8
"""Share of the range from zero to a joint's end at which it is closed, where thumb and fingers can
meet.
"""
_FLEXED = 0.15
"""The same for the fingers of an open hand, unless other terms matter."""
_SQUEEZE = 0.3
"""Angle by which motors continue after their fingers have met the palm or others, rad."""
_OPENING = 1.25
"""Distance between the tips of an open hand in finger lengths; or as a share of that at zero, if
smaller.
"""
_GRIPPER_OPENING = 4.0
"""The same in finger lengths for a gripper: wider than it opens."""
_MIN_AHEAD = 0.3
"""Distance of the tips of an open hand ahead of the fingers' bases, in finger lengths."""
_MIN_TOWARDS = 0.6
"""Share of a tip's motion towards the hand's centre, for a closing joint."""
_MIN_TURNED = 0.1
"""Share of a joint's range in the pinch that determines its closing direction."""
_MAX_ASYMMETRY = 0.3
"""Asymmetry of a joint's range, as a share of it, that determines the direction otherwise."""
_EFFORT_WEIGHT = 0.1
"""Weight of a radian of all joints relative to a finger length."""
_MIN_SPEED = 0.004
"""Speed below which a joint does not move its tip, m/rad."""
_TOUCHING = 0.02
"""Distance at which tips count as touching, m."""
_MIN_LISTED_ANGLE = 1e-4
"""Angle below which a joint is at zero in a pose, rad."""
RANDOM_STARTS = 4
"""Starts of a search for a pose in addition to the standard ones."""
_CLOSING_STEPS = 40
_MAX_EVALUATIONS = 40
_DIFFERENCE = 0.02
"""Half step of a motor for its tip's velocity, rad."""
_THUMB = re.compile(r"thumb|(^|_)th(_|j?\d|base|prox|hub|mid|dist)", re.IGNORECASE)


class _OpenHand(NamedTuple):
    """Result of the search for an open pose."""

    motors: np.ndarray
    """(M,) motor positions."""
    cost: float
    """Half the squares of the residuals."""
    pinch_gap: float
    """Largest distance between the tips in the pinch, m."""


def thumb_of(hand: Hand, thumb: str, notes: list[str]) -> str:
    """Returns the last link of the thumb.

    Args:
      hand: the hand.
      thumb: the user's choice; if empty, the finger named as a thumb, or else the one that best
        faces all others.
      notes: doubts are appended.

    Raises:
      CongraspError: `thumb` is not the last link of a finger.
    """
    tips = [link.name for link in hand.links if link.tip is not None]
    if thumb:
        if thumb not in tips:
            raise CongraspError(
                f"'{thumb}' is not the last link of a finger.",
                f"Pass one of these as --thumb: {', '.join(tips)}.",
            )
        return thumb
    for tip in tips:
        if any(_THUMB.search(name) for name in _names_in_finger(hand, tip)):
            return tip
    costs = []
    for tip in tips:
        candidate = _Body(dataclasses.replace(hand, thumb=tip))
        costs.append(_open_hand(candidate, random_starts=0).cost)
    best, second = np.argsort(costs)[:2]
    if len(tips) > 2:
        notes.append(
            f"'{tips[best]}' is assumed to be the thumb, before '{tips[second]}', because none is "
            f"named (--thumb)"
        )
    return tips[int(best)]


def propose_poses(hand: Hand, notes: list[str]) -> Hand:
    """Returns the hand with an open and a closed pose; doubts are added to `notes`."""
    body = _Body(hand)
    open_hand = _open_hand(body, RANDOM_STARTS)
    tips_meet = open_hand.pinch_gap <= _TOUCHING
    if not tips_meet:
        notes.append(
            f"thumb and fingers do not meet, {100 * open_hand.pinch_gap:.0f} cm remain between "
            f"their tips (--thumb, or 'open_pose'"
            " and 'closed_pose' in the hand file)"
        )
    opened = open_hand.motors
    closed = _closed(body, opened, _closing_target(body, opened, tips_meet))
    return dataclasses.replace(hand, open_pose=_pose(hand, opened), closed_pose=_pose(hand, closed))


def _names_in_finger(hand: Hand, tip: str) -> list[str]:
    """Names of the links and joints of the finger with this last link."""
    chain = chain_of(hand, tip)
    names = []
    for link in hand.links:
        if link.name in chain:
            names.append(link.name)
            names += [joint.name for joint in link.joints]
    return names


def _closing_target(body: "_Body", opened: np.ndarray, tips_meet: bool) -> np.ndarray:
    """Motors (M,) of a fist: motors that bring the tips together turn to their ends.

    Args:
      body: the hand.
      opened: (M,) motors of the open hand.
      tips_meet: True if thumb and fingers can meet, short of the ends.
    """
    lower, upper = body.limits
    flat = np.clip(0.0, lower, upper)
    share, speed = body.closing(opened)
    closes = (np.abs(share) > _MIN_TOWARDS) & (speed > _MIN_SPEED)
    ends = np.where(share > 0, upper, lower)
    range_share = _CLOSED if tips_meet else 1.0
    target = flat + range_share * (ends - flat)
    is_ahead = np.sign(share) * (target - opened) > 0
    target = np.where(is_ahead, target, ends)
    return np.where(closes, target, opened)


def _pose(hand: Hand, motors: np.ndarray) -> dict[str, float]:
    """Angles of the joints by name, without zeros and joints that follow others."""
    followers = {coupling.joint for coupling in hand.couplings}
    angles = joint_positions(hand, motors.astype(np.float32))
    pose = {}
    for joint, angle in zip(hand.joints, angles, strict=True):
        if joint.name not in followers and abs(angle) > _MIN_LISTED_ANGLE:
            pose[joint.name] = round(float(angle), 6)
    return pose


def opening(hand: Hand) -> float:
    """Returns the distance of the thumb's tip from the mean of the others in the open pose, m."""
    tips = _Body(hand).tips(motor_positions(hand, hand.q_open))
    return float(np.linalg.norm(tips[1:].mean(0) - tips[0]))


class _Body:
    """A hand in MuJoCo, moved by its motors (M,)."""

    def __init__(self, hand: Hand):
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_hand(spec, hand, self_collision=True)
        self.hand = hand
        self.limits = motor_limits(hand).astype(float)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._ratios = [
            joint_positions(hand, row) - joint_positions(hand, 0 * row)
            for row in np.eye(len(hand.motors))
        ]
        self._read_fingers()
        self._read_tips()
        self._measure_fingers()

    def _read_fingers(self) -> None:
        """Reads the fingers that links and motors belong to."""
        hand = self.hand
        self._finger_of_body: dict[int, str] = {}
        for link, finger in zip(hand.links, hand.link_fingers, strict=True):
            body = self._model.body(link.name).id
            self._finger_of_body[body] = hand.finger_roots[finger] if finger >= 0 else ""
        self.fingers = []
        """Root links of the fingers whose tips each motor moves."""
        for motor in range(len(hand.motors)):
            moved_joints = self._moved(motor)
            moves_tip = np.zeros(len(hand.finger_roots), bool)
            for joint, moved_tips in zip(hand.joints, hand.moved_tips, strict=True):
                if joint.name in moved_joints:
                    moves_tip |= moved_tips
            fingers = itertools.compress(hand.finger_roots, moves_tip)
            self.fingers.append(set(fingers))
        self.thumb = np.array([hand.finger_roots[0] in fingers for fingers in self.fingers])
        """(M,) bool: motors of the thumb."""

    def _read_tips(self) -> None:
        """Reads the last links of the fingers, thumb first, and the motors of their last joints."""
        last_links = [self.hand.links[i] for i in self.hand.tip_links]
        self._links = [self._model.body(link.name).id for link in last_links]
        offsets = []
        self._last_motors = []
        for link in last_links:
            offsets.append(np.subtract(link.tip, link_origin(link)))  # type: ignore[arg-type]
            last_joint = list(link.joints)[-1].name
            movers = [m for m in range(len(self.hand.motors)) if last_joint in self._moved(m)]
            self._last_motors.append(movers[0])
        self._tip_offsets = np.array(offsets)

    def _measure_fingers(self) -> None:
        """Measures the fingers at zero."""
        origins = {link.name: link_origin(link) for link in self.hand.links}
        self.roots = np.array([origins[root] for root in self.hand.finger_roots])
        """(tips, 3) bases of the fingers, thumb first."""
        tips = self.tips(np.clip(0.0, *self.limits))
        row = tips[1:] - tips[1:].mean(0)
        sideways = np.linalg.svd(row)[2][0] if len(row) > 1 else np.zeros(3)
        self.across = np.eye(3) - np.outer(sideways, sideways)
        """Projection that removes the direction in which the fingers are side by side."""
        straight = (tips - self.roots)[1:]
        self.size = float(np.linalg.norm(straight, axis=-1).mean())
        """Length of the fingers, m."""
        self.ahead = straight.mean(0) / np.linalg.norm(straight.mean(0))
        """(3,) unit, direction of the fingers at zero."""

    def _moved(self, motor: int) -> set[str]:
        """Names of the joints moved by a motor."""
        pulled = set(self.hand.motors[motor].joints)
        followers = {x.joint for x in self.hand.couplings if x.leader in pulled}
        return pulled | followers

    def _place(self, motors: np.ndarray) -> None:
        """Moves the model to motor positions."""
        self._data.qpos[6:] = joint_positions(self.hand, motors)

    def tips(self, motors: np.ndarray) -> np.ndarray:
        """Returns tips (tips, 3) in the wrist frame, thumb first, m."""
        self._place(motors)
        mujoco.mj_kinematics(self._model, self._data)
        rotations = self._data.xmat[self._links].reshape(-1, 3, 3)
        offsets = np.einsum("tij,tj->ti", rotations, self._tip_offsets)
        return self._data.xpos[self._links] + offsets

    def gap(self, motors: np.ndarray) -> np.ndarray:
        """Returns vectors (fingers, 3) from the thumb's tip to the others', m.

        Their lateral offsets are those of the fingers' mean.
        """
        tips = self.tips(motors)
        middle = tips[1:].mean(0) - tips[0]
        return (tips[1:] - tips[0]) @ self.across + middle @ (np.eye(3) - self.across)

    def pads(self, motors: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Returns unit directions (tips, 3) of the tips as their last joints close.

        Args:
          motors: (M,) positions.
          direction: (M,) sign in which each motor closes.
        """
        tips = self.tips(motors)
        mujoco.mj_comPos(self._model, self._data)
        pads = np.zeros((len(tips), 3))
        jacobian = np.zeros((3, self._model.nv))
        for i, motor in enumerate(self._last_motors):
            mujoco.mj_jac(self._model, self._data, jacobian, None, tips[i], self._links[i])
            velocity = jacobian[:, 6:] @ self._ratios[motor] * (direction[motor] or 1.0)
            pads[i] = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
        return pads

    def closing(self, motors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns how motors bring their tips together.

        With many fingers in a row the outer ones need not reach the hand's centre: the weight of
        lateral motion decreases with their number.

        Args:
          motors: (M,) positions.

        Returns:
          Share (M,) of the motion of each motor's tip towards the hand's centre, and speed (M,) of
          the tip, m/rad.
        """
        tips = self.tips(motors)
        towards = 0.5 * (tips[0] + tips[1:].mean(0)) - tips
        lateral = towards @ (np.eye(3) - self.across)
        towards = towards @ self.across + lateral / max(len(tips) - 2, 1)
        towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
        share = np.zeros(len(motors))
        speed = np.zeros(len(motors))
        for m in range(len(motors)):
            step = np.zeros(len(motors))
            step[m] = _DIFFERENCE
            difference = self.tips(motors + step) - self.tips(motors - step)
            velocity = difference / (2 * _DIFFERENCE)
            fastest = int(np.argmax(np.linalg.norm(velocity, axis=-1)))
            speed[m] = np.linalg.norm(velocity[fastest])
            share[m] = (velocity[fastest] @ towards[fastest]) / max(speed[m], 1e-9)
        return share, speed

    def touching(self, motors: np.ndarray) -> set[str]:
        """Returns root links of the fingers that touch one another or the palm ("")."""
        self._place(motors)
        mujoco.mj_fwdPosition(self._model, self._data)
        contacts = self._data.contact.geom[self._data.contact.dist < 0]
        touching: set[str] = set()
        for first, second in self._model.geom_bodyid[contacts].tolist():
            pair = {self._finger_of_body[first], self._finger_of_body[second]}
            if len(pair) > 1:
                touching |= pair
        return touching


def _open_hand(body: _Body, random_starts: int) -> _OpenHand:
    """The open hand: thumb and fingers face each other across the opening.

    A gripper, whose two fingers have a motor each or share one, opens as wide as it can.

    Args:
      body: the hand.
      random_starts: starts of the search in addition to the standard ones.
    """
    lower, upper = body.limits
    flat = np.clip(0.0, lower, upper)
    pinch = _pinch(body, flat, random_starts)
    closing_way = _closing_way(body, flat, pinch)
    share, _ = body.closing(0.5 * (flat + pinch))
    flexes = ~body.thumb & (share * np.sign(closing_way) > _MIN_TOWARDS)
    closed_end = np.where(closing_way > 0, upper, lower)
    is_gripper = len(body.roots) == 2 and len(lower) <= 2
    rest = flat
    if not is_gripper:
        rest = np.where(flexes, flat + _FLEXED * (closed_end - flat), flat)
    # Fingers spread only if it helps
    weight = np.where(body.thumb, 4.0, np.where(flexes, 8.0, 24.0))
    straight = body.tips(flat)
    straight_opening = float(np.linalg.norm(straight[1:].mean(0) - straight[0]))
    target = _OPENING * min(1.0, straight_opening / body.size)
    facing_weight = 0.5
    if is_gripper:
        target = _GRIPPER_OPENING
        facing_weight = 0.0

    def residuals(motors: np.ndarray) -> np.ndarray:
        """Residuals of the pads' directions, the tips' positions, and the motion from rest."""
        tips = body.tips(motors)
        pads = body.pads(motors, np.sign(closing_way))
        between = tips[1:].mean(0) - tips[0]
        distance = float(np.linalg.norm(between))
        thumb_facing = pads[0] - between / distance
        fingers_facing = (pads[1:] + between / distance) / np.sqrt(len(pads) - 1)
        facing = facing_weight * np.concatenate([thumb_facing, *fingers_facing])
        lateral = (between - body.across @ between) / body.size
        behind = np.maximum(_MIN_AHEAD - (tips - body.roots) @ body.ahead / body.size, 0.0)
        opening_error = [distance / body.size - target]
        effort = weight * _effort(motors - rest)
        return np.concatenate([facing, lateral, behind, opening_error, effort])

    starts = [rest, 0.5 * (rest + pinch), pinch]
    opened, cost = _least_squares(body, residuals, starts, random_starts)
    pinch_gap = float(np.linalg.norm(body.gap(pinch), axis=-1).max())
    return _OpenHand(opened, cost, pinch_gap)


def _closing_way(body: _Body, flat: np.ndarray, pinch: np.ndarray) -> np.ndarray:
    """Motion (M,) of each motor in the closing direction.

    That is the one of the pinch, or towards the longer side of the range if the pinch does not turn
    the motor.
    """
    lower, upper = body.limits
    longer_side = lower + upper - 2 * flat
    turns = np.abs(pinch - flat) > _MIN_TURNED * (upper - lower)
    is_symmetric = np.abs(longer_side) < _MAX_ASYMMETRY * (upper - lower)
    return np.where(turns | is_symmetric, pinch - flat, longer_side)


def _pinch(body: _Body, flat: np.ndarray, random_starts: int) -> np.ndarray:
    """Motors (M,) where the tips meet, or are nearest, on the shortest path from `flat`."""
    lower, upper = body.limits

    def residuals(motors: np.ndarray) -> np.ndarray:
        gap = body.gap(motors) / body.size
        return np.concatenate([(gap / np.sqrt(len(gap))).ravel(), _effort(motors - flat)])

    longer = np.where(upper > -lower, upper, lower)
    starts = [flat + 0.4 * (end - flat) for end in (lower, upper, longer)]
    pinch, _ = _least_squares(body, residuals, starts, random_starts)
    return pinch


def _effort(way: np.ndarray) -> np.ndarray:
    """Residuals (M,) of a motion (M,) of the motors, rad."""
    return _EFFORT_WEIGHT * way / np.sqrt(len(way))


def _least_squares(
    body: _Body,
    residuals: Callable[[np.ndarray], np.ndarray],
    starts: list[np.ndarray],
    random_starts: int,
) -> tuple[np.ndarray, float]:
    """Motors (M,) with the least squares of residuals, and half the squares."""
    lower, upper = body.limits
    rng = np.random.default_rng(0)
    more_starts = [rng.uniform(lower, upper) for _ in range(random_starts)]
    results = []
    for start in (*starts, *more_starts):
        inside = np.clip(start, lower + 1e-6, upper - 1e-6)
        result = least_squares(residuals, inside, bounds=(lower, upper), max_nfev=_MAX_EVALUATIONS)
        results.append(result)
    best = min(results, key=lambda result: float(result.cost))
    return np.asarray(best.x), float(best.cost)


def _closed(body: _Body, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Motors (M,) on the way from `start` to `end`, barely beyond contact of their fingers."""
    share = np.zeros(len(start))
    moving = np.ones(len(start), bool)
    before = body.touching(start)
    for _ in range(_CLOSING_STEPS):
        next_share = np.where(moving, share + 1.0 / _CLOSING_STEPS, share)
        met = body.touching(start + next_share * (end - start)) - before - {""}
        moving &= ~np.array([bool(met & fingers) for fingers in body.fingers])
        share = np.where(moving, next_share, share)
    way = end - start
    squeeze = np.where(moving, 0.0, _SQUEEZE * np.sign(way))
    return start + np.clip(share * way + squeeze, -np.abs(way), np.abs(way))
