"""Stable poses of an object on a table: computed from its convex hull, then settled by physics."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import CONTACT, add_object
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.runtime.physics_library import mujoco

MAX_POSES = 8
"""Most resting poses of an object."""
_SAME_DIRECTION_COSINE = np.cos(np.radians(15))
"""Directions with a larger cosine between them count as one."""
_SAME_HEIGHT = 0.03
"""Poses whose heights differ by less than this share count as rotations of one another."""
_MAX_ROTATIONS = 4
"""Most poses that are rotations of one another."""
_MIN_LIKELIHOOD = 0.02
"""Likelihood below which a pose is dropped, unless it is the only one."""
_MAX_SPEED_AT_REST = 1e-3
"""Speed below which an object is at rest, m/s."""
_SPEED_WINDOW_S = 0.025
"""Time over which the speed is averaged, s."""
_SETTLING_S = 0.25
"""Simulated time of a round of settling, s."""
_FREE_S = 0.5
"""Simulated time after which an unstable object is recognised by its speed, s."""
_TUMBLING_S = 20 * _SETTLING_S
"""Simulated time of an object that has no stable pose, s."""
_MAX_DROPS = (
    (0.03, 1.5e-6),
    (0.06, 5e-6),
)
"""Tilts in rad; a pose is unstable if one lowers its centre of mass by more than this many m."""
_MAX_ROUNDS = 4
"""Most rounds of settling of a pose."""
_MAX_TILT = np.radians(30)
"""Angle in rad between the object's z axis and upright below which it counts as upright."""
_MAX_ROLLS_LOG2 = 12
"""Logarithm of the most facets over which an object rolls."""


class Settled(NamedTuple):
    """Result of settling an object."""

    pose: np.ndarray
    """(7,) position and quaternion in the world frame."""
    speed: float
    """Upper bound of the mean speed of its fastest point over the last 25 ms, m/s: linear plus
    angular speed times the object's radius. It is a mean because an appearing or vanishing contact
    makes the velocity of a resting object jump for one step."""
    moved: float
    """Distance of the centre of mass from its start, m."""


class TableScene:
    """An object above a table whose top is the plane z = 0, with the contact settings of the task
    (MuJoCo C).
    """

    def __init__(self, obj: GraspObject):
        """Compiles the scene."""
        spec = mujoco.MjSpec()
        spec.option.timestep = CONTACT.timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.worldbody.add_geom(
            name="table",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[1, 1, 0.1],
            friction=CONTACT.friction,
            condim=CONTACT.condim,
            solref=CONTACT.solref,
            solimp=CONTACT.solimp,
        )
        add_object(spec, obj)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.radius = float(np.linalg.norm(obj.visual_vertices, axis=-1).max())

    def settle(self, pose: np.ndarray, seconds: float, *, overdamped: bool = False) -> Settled:
        """Simulates the object from rest.

        Args:
          pose: (7,) initial pose.
          seconds: simulated time.
          overdamped: damps rotation so strongly that rocking stops quickly; False gives the task's
            physics.
        """
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = pose
        damping = self.model.dof_damping.copy()
        if overdamped:
            # A large part of the critical damping of a pendulum with the object's weight, size and
            # inertia.
            inertia = self.model.body_inertia[1].max()
            self.model.dof_damping[3:] += 0.25 * np.sqrt(
                self.model.body_mass[1] * 9.81 * self.radius * inertia
            )
        steps = max(1, round(seconds / CONTACT.timestep))
        window = min(steps, round(_SPEED_WINDOW_S / CONTACT.timestep))
        if steps > window:
            mujoco.mj_step(self.model, self.data, nstep=steps - window)
        before = self.data.qpos.copy()
        mujoco.mj_step(self.model, self.data, nstep=window)
        self.model.dof_damping[:] = damping
        after = self.data.qpos.copy()
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, after[3:], before[3:])
        changes = np.linalg.norm([after[:3] - before[:3], turn], axis=-1)
        linear, angular = changes / (window * CONTACT.timestep)
        moved = np.linalg.norm(after[:3] - pose[:3])
        return Settled(after, float(linear + self.radius * angular), float(moved))


def settle(obj: GraspObject, pose: np.ndarray, seconds: float) -> Settled:
    """Simulates an object on the table for some seconds, from rest in a pose (7,)."""
    return TableScene(obj).settle(pose, seconds)


