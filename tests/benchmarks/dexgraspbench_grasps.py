"""Pregrasp, grasp and squeeze of motions for DexGraspBench, and their objects as convex pieces."""

import itertools
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from congrasp.actors.physics.scene import compile_scene
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import file_name
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import MAX_MESH_PIECES, GraspObject, Piece
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.objects.decompose import decompose
from congrasp.services.assets.objects.hulls import simplify
from congrasp.services.export.motions import pick_motion
from tests.benchmarks.dexgraspbench_hands import Match, benchmarked, match_hand

CLEARANCE = 0.006
"""Metres between hand and object in the pregrasp."""
STATES = ("pregrasp", "grasp", "squeeze")
_MOTION = "grasp.npz"  # of `congrasp grasp`, in an object's folder
_STEADY = 10  # frames of the mean torque of the squeeze
_DENSITY = 500.0  # kg/m^3


class State(NamedTuple):
    """A hand relative to the object at the grasp."""

    position: np.ndarray
    """(3,) position of the wrist in the world frame, m."""
    rotation: Rotation
    """Rotation from the wrist frame to the world frame."""
    q: np.ndarray
    """(F,) rad, finger joints in this project's order."""


class Grasp(NamedTuple):
    """Data of a motion for the benchmark."""

    name: str
    hand: Hand
    match: Match
    obj: GraspObject
    """Convex pieces of the motion's mesh, in its object frame."""
    object_position: np.ndarray
    """(3,) m, world."""
    object_rotation: Rotation
    """Object frame to world."""
    origin: np.ndarray
    """(3,) m: object frame = scale * file - origin."""
    scale: float
    """m per unit of the object's file."""
    states: dict[str, State]
    """States of the hand, by `STATES`."""
    clearance: float
    """Distance of hand and object in the pregrasp, m; less than `CLEARANCE` if the motion begins
    nearer.
    """


def read_grasps(
    paths: Sequence[pathlib.Path], progress: Callable[[int], None] = lambda done: None
) -> tuple[list[Grasp], list[str]]:
    """Reads the grasps of motions of one hand.

    Args:
      paths: NPZ files, recordings, and folders of `congrasp grasp`, with all results below them.
      progress: called with the number of finished motions.

    Returns:
      The grasps under different names, and reasons for skipped motions.

    Raises:
      CongraspError: there is none, or the motions are of several hands.
    """
    grasps: list[Grasp] = []
    left_out: list[str] = []
    for done, file in enumerate(_files_at(paths), 1):
        try:
            grasps.append(_grasp_at(file, {grasp.name for grasp in grasps}))
        except CongraspError as error:
            left_out.append(f"{file}: {error}")
        progress(done)
    if not grasps:
        raise CongraspError(" ".join(["None of the motions can be exported.", *left_out[:1]]))
    if len(hands := sorted({grasp.hand.name for grasp in grasps})) > 1:
        raise CongraspError(
            f"The motions are of several hands: {', '.join(hands)}.", "Export each hand separately."
        )
    return grasps, left_out


def _files_at(paths: Sequence[pathlib.Path]) -> Iterator[pathlib.Path]:
    """Yields files unchanged, and all results below folders of `congrasp grasp`."""
    for path in paths:
        below = sorted(path.rglob(_MOTION)) if path.is_dir() else []
        yield from below or [path]


def _grasp_at(file: pathlib.Path, names: set[str]) -> Grasp:
    """Returns the grasp of a motion's file, under a name that is not among `names`.

    Raises:
      CongraspError: it is not a motion, its object is not held or has no volume, or the benchmark
        does not have its hand.
    """
    motion = pick_motion(file)
    if not motion.metrics.get("held", motion.success):
        raise CongraspError("The object is not held.")
    name = (
        file.resolve().parent.name
        if file.name == _MOTION
        else file_name(motion.object, "the object of a motion")
    )
    free = next(
        x for i in itertools.count(1) if (x := name if i == 1 else f"{name}-{i}") not in names
    )
    return benchmark_grasp(free, motion)


def benchmark_grasp(name: str, motion: Episode) -> Grasp:
    """The grasp at the end of the approach: before the table is removed, or the object lifted.

    Raises:
      CongraspError: the benchmark does not have the hand.
    """
    match = match_hand(motion)
    hand = get_hand(motion.hand)
    obj = convex_object(motion)
    last = max(motion.grasp_span[1] - 1, 0)
    clear, clearance = _last_clear(benchmarked(hand, match), obj, motion, last)
    grasp = _state(motion, last)
    squeeze = grasp._replace(q=squeezed(hand, motion, last, match.hand.kp))
    return Grasp(
        name=name,
        hand=hand,
        match=match,
        obj=obj,
        object_position=motion.object_position[last].astype(float),
        object_rotation=_rotation(motion.object_quaternion[last]),
        origin=motion.object_file_origin.astype(float),
        scale=float(motion.object_file_scale),
        states=dict(zip(STATES, (_carried(motion, clear, last), grasp, squeeze), strict=True)),
        clearance=clearance,
    )


