"""Planned approach of the hand from the side to the start of a grasp: smooth and free of contact.

The wrist follows a cubic Bezier curve that ends along the heading. Its share s(x) of the arc
length, x = t / T, has minimum jerk (Flash and Hogan 1985) from rest to the speed at which the
policy takes over: s = (10 - 4 m) x^3 + (7 m - 15) x^4 + (6 - 3 m) x^5 with m = v T / length.
Rotation and fingers come to rest (m = 0).
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common import rotations
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.spec import Hand, link_origin
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.spec import GraspObject
from congrasp.services.viz.hand_shapes import link_frames, upright

SPEED = 1.0
"""Limit of the wrist's speed, m/s."""
ACCELERATION = 15.0
"""Limit of the wrist's acceleration, m/s^2."""
TURNING = 5.0
"""Limit of the wrist's angular speed, rad/s."""
CLEARANCE = 0.01
"""Least clearance of the hand from object and table, m; near the end of the curve, that of the
start of the grasp if that is smaller."""
_NEAR_END = 0.8
"""Share of the curve beyond which the clearance may be that of the start of the grasp."""
_BESIDE = 0.45
"""Initial distance of wrist and object's centre, m."""
_ABOVE = 0.04
"""Initial distance of hand and table, m."""
_WAY = 0.22
"""Least horizontal distance by which the wrist starts further from the object than the grasp does,
m."""
_BESIDE_WITH_ARM = 0.12
"""Initial distance of wrist and object's centre for a hand whose arm needs room, m."""
_ABOVE_WITH_ARM = 0.2
"""Initial distance of hand and table for a hand whose arm needs room, m."""
_DOWN_WITH_ARM = math.radians(60.0)
"""Angle by which the fingers of a hand on an arm point down."""
_RELAXED = 0.15
"""Initial share of the fingers' way from the open to the closed pose."""
_CHECKED = 25
"""Number of poses of the curve that are checked."""
_ALONG = 5
"""Number of points on a capsule's axis."""
_AZIMUTHS = np.radians([0, 30, -30, 60, -60, 100, -100, 140, -140, 180])
_FINE = 401
"""Number of points of the curve."""
_MAX_STRETCH = 50.0
"""Largest factor on the requested duration."""
_BACK = (0.08, 0.15, 0.22)
"""Distances of the curve's middle point from its end, against the heading, m."""
_UP = (0.0, 0.10, 0.20, 0.32)
"""Distances of the curve's middle point above its end, m."""
_TOLERANCE = 1e-3
"""Tolerance of the clearance, m."""


class NoReachError(CongraspError):
    """Every planned approach to the grasp touches the object or the table."""


class Reach(NamedTuple):
    """N poses of a hand, a control step apart; the grasp begins at the next one."""

    position: np.ndarray
    """(N, 3) m, wrist, world."""
    rotation: Rotation
    """N orientations of the wrist, to the world frame."""
    q: np.ndarray
    """(N, F) rad."""


class _Curve(NamedTuple):
    """A path of the wrist and fingers."""

    points: np.ndarray
    """(n, 3) along it, m."""
    length: np.ndarray
    """(n,) m, from its beginning."""
    turns: Slerp
    fingers: np.ndarray
    """(2, F) rad."""

    def at(self, x: np.ndarray, seconds: float, speed: float) -> Reach:
        """Poses at shares x (N,) of the time T = `seconds`, with `speed` (m/s) at its end.

        The wrist never moves back: s'(x) >= 0 needs m <= 5/2. With a longer T it starts later.
        """
        way = self.way(x, seconds, speed) * self.length[-1]
        position = np.stack([np.interp(way, self.length, axis) for axis in self.points.T], -1)
        share = np.clip(_minimum_jerk(x, 0.0), 0.0, 1.0)
        s = share[:, None]
        return Reach(position, self.turns(share), (1 - s) * self.fingers[0] + s * self.fingers[1])

    def way(self, x: np.ndarray, seconds: float, speed: float) -> np.ndarray:
        """Shares (N,) of the arc length at shares x (N,) of the time, see `at`."""
        moving = min(seconds, 2.5 * self.length[-1] / speed) if speed else seconds
        since = np.clip(1.0 - (1.0 - x) * seconds / moving, 0.0, 1.0)
        return _minimum_jerk(since, speed * moving / self.length[-1])