def rest_poses(
    obj: GraspObject, on_candidate: Callable[[int, int], None] = lambda done, total: None
) -> np.ndarray:
    """Poses (R, 7), 1 <= R <= 8, in which the object rests on the table, most likely first.

    Physics settles the quasi-static poses for 0.25 s, or a few times as long if needed. Poses are
    dropped if they do not come to rest, if a small tilt would lower them, or if they end in an
    earlier pose. If none remains, the most likely one is simulated until the object rests.

    Args:
      obj: the object.
      on_candidate: called with the number of poses that are settled, and that of all.
    """
    candidates, _ = quasi_static_poses(obj.pieces)
    scene = TableScene(obj)
    stable: list[np.ndarray] = []
    downs: list[np.ndarray] = []
    for number, candidate in enumerate(candidates):
        on_candidate(number, len(candidates))
        pose = candidate
        for _ in range(_MAX_ROUNDS):
            settled = scene.settle(pose, _SETTLING_S, overdamped=True)
            pose = settled.pose
            down = -shapes.matrix(pose[3:])[2]
            if any(down @ other > _SAME_DIRECTION_COSINE for other in downs):
                break
            if settled.speed >= _MAX_SPEED_AT_REST or not _stable(obj.pieces, down):
                continue
            if scene.settle(pose, _FREE_S).speed < _MAX_SPEED_AT_REST:
                stable.append(pose)
                downs.append(down)
                break
    if not stable:
        tumbled = scene.settle(candidates[0], _TUMBLING_S)
        stable.append(scene.settle(tumbled.pose, _TUMBLING_S, overdamped=True).pose)
    poses = np.array(stable)
    poses[:, :2] = 0.0
    return poses


def upright_rest(obj: GraspObject) -> int | None:
    """Index of the resting pose with the object's z axis closest to upright; None if it is 30
    degrees off in all.
    """
    tilts = rest_tilts(obj)
    best = int(np.argmin(tilts))
    return best if tilts[best] < _MAX_TILT else None


def rest_tilts(obj: GraspObject) -> np.ndarray:
    """Angles (R,) in rad between the object's z axis and upright in each of its resting poses."""
    up = [shapes.matrix(np.asarray(pose[3:], float))[2, 2] for pose in obj.rest_poses]
    return np.arccos(np.clip(np.array(up, float), -1.0, 1.0))


