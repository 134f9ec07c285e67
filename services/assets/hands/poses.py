"""Computes a thumb, an open and a closed pose from kinematics, for a hand whose file has none.

First a pinch is computed: the pose nearest to zero in which the thumb's tip meets the others'. It
determines the closing direction of joints. The open hand is then turned and spread so that thumb
and fingers face each other over an opening of slightly more than a finger's length. It closes by
every joint that brings them together.
"""

import dataclasses
import re
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from congrasp.common.errors import CongraspError
from congrasp.common.hands.mjcf import add_hand
from congrasp.common.hands.motors import joint_positions, motor_limits, motor_positions
from congrasp.common.hands.spec import Hand, chain_of, link_origin
from congrasp.common.runtime.mujoco import mujoco

# Share of the range from zero to a joint's end at which it is closed, where thumb and fingers can
# meet
_CLOSED = 0.8
_FLEXED = 0.15  # the same for the fingers of an open hand, unless other terms matter
_SQUEEZE = 0.3  # rad by which motors continue after their fingers have met the palm or others
# Distance between the tips of an open hand in finger lengths; or as a share of that at zero, if
# smaller
_OPENING = 1.25
_AHEAD = (
    0.3  # least distance of the tips of an open hand ahead of the fingers' bases, in finger lengths
)
_TOWARDS = 0.6  # least share of a tip's motion towards the hand's centre, for a closing joint
_TURNED = 0.1  # least share of a joint's range in the pinch that determines its closing direction
_ALIKE = 0.3  # asymmetry of a joint's range that determines it otherwise
_EFFORT = 0.1  # weight of a radian of all joints relative to a finger length
_STILL = 0.004  # m/rad below which a joint does not move its tip
_APART = 0.02  # distance at which tips count as touching, m
_MORE = 4  # number of random starts
_STEPS = 40
_THUMB = re.compile(r"thumb|(^|_)th(j?\d|base|prox|hub|mid|dist)", re.IGNORECASE)


def thumb_of(hand: Hand, wanted: str, notes: list[str]) -> str:
    """Returns the last link of the finger named as a thumb, or else of the one that best faces all
    others.

    Raises:
      CongraspError: `wanted` is not the last link of a finger.
    """
    tips = [link.name for link in hand.links if link.tip is not None]
    if wanted:
        if wanted not in tips:
            raise CongraspError(
                f"'{wanted}' is not the last link of a finger.", f"Pass one of: {', '.join(tips)}."
            )
        return wanted
    for tip in tips:
        chain = [link for link in hand.links if link.name in chain_of(hand, tip)]
        if any(
            _THUMB.search(name)
            for link in chain
            for name in (link.name, *(j.name for j in link.joints))
        ):
            return tip
    costs = [_faced(_Body(dataclasses.replace(hand, thumb=tip)), 0)[1] for tip in tips]
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
    opened, _, apart = _faced(body, _MORE)
    if apart > _APART:
        notes.append(
            f"thumb and fingers do not meet, {100 * apart:.0f} cm remain between their tips "
            f"(--thumb, or 'open_pose'"
            " and 'closed_pose' in the hand file)"
        )
    lower, upper = body.limits
    flat = np.clip(0.0, lower, upper)
    share, speed = body.closing(opened)
    closing = (np.abs(share) > _TOWARDS) & (speed > _STILL)
    ends = np.where(share > 0, upper, lower)
    far = _CLOSED if apart <= _APART else 1.0
    target = flat + far * (ends - flat)
    target = np.where(np.sign(share) * (target - opened) > 0, target, ends)
    closed = _closed(body, opened, np.where(closing, target, opened))
    names = [
        joint.name for joint in hand.joints if joint.name not in {x.joint for x in hand.couplings}
    ]

    def pose(motors: np.ndarray) -> dict[str, float]:
        """Angles of the joints that follow none by name, without zeros."""
        angles = joint_positions(hand, motors.astype(np.float32))
        q = {joint.name: angle for joint, angle in zip(hand.joints, angles, strict=True)}
        return {name: round(float(q[name]), 6) for name in names if abs(q[name]) > 1e-4}

    return dataclasses.replace(hand, open_pose=pose(opened), closed_pose=pose(closed))


def opening(hand: Hand) -> float:
    """Distance between the thumb's tip and the mean of the others in the open pose, m."""
    tips = _Body(hand).tips(motor_positions(hand, hand.q_open))
    return float(np.linalg.norm(tips[1:].mean(0) - tips[0]))