def _minimum_jerk(x: np.ndarray, end: float) -> np.ndarray:
    """s(x) (N,) from rest at 0 to slope `end` at 1, without acceleration at both."""
    return (10 - 4 * end) * x**3 + (7 * end - 15) * x**4 + (6 - 3 * end) * x**5


def plan_reach(  # noqa: PLR0913
    hand: Hand,
    obj: GraspObject,
    rest: np.ndarray,
    heading: np.ndarray,
    first: Reach,
    seconds: float,
    dt: float,
    speed: float = 0.0,
    side: float | None = None,
) -> Reach:
    """Plans the approach to the start of a grasp.

    Args:
      hand: the hand.
      obj: the object.
      rest: (7,) pose of the object on the table, world frame.
      heading: (3,) unit vector of the approach, world frame.
      first: the single pose (N = 1) in which the grasp begins.
      seconds: requested duration; extended where the wrist would exceed `SPEED`, `ACCELERATION` or
        `TURNING`.
      dt: length of a control step, s.
      speed: speed of the wrist at the end, along the heading, m/s.
      side: azimuth of the arm's base as seen from the object, rad: the hand starts there, and
        higher. None if there is no arm.

    Raises:
      NoReachError: every curve that was tried touches the object or the table.
    """
    x = np.linspace(0, 1, _CHECKED)
    checked = _minimum_jerk(x, 0.0)
    field = distance_field([obj])
    relaxed = hand.q_open + _RELAXED * (hand.q_closed - hand.q_open)
    fingers = np.stack([relaxed, first.q[0]])
    axes = axes_in_wrist(hand, (1 - checked[:, None]) * fingers[0] + checked[:, None] * fingers[1])
    # As many poses as a curve has: another number would be compiled again
    every = np.zeros(_CHECKED, int)
    ends = Reach(first.position[every], first.rotation[every], first.q[every])
    end = clearances(hand, field, rest, axes[-1:][every], ends)[:, 0]
    lowest = (
        _first_turn(hand, np.array([1.0, 0.0, 0.0]), side).apply(axes[0])[:, 2] - _radii(hand)
    ).min()
    for curve in _curves(hand, rest, heading, first, fingers, -float(lowest), side):
        steps = math.ceil(_duration(curve, seconds, speed) / dt)
        clearance = clearances(hand, field, rest, axes, curve.at(x, steps * dt, speed))
        far = curve.way(x, steps * dt, speed) <= _NEAR_END
        needed = np.where(far, CLEARANCE, np.minimum(CLEARANCE, end[:, None])) - _TOLERANCE
        if (clearance >= needed).all():
            return curve.at(np.arange(steps) / steps, steps * dt, speed)
    raise NoReachError(
        f"Every planned approach to a grasp of '{obj.name}' touches the object or the table.",
        "Leave out the approach, or set another heading.",
    )