def quasi_static_poses(pieces: tuple[Piece, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Poses in which the object can rest, from its convex hull, most likely first.

    An object whose centre of mass lies beyond an edge of its supporting facet rolls over that edge
    onto the next facet, until the facet is below the centre of mass. A pose's likelihood is the
    solid angle, seen from the centre of mass, of all facets from which the object ends there
    (quasi-static pose statistics; Goldberg et al. 1999, "Part pose statistics: estimators and
    experiments"). Round pieces are faceted for this; the resulting poses are then moved to the
    nearest minimum of the centre of mass's height.

    Args:
      pieces: convex pieces in the object frame, whose origin is the centre of mass.

    Returns:
      Poses (R, 7), 1 <= R <= 8, on the table's top z = 0 with x = y = 0 and arbitrary heading, and
      their likelihoods (R,). Unlikely poses are dropped.
    """
    hull = shapes.hull_of(np.concatenate([shapes.tessellate(piece)[0] for piece in pieces]))
    normals = hull.equations[:, :3]
    final_facet = _final_facets(hull)
    solid_angles = _solid_angles(hull.points[hull.simplices])
    weights = np.bincount(final_facet, solid_angles, len(normals)) / (4 * np.pi)
    sinks = weights > 0
    downs, weights = _merge(normals[sinks], weights[sinks])
    if any(piece.kind in ("cylinder", "capsule", "ellipsoid") for piece in pieces):
        downs, weights = _merge(_lowest_nearby(pieces, downs), weights)
    heights = _height(pieces, downs)
    chosen = _choose(heights, weights)
    poses = np.array([[0.0, 0.0, heights[i], *_upright(downs[i])] for i in chosen])
    return poses, weights[chosen]


def _final_facets(hull: ConvexHull) -> np.ndarray:
    """Index (F,) of the facet onto which an object rolls from each facet of its hull.

    Args:
      hull: the object's convex hull; the origin is the centre of mass.
    """
    normals = hull.equations[:, :3]
    offsets = hull.equations[:, 3]
    corners = hull.points[hull.simplices]
    # Distance of the projected centre of mass beyond the edge opposite to each corner.
    foot = -offsets[:, None] * normals
    start = np.roll(corners, -1, 1)
    along = np.roll(corners, -2, 1) - start
    outward = np.cross(along, normals[:, None])
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True) + 1e-12
    outward *= np.sign(((start - corners) * outward).sum(-1, keepdims=True))
    beyond = ((foot[:, None] - start) * outward).sum(-1)
    rows = np.arange(len(normals))
    worst = beyond.argmax(-1)
    neighbor = hull.neighbors[rows, worst]
    rolls = (beyond[rows, worst] > 1e-9) & (offsets[neighbor] > offsets - 1e-9)
    facet = np.where(rolls, neighbor, rows)
    for _ in range(_MAX_ROLLS_LOG2):
        facet = facet[facet]
    return facet


def _height(pieces: tuple[Piece, ...], downs: np.ndarray) -> np.ndarray:
    """Heights (D,) of the centre of mass above the table, with directions (D, 3) of the object
    downwards.
    """
    return np.max([shapes.support(piece, downs) for piece in pieces], axis=0)


def _lowest_nearby(pieces: tuple[Piece, ...], downs: np.ndarray) -> np.ndarray:
    """Directions (D, 3) near the given ones with a lower centre of mass, by pattern search on the
    sphere.
    """
    best = downs
    height = _height(pieces, downs)
    columns = np.arange(len(best))
    step = 0.1
    for i in range(12):
        directions = _cone(best, step, count=8, phase=i)
        heights = _height(pieces, directions.reshape(-1, 3)).reshape(len(directions), -1)
        pick = heights.argmin(0)
        lower = heights[pick, columns] < height
        best = np.where(lower[:, None], directions[pick, columns], best)
        height = np.where(lower, heights[pick, columns], height)
        step *= 0.65
    return best


def _stable(pieces: tuple[Piece, ...], down: np.ndarray) -> bool:
    """True if no small tilt lowers the centre of mass of an object with a direction (3,)
    downwards.
    """
    height = _height(pieces, down[None])[0]
    for tilt, max_drop in _MAX_DROPS:
        tilted = _cone(down[None], tilt, 64)[:, 0]
        if _height(pieces, tilted).min() <= height - max_drop:
            return False
    return True


def _cone(axes: np.ndarray, slope: float, count: int, phase: float = 0.0) -> np.ndarray:
    """Unit directions (count, D, 3) around each axis (D, 3), at the arc tangent of `slope` from
    it.
    """
    side = np.cross(axes, np.eye(3)[np.abs(axes).argmin(-1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    turn = (2 * np.pi / count * np.arange(count) + phase)[:, None, None]
    directions = axes + slope * (np.cos(turn) * side + np.sin(turn) * np.cross(axes, side))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def _solid_angles(corners: np.ndarray) -> np.ndarray:
    """Solid angles (F,) of triangles (F, 3, 3) seen from the origin (Van Oosterom and Strackee
    1983).
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    la, lb, lc = np.linalg.norm(corners, axis=-1).T
    triple = np.abs((a * np.cross(b, c)).sum(-1))
    ab = (a * b).sum(-1)
    bc = (b * c).sum(-1)
    ca = (c * a).sum(-1)
    return 2 * np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)


def _merge(downs: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merges close directions; returns directions and summed weights, most likely first."""
    order = np.argsort(-weights, kind="stable")
    downs, weights = downs[order], weights[order].copy()
    is_close = downs @ downs.T > _SAME_DIRECTION_COSINE
    distinct: list[int] = []
    for i in range(len(downs)):
        near = [k for k in distinct if is_close[i, k]]
        if near:
            weights[near[0]] += weights[i]
        else:
            distinct.append(i)
    distinct.sort(key=lambda i: -weights[i])
    return downs[distinct], weights[distinct]


def _choose(heights: np.ndarray, weights: np.ndarray) -> list[int]:
    """Indices of at most eight likely poses, with few rotations of one another."""
    chosen: list[int] = []
    for i, (height, weight) in enumerate(zip(heights, weights, strict=True)):
        rotations = sum(abs(heights[k] - height) < _SAME_HEIGHT * height for k in chosen)
        has_room = len(chosen) < MAX_POSES and rotations < _MAX_ROTATIONS
        if not chosen or (has_room and weight > _MIN_LIKELIHOOD):
            chosen.append(i)
    return chosen


def _upright(down: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of the smallest rotation that turns a direction (3,) of the object
    downwards.
    """
    if down[2] > 1 - 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1.0 - down[2], -down[1], down[0], 0.0])
    return q / np.linalg.norm(q)
