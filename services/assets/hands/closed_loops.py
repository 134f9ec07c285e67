"""Closed loops of links, whose other joints follow the one that drives the loop.

A hand is a tree of links, so that the import opens a loop where the file connects two links. The
joints without a motor then follow the driven one as in the closed loop, linearised over its range.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.follow import Follow
from congrasp.services.assets.hands.palm import hinges
from congrasp.services.assets.hands.reading import listed
from congrasp.services.assets.hands.tendons import relative_limits

_STEPS = 20
"""Angles on either side of the file's pose at which a loop is closed."""
_MAX_GAP_M = 5e-4
"""Distance of the connected points up to which a loop is closed, m."""
_MAX_LINEAR_GAP_M = 5e-3
"""The same for a loop whose joints are linearised, m."""
_MIN_CLOSED_SHARE = 0.25
"""Share of its range in which a driven joint can close the loop."""
_SPRING_M = 1e-4
"""Distance of the connected points that weighs as much as a spring's angle of 1 rad, m."""


class _Loop(NamedTuple):
    """A loop that a connection of two bodies closes."""

    equality: int
    leader: int
    """The joint that drives it."""
    followers: list[int]
    """Its other joints."""


class _Motion(NamedTuple):
    """Poses of a closed loop, relative to the file's pose."""

    leader: np.ndarray
    """(N,) rad."""
    followers: np.ndarray
    """(N, K) rad."""


def tied_bodies(model: mujoco.MjModel, equality: int) -> tuple[int, int]:
    """Returns the bodies that an equality of the kinds connect and weld ties to each other."""
    first = int(model.eq_obj1id[equality])
    second = int(model.eq_obj2id[equality])
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, second


def loop_couplings(
    model: mujoco.MjModel, hand: set[int], moved: set[int], notes: list[str]
) -> list[Follow]:
    """Returns the joints that follow another one because a closed loop of links has both.

    A loop is left open if not exactly one of its joints is moved, if that one can hardly turn
    without breaking it, or if its joints are not nearly proportional to one another.

    Args:
      model: the model.
      hand: the hand's joints.
      moved: joints with a motor, and those that follow others.
      notes: loops are appended.
    """
    couplings: list[Follow] = []
    left_open = False
    is_connection = model.eq_type == mujoco.mjtEq.mjEQ_CONNECT
    for equality in np.flatnonzero(is_connection & (model.eq_active0 > 0)):
        already_moved = moved | {coupling.a for coupling in couplings}
        loop = _loop(model, int(equality), hand, already_moved)
        if loop is None:
            left_open = True
            continue
        followers = _followers(model, loop)
        couplings += followers
        left_open |= not followers
    names = [model.joint(coupling.a).name for coupling in couplings]
    notes += listed("closed loops of links are replaced by joints that follow", names)
    if left_open:
        notes.append(
            "closed loops of links are opened (import a URDF whose joints mimic one another)"
        )
    return couplings


def _loop(model: mujoco.MjModel, equality: int, hand: set[int], moved: set[int]) -> _Loop | None:
    """The loop of a connection; None without one joint that drives others of the hand."""
    first, second = tied_bodies(model, equality)
    joints = _joints_to_root(model, first) ^ _joints_to_root(model, second)
    leaders = joints & moved
    followers = sorted(joints - moved)
    if not joints <= hand or len(leaders) != 1 or not followers:
        return None
    return _Loop(equality, leaders.pop(), followers)


def _joints_to_root(model: mujoco.MjModel, body: int) -> set[int]:
    """The joints that move a body."""
    joints: set[int] = set()
    while body:
        joints |= {*hinges(model, body)}
        body = int(model.body_parentid[body])
    return joints