def _curves(
    hand: Hand,
    rest: np.ndarray,
    heading: np.ndarray,
    first: Reach,
    fingers: np.ndarray,
    height: float,
    side: float | None,
) -> Iterator[_Curve]:
    """Curves to try, the simplest first; `fingers` (2, F) at both ends, `height` (m) of the wrist
    on the table.
    """
    end = first.position[0]
    height += _ABOVE if side is None else _ABOVE_WITH_ARM
    out = float(np.linalg.norm((end - rest[:3])[:2]))
    beside = max(_BESIDE, out + _WAY) if side is None else _BESIDE_WITH_ARM
    aside = end - rest[:3] if out > 0.03 else -heading
    ahead = math.atan2(aside[1], aside[0]) if side is None else side
    for up, azimuth, back in itertools.product(_UP, _AZIMUTHS, _BACK):
        outward = np.array([np.cos(ahead + azimuth), np.sin(ahead + azimuth), 0.0])
        begin = np.array([*(rest[:3] + beside * outward)[:2], height])
        middle = end - back * heading + [0.0, 0.0, up]
        middle[2] = max(middle[2], 0.06)
        turns = Rotation.concatenate([_first_turn(hand, -outward, side), first.rotation[0]])
        s = np.linspace(0, 1, _FINE)[:, None]
        last = end - back / 3 * heading
        points = (
            (1 - s) ** 3 * begin
            + 3 * s * (1 - s) ** 2 * middle
            + 3 * s**2 * (1 - s) * last
            + s**3 * end
        )
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        yield _Curve(points, length, Slerp([0, 1], turns), fingers)


def _first_turn(hand: Hand, forward: np.ndarray, side: float | None) -> Rotation:
    """Wrist orientation with the fingers along a level direction (3,), inclined on an arm, and the
    palm down.
    """
    # `upright` has the fingers up and the palm towards +x.
    across = np.cross(forward, [0.0, 0.0, -1.0])
    palm_down = Rotation.from_matrix(np.stack([[0.0, 0.0, -1.0], across, forward], -1))
    down = 0.0 if side is None else _DOWN_WITH_ARM
    return Rotation.from_rotvec(down * across) * palm_down * upright(hand)


def axes_in_wrist(hand: Hand, q: np.ndarray) -> np.ndarray:
    """(N, P, 3) points on the axes of the hand's capsules in the wrist frame, at finger angles (N,
    F).
    """
    share = np.linspace(0, 1, _ALONG)[:, None]
    # (C, _ALONG, 3)
    along = hand.capsules[:, :1] + share * (hand.capsules[:, 1:] - hand.capsules[:, :1])
    origins = np.array([link_origin(link) for link in hand.links])
    links = hand.capsule_links
    local = along - origins[links][:, None]
    axes = []
    for angles in q:
        position, quaternion = mujoco_link_poses(hand, angles)
        matrices = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()[links]
        axes.append(
            (np.einsum("cij,cpj->cpi", matrices, local) + position[links][:, None]).reshape(-1, 3)
        )
    return np.array(axes)


def clearances(
    hand: Hand, field: DistanceField, rest: np.ndarray, axes: np.ndarray, poses: Reach
) -> np.ndarray:
    """(2, N) m between the hand's capsules and the object, and the table.

    Args:
      hand: the hand.
      field: distance field whose first grid is that of the object.
      rest: (7,) pose of the object, world frame.
      axes: (N, P, 3) from `axes_in_wrist`, at the poses' finger angles.
      poses: N poses of the wrist.
    """
    radii = _radii(hand)
    world = np.einsum("nij,npj->npi", poses.rotation.as_matrix(), axes) + poses.position[:, None]
    back = Rotation.from_quat(rest[3:], scalar_first=True).inv()
    inside = back.apply(world.reshape(-1, 3) - rest[:3]).astype(np.float32)
    distance = np.asarray(_at(field, inside)).reshape(len(world), -1)
    return np.stack([(distance - radii).min(1), (world[..., 2] - radii).min(1)])


def _radii(hand: Hand) -> np.ndarray:
    """(P,) m, of the capsules of `axes_in_wrist`."""
    return np.repeat(hand.capsule_radii, _ALONG)


_nearest_angles = jax.jit(rotations.quaternion_to_euler)


@jax.jit
def _at(field: DistanceField, points: np.ndarray) -> jax.Array:
    """(n,) signed distances of points (n, 3) of the object frame, in one program."""
    return field.at(jnp.zeros(1, int), points[None])[0]