def squeezed(hand: Hand, motion: Episode, t: int, kp: float) -> np.ndarray:
    """(F,) rad, targets with which servos of `kp` (N.m/rad) apply the policy's torques in frame
    `t`.

    m_squeeze = m + tau / kp for each motor's position m, with tau = clip(kp' (m_target - m), limit)
    of the hand's own servos, mean over ten frames up to this one. A motor of several joints turns
    them by their coefficients.
    """
    motors = np.array([(motor.kp, motor.torque_limit) for motor in hand.motors])
    frames = slice(max(t + 1 - _STEADY, 0), t + 1)
    ahead = motor_positions(hand, motion.joint_target[frames] - motion.joint_position[frames])
    further = np.clip(motors[:, 0] * ahead, -motors[:, 1], motors[:, 1]).mean(0) / kp
    q = motion.joint_position[t].astype(float)
    for motor, way in zip(hand.motors, further, strict=True):
        coefficients = np.array([*motor.joints.values()])
        joints = [int(np.flatnonzero(motion.joint_names == joint)[0]) for joint in motor.joints]
        q[joints] += coefficients * way / (coefficients @ coefficients)
    return q


def convex_object(motion: Episode) -> GraspObject:
    """Returns the object in the motion's object frame, made of convex pieces, since a motion only
    has its mesh.

    Raises:
      CongraspError: the mesh has no volume.
    """
    shape = motion.object_vertices.astype(float), motion.object_faces
    # Bodies that only touch have no vertex in common, unless equal ones are merged.
    bodies = trimesh.Trimesh(*shape, process=False).split(only_watertight=False, repair=False)
    if len(bodies) > MAX_MESH_PIECES:
        bodies = [trimesh.Trimesh(*shape)]
    most = max(1, MAX_MESH_PIECES // len(bodies))
    pieces = list(itertools.chain.from_iterable(_pieces(body, most) for body in bodies))
    if not pieces:
        raise CongraspError(
            f"The mesh of '{motion.object}' has no volume.", "Generate the motion again."
        )
    return plain_object(motion.object, tuple(pieces), _DENSITY)


def _pieces(body: trimesh.Trimesh, most: int) -> list[Piece]:
    """Convex pieces of one body; empty for a flat one."""
    volume = float(body.volume) if body.is_volume else None
    vertices = np.asarray(body.vertices)
    faces = np.asarray(body.faces)
    try:
        pieces = decompose(vertices, faces, volume=volume, max_pieces=most)
        hulls = [simplify(piece) for piece in pieces.pieces]
    except QhullError:
        return []
    return [Piece("mesh", (0.0, 0.0, 0.0), vertices=hull.astype(float)) for hull in hulls]


def _rotation(quaternion: np.ndarray) -> Rotation:
    """Rotation of a quaternion (4,) w x y z."""
    return Rotation.from_quat(quaternion.astype(float), scalar_first=True)


def _state(motion: Episode, t: int) -> State:
    """The hand in a frame."""
    position = motion.wrist_position[t].astype(float)
    q = motion.joint_position[t].astype(float)
    return State(position, _rotation(motion.wrist_quaternion[t]), q)


def _carried(motion: Episode, t: int, last: int) -> State:
    """The hand of frame `t` relative to the object of frame `last`."""
    state = _state(motion, t)
    turn = _rotation(motion.object_quaternion[last]) * _rotation(motion.object_quaternion[t]).inv()
    place = motion.object_position[last] + turn.apply(state.position - motion.object_position[t])
    return State(place, turn * state.rotation, state.q)


def _last_clear(hand: Hand, obj: GraspObject, motion: Episode, last: int) -> tuple[int, float]:
    """The last frame up to `last` in which hand and object are `CLEARANCE` apart, else that of the
    largest distance.

    Returns:
      The frame, and the distance in m between the hand's shapes and the object's pieces there.
    """
    model = compile_scene(hand, TaskConfig(), obj)
    data = mujoco.MjData(model)
    fingers = [model.joint(joint.name).qposadr[0] for joint in hand.joints]
    body = model.body("object").id
    free = model.jnt_qposadr[model.body_jntadr[body]]
    geoms = np.flatnonzero(model.geom_bodyid == body)
    theirs = [
        g for g in range(model.ngeom) if model.geom_bodyid[g] != body and model.geom_contype[g]
    ]
    base = model.body("hand_base").id
    best = 0
    farthest = -np.inf
    for t in range(last, -1, -1):
        model.body_pos[base] = motion.wrist_position[t]
        model.body_quat[base] = motion.wrist_quaternion[t]
        data.qpos[fingers] = motion.joint_position[t]
        data.qpos[free : free + 7] = *motion.object_position[t], *motion.object_quaternion[t]
        mujoco.mj_kinematics(model, data)
        gap = min(
            mujoco.mj_geomDistance(model, data, a, b, 2 * CLEARANCE, None)
            for a, b in itertools.product(theirs, geoms)
        )
        if gap > farthest:
            best = t
            farthest = gap
        if gap >= CLEARANCE:
            break
    return best, float(farthest)