def _followers(model: mujoco.MjModel, loop: _Loop) -> list[Follow]:
    """The joints that follow the leader of a loop; none if it must be left open."""
    joints = [loop.leader, *loop.followers]
    if not model.jnt_limited[joints].all():
        return []
    mechanism = _Mechanism(model, loop)
    motion = mechanism.motion()
    lower, upper = relative_limits(model, loop.leader)
    if np.ptp(motion.leader) <= _MIN_CLOSED_SHARE * (upper - lower):
        return []
    ratios, offsets = np.polyfit(motion.leader, motion.followers, 1)
    linear = offsets + np.outer(motion.leader, ratios)
    gaps = [mechanism.gap(q, angles) for q, angles in zip(motion.leader, linear, strict=True)]
    if np.linalg.norm(gaps, axis=-1).max() > _MAX_LINEAR_GAP_M:
        return []
    return [
        Follow(joint, loop.leader, float(ratio), float(offset))
        for joint, ratio, offset in zip(loop.followers, ratios, offsets, strict=True)
    ]


class _Mechanism:
    """A loop with the angles of its joints, relative to the file's pose."""

    def __init__(self, model: mujoco.MjModel, loop: _Loop):
        self._model = model
        self._data = mujoco.MjData(model)
        self._loop = loop
        self._addresses = model.jnt_qposadr[loop.followers]
        zero = model.qpos0[self._addresses]
        limits = np.array([relative_limits(model, joint) for joint in loop.followers])
        self._lower, self._upper = limits.T
        stiffness = model.jnt_stiffness[loop.followers]
        strongest = max(float(stiffness.max()), 1e-12)
        self._spring_weights = _SPRING_M * np.sqrt(stiffness / strongest)
        self._rest = model.qpos_spring[self._addresses] - zero

    def gap(self, leader: float, followers: np.ndarray) -> np.ndarray:
        """Returns the vector (3,) between the connected points, m.

        Args:
          leader: angle of the leader, rad.
          followers: (K,) angles of its followers, rad.
        """
        model = self._model
        data = self._data
        equality = self._loop.equality
        leader_address = model.jnt_qposadr[self._loop.leader]
        data.qpos[leader_address] = model.qpos0[leader_address] + leader
        data.qpos[self._addresses] = model.qpos0[self._addresses] + followers
        mujoco.mj_kinematics(model, data)
        first = int(model.eq_obj1id[equality])
        second = int(model.eq_obj2id[equality])
        if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
            return np.asarray(data.site_xpos[second] - data.site_xpos[first])
        anchors = model.eq_data[equality, :6].reshape(2, 3)
        first_point = data.xpos[first] + data.xmat[first].reshape(3, 3) @ anchors[0]
        second_point = data.xpos[second] + data.xmat[second].reshape(3, 3) @ anchors[1]
        return np.asarray(second_point - first_point)

    def motion(self) -> _Motion:
        """Returns poses in which the loop is closed, from the file's pose in both directions."""
        lower, upper = relative_limits(self._model, self._loop.leader)
        leader_angles = []
        follower_angles = []
        for end in (float(lower), float(upper)):
            angles = np.zeros(len(self._loop.followers))
            for leader in np.linspace(0.0, end, _STEPS):
                angles = self._closed(float(leader), angles)
                if np.linalg.norm(self.gap(float(leader), angles)) > _MAX_GAP_M:
                    break
                leader_angles.append(leader)
                follower_angles.append(angles)
        count = len(leader_angles)
        return _Motion(
            np.array(leader_angles), np.reshape(follower_angles, (count, len(self._rest)))
        )

    def _closed(self, leader: float, start: np.ndarray) -> np.ndarray:
        """Angles (K,) of the followers that close the loop best, near others.

        Springs decide what the loop leaves free.
        """

        def residuals(angles: np.ndarray) -> np.ndarray:
            """The gap, and the weighted angles of springs."""
            springs = self._spring_weights * (angles - self._rest)
            return np.concatenate([self.gap(leader, angles), springs])

        begin = np.clip(start, self._lower, self._upper)
        bounds = (self._lower, self._upper)
        solution = least_squares(residuals, begin, bounds=bounds, x_scale=1.0, xtol=1e-10)
        return np.asarray(solution.x)