def _duration(curve: _Curve, seconds: float, speed: float) -> float:
    """Duration of a curve in s at which the wrist keeps to its limits.

    It is the requested duration, or else the shortest of the longer ones that are tried.

    Args:
      curve: the curve.
      seconds: requested duration.
      speed: speed of the wrist at the end, m/s.
    """
    x = np.linspace(0, 1, _FINE)
    for duration in seconds * np.geomspace(1.0, _MAX_STRETCH, 100):
        poses = curve.at(x, duration, speed)
        h = duration * x[1]
        velocity = np.diff(poses.position, axis=0) / h
        fastest = np.linalg.norm(velocity, axis=1).max() / SPEED
        hardest = np.linalg.norm(np.diff(velocity, axis=0) / h, axis=1).max() / ACCELERATION
        turning = (poses.rotation[:-1].inv() * poses.rotation[1:]).magnitude().max() / h / TURNING
        if max(fastest, hardest, turning) <= 1.0:
            break
    return float(duration)


def with_planned_reach(
    episode: Episode,
    hand: Hand,
    obj: GraspObject,
    seconds: float,
    speed: float,
    side: float | None = None,
) -> Episode:
    """The episode with the planned approach before it; see `plan_reach` for the arguments and
    errors.
    """
    position = episode.object_position[0].astype(float)
    quaternion = episode.object_quaternion[0].astype(float)
    rest = np.concatenate([position, quaternion])
    turns = Rotation.from_quat(episode.wrist_quaternion[:1].astype(float), scalar_first=True)
    first = Reach(
        episode.wrist_position[:1].astype(float), turns, episode.joint_position[:1].astype(float)
    )
    direction = episode.goal["heading_direction"].astype(float)
    heading = Rotation.from_quat(quaternion, scalar_first=True).apply(direction)
    dt = episode.control_dt
    reach = plan_reach(hand, obj, rest, heading, first, seconds, dt, speed, side)
    return with_reach(episode, hand, reach)


def with_reach(episode: Episode, hand: Hand, reach: Reach) -> Episode:
    """The episode with an approach before it; its `phases` are shifted accordingly.

    During the approach the object rests, there is no contact, and errors are those of the first
    step.
    """
    steps = len(reach.q)
    resting = episode.at_frames(np.zeros(steps, int))
    recorded = resting.require_recorded()
    joints = _wrist_joints(episode, reach)
    frames = []
    for pose in zip(reach.q, reach.position, reach.rotation, strict=True):
        frames.append(link_frames(hand, *pose))
    approach = dataclasses.replace(
        resting,
        link_position=np.stack([position for position, _ in frames]),
        link_quaternion=np.stack([quaternion for _, quaternion in frames]),
        link_force=np.zeros_like(resting.link_force),
        joint_position=reach.q,
        joint_target=reach.q,
        recorded=dataclasses.replace(
            recorded,
            wrist_joints=joints,
            wrist_targets=joints,
            action=np.zeros_like(recorded.action),
            rewards={name: np.zeros_like(values) for name, values in recorded.rewards.items()},
        ),
    )
    seconds = steps * episode.control_dt
    phases = {"approach": 0.0}
    for name, begin in episode.phases.items():
        phases[name] = begin + seconds
    longer = episode.preceded_by(approach)
    return dataclasses.replace(longer, about={**episode.about, "phases": phases})


def _wrist_joints(episode: Episode, reach: Reach) -> np.ndarray:
    """(N, 6) virtual wrist joints, with the base that follows from joints and pose of the first
    step.
    """
    first = episode.require_recorded().wrist_joints[0].astype(float)
    turn = Rotation.from_euler("XYZ", first[3:])
    base = Rotation.from_quat(episode.wrist_quaternion[0], scalar_first=True) * turn.inv()
    origin = episode.wrist_position[0] - base.apply(first[:3])
    turned = (base.inv() * reach.rotation).as_quat(scalar_first=True)
    hinges = np.zeros((len(turned), 3))
    near = first[3:]
    for i in reversed(range(len(turned))):  # from the grasp backwards, so that no angle jumps
        hinges[i] = _nearest_angles(turned[i], near)
        near = hinges[i]
    return np.concatenate([base.inv().apply(reach.position - origin), hinges], 1)