class _Body:
    """A hand in MuJoCo, moved by its motors (M,)."""

    def __init__(self, hand: Hand):
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_hand(spec, hand, self_collision=True)
        self.hand, self.limits = hand, motor_limits(hand).astype(float)
        self._model = spec.compile()
        self._ratios = [
            joint_positions(hand, row) - joint_positions(hand, 0 * row)
            for row in np.eye(len(hand.motors))
        ]
        self._data = mujoco.MjData(self._model)
        self._links = [self._model.body(hand.links[i].name).id for i in hand.tip_links]
        self._local = np.array(
            [
                np.subtract(hand.links[i].tip, link_origin(hand.links[i]))  # type: ignore[arg-type]
                for i in hand.tip_links
            ]
        )
        roots = [next(iter(chain_of(hand, link.name)), "") for link in hand.links]
        self._finger = {
            self._model.body(link.name).id: root
            for link, root in zip(hand.links, roots, strict=True)
        }
        carrier = {
            joint.name: root
            for link, root in zip(hand.links, roots, strict=True)
            for joint in link.joints
        }
        self.fingers = [{carrier[name] for name in self._moved(m)} for m in range(len(hand.motors))]
        """Root links of the fingers moved by each motor."""
        self.thumb = np.array([hand.finger_roots[0] in fingers for fingers in self.fingers])
        """(M,) bool: motors of the thumb."""
        origins = {link.name: link_origin(link) for link in hand.links}
        self.roots = np.array([origins[root] for root in hand.finger_roots])
        """(tips, 3) bases of the fingers, thumb first."""
        tips = self.tips(np.clip(0.0, *self.limits))
        row = tips[1:] - tips[1:].mean(0)
        sideways = np.linalg.svd(row)[2][0] if len(row) > 1 else np.zeros(3)
        self.across = np.eye(3) - np.outer(sideways, sideways)
        """Projection that removes the direction in which the fingers are side by side."""
        last = [list(link.joints)[-1].name for link in (hand.links[i] for i in hand.tip_links)]
        self._last = [
            next(m for m in range(len(hand.motors)) if name in self._moved(m)) for name in last
        ]
        straight = (tips - self.roots)[1:]
        self.size = float(np.linalg.norm(straight, axis=-1).mean())
        """Length of the fingers, m."""
        self.ahead = straight.mean(0) / np.linalg.norm(straight.mean(0))
        """(3,) unit, direction of the fingers at zero."""

    def _moved(self, m: int) -> set[str]:
        """Names of the joints moved by a motor."""
        pulled = {*self.hand.motors[m].joints}
        return pulled | {x.joint for x in self.hand.couplings if x.leader in pulled}

    def _place(self, motors: np.ndarray) -> None:
        """Moves the model to motor positions."""
        self._data.qpos[6:] = joint_positions(self.hand, motors)

    def tips(self, motors: np.ndarray) -> np.ndarray:
        """Tips (tips, 3) in the wrist frame, thumb first."""
        self._place(motors)
        mujoco.mj_kinematics(self._model, self._data)
        turns = self._data.xmat[self._links].reshape(-1, 3, 3)
        return self._data.xpos[self._links] + np.einsum("tij,tj->ti", turns, self._local)

    def gap(self, motors: np.ndarray) -> np.ndarray:
        """Vectors (fingers, 3) from the thumb's tip to the others', without their lateral
        offsets.
        """
        tips = self.tips(motors)
        middle = tips[1:].mean(0) - tips[0]
        return (tips[1:] - tips[0]) @ self.across + middle @ (np.eye(3) - self.across)

    def pads(self, motors: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Unit directions (tips, 3) of the tips as their last joints close, with signs `way`
        (M,).
        """
        tips = self.tips(motors)
        mujoco.mj_comPos(self._model, self._data)
        found, jacobian = np.zeros((len(tips), 3)), np.zeros((3, self._model.nv))
        for i, m in enumerate(self._last):
            mujoco.mj_jac(self._model, self._data, jacobian, None, tips[i], self._links[i])
            moved = jacobian[:, 6:] @ self._ratios[m] * (way[m] or 1.0)
            found[i] = moved / max(float(np.linalg.norm(moved)), 1e-9)
        return found

    def closing(self, motors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share (M,) of each motor's motion of its tip towards the hand's centre, and the tip's
        speed, m/rad.

        With many fingers in a row the outer ones need not reach its centre: the weight decreases
        with their number.
        """
        tips = self.tips(motors)
        towards = 0.5 * (tips[0] + tips[1:].mean(0)) - tips
        towards = towards @ self.across + towards @ (np.eye(3) - self.across) / max(
            len(tips) - 2, 1
        )
        towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
        share, speed = np.zeros(len(motors)), np.zeros(len(motors))
        for m in range(len(motors)):
            step = np.zeros(len(motors))
            step[m] = 0.02
            moved = (self.tips(motors + step) - self.tips(motors - step)) / 0.04
            i = int(np.argmax(np.linalg.norm(moved, axis=-1)))
            speed[m] = np.linalg.norm(moved[i])
            share[m] = (moved[i] @ towards[i]) / max(speed[m], 1e-9)
        return share, speed

    def touching(self, motors: np.ndarray) -> set[str]:
        """Root links of the fingers that touch one another or the palm ("")."""
        self._place(motors)
        mujoco.mj_fwdPosition(self._model, self._data)
        bodies = self._model.geom_bodyid[self._data.contact.geom[self._data.contact.dist < 0]]
        pairs = [{self._finger[a], self._finger[b]} for a, b in bodies.tolist()]
        return set().union(*(pair for pair in pairs if len(pair) > 1))


def _faced(body: _Body, more: int) -> tuple[np.ndarray, float, float]:
    """Motors (M,) of the open hand, its residual, and the distance between tips in a pinch, m.

    `more` random starts are tried in addition to the standard ones.
    """
    lower, upper = body.limits
    flat = np.clip(0.0, lower, upper)
    pinch = _pinch(body, flat, more)
    longer = lower + upper - 2 * flat
    goes = (np.abs(pinch - flat) > _TURNED * (upper - lower)) | (
        np.abs(longer) < _ALIKE * (upper - lower)
    )
    way = np.where(goes, pinch - flat, longer)
    share, _ = body.closing(0.5 * (flat + pinch))
    flexing = ~body.thumb & (share * np.sign(way) > _TOWARDS)
    rest = np.where(flexing, flat + _FLEXED * (np.where(way > 0, upper, lower) - flat), flat)
    # Fingers spread only if it helps
    weight = np.where(body.thumb, 4.0, np.where(flexing, 8.0, 24.0))
    straight = body.tips(flat)
    target = _OPENING * min(
        1.0, float(np.linalg.norm(straight[1:].mean(0) - straight[0])) / body.size
    )

    def residuals(motors: np.ndarray) -> np.ndarray:
        """Residuals of pads of thumb and fingers, which should face each other across the
        opening.
        """
        tips, pads = body.tips(motors), body.pads(motors, np.sign(way))
        between = tips[1:].mean(0) - tips[0]
        wide = float(np.linalg.norm(between))
        facing = 0.5 * np.concatenate(
            [pads[0] - between / wide, *(pads[1:] + between / wide) / np.sqrt(len(pads) - 1)]
        )
        aside = (between - body.across @ between) / body.size
        back = np.maximum(_AHEAD - (tips - body.roots) @ body.ahead / body.size, 0.0)
        spent = weight * _effort(motors - rest)
        return np.concatenate([facing, aside, back, [wide / body.size - target], spent])

    opened, cost = _least(body, residuals, [rest, 0.5 * (rest + pinch), pinch], more)
    return opened, cost, float(np.linalg.norm(body.gap(pinch), axis=-1).max())


def _pinch(body: _Body, flat: np.ndarray, more: int) -> np.ndarray:
    """Motors (M,) where the tips meet, or are nearest, on the shortest path from `flat`."""
    lower, upper = body.limits

    def residuals(motors: np.ndarray) -> np.ndarray:
        gap = body.gap(motors) / body.size
        return np.concatenate([(gap / np.sqrt(len(gap))).ravel(), _effort(motors - flat)])

    longer = np.where(upper > -lower, upper, lower)
    starts = [flat + 0.4 * (end - flat) for end in (lower, upper, longer)]
    return _least(body, residuals, starts, more)[0]


def _effort(way: np.ndarray) -> np.ndarray:
    """Residuals (M,) of a motion (M,) of the motors, rad."""
    return _EFFORT * way / np.sqrt(len(way))


def _least(
    body: _Body, residuals: Callable[[np.ndarray], np.ndarray], starts: list[np.ndarray], more: int
) -> tuple[np.ndarray, float]:
    """Motors (M,) with the least squares of residuals, from these starts and `more` others; half
    the squares.
    """
    lower, upper = body.limits
    rng = np.random.default_rng(0)
    found = [
        least_squares(
            residuals,
            np.clip(start, lower + 1e-6, upper - 1e-6),
            bounds=(lower, upper),
            max_nfev=40,
        )
        for start in (*starts, *(rng.uniform(lower, upper) for _ in range(more)))
    ]
    best = min(found, key=lambda result: float(result.cost))
    return np.asarray(best.x), float(best.cost)


def _closed(body: _Body, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Motors (M,) reached from `start` towards `end`: barely beyond contact of fingers with palm or
    others.
    """
    share = np.zeros(len(start))
    going = np.ones(len(start), bool)
    before = body.touching(start)
    for _ in range(_STEPS):
        ahead = np.where(going, share + 1.0 / _STEPS, share)
        met = body.touching(start + ahead * (end - start)) - before - {""}
        going &= ~np.array([bool(met & fingers) for fingers in body.fingers])
        share = np.where(going, ahead, share)
    way = end - start
    return start + np.clip(
        share * way + np.where(going, 0.0, _SQUEEZE * np.sign(way)), -np.abs(way), np.abs(way)
    )
