"""Grasps for DexGraspBench: pregrasp, grasp and squeeze of motions, with the objects in the benchmark's layout.

The benchmark's files are pickles, which this project neither writes nor reads. It writes NPZ files with the same names
and shapes, which `examples/dexgraspbench.py` converts in the benchmark's environment.
"""

import io
import itertools
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.physics.scene import compile_scene
from congrasp.common.errors import CongraspError
from congrasp.common.hands import HANDS, get_hand, own_hands
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name
from congrasp.common.io.npz import read_npz
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.hands.kinematics import posed
from congrasp.services.export.benchmark_hands import Match, benchmarked, match_hand
from congrasp.services.export.benchmark_objects import convex_object, write_object
from congrasp.services.export.frames import TOLERANCE_MM
from congrasp.services.export.motion_file import GraspMotion
from congrasp.services.export.motion_formats import pick_motion
from congrasp.services.record.goals import grasp_span

CLEARANCE = 0.006
"""Metres between hand and object in the pregrasp."""
STATES = ("pregrasp", "grasp", "squeeze")
GRASPS, OBJECTS = "graspdata", "object"
"""Folders of the output."""
_MOTION = "grasp.npz"  # of `congrasp grasp`, in an object's folder
_STEADY = 10  # frames of the mean torque of the squeeze
_LEVER = 0.05  # m; points this far from a joint show its rotation


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
    """Distance of hand and object in the pregrasp, m; less than `CLEARANCE` if the motion begins nearer."""


def export_grasps(
    paths: Sequence[pathlib.Path], folder: pathlib.Path, progress: Callable[[int], None] = lambda done: None
) -> tuple[list[Grasp], float, list[str]]:
    """Writes the grasps of motions into a new folder, which is created when all are written.

    Args:
      paths: NPZ files, recordings, and folders of `congrasp grasp`, with all results below them.
      folder: output folder, with `GRASPS` and `OBJECTS`.
      progress: called with the number of finished motions.

    Returns:
      The grasps, the largest error in mm (`write_grasp`), and reasons for skipped motions.

    Raises:
      CongraspError: nothing can be exported, the motions are of several hands, or the folder cannot be written.
    """
    if folder.exists():
        raise CongraspError(f"{folder} exists already.", "Remove it or pass another with --out.")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as workplace:
            draft = pathlib.Path(workplace) / folder.name
            found = _write_grasps(paths, draft, progress)
            draft.rename(folder)
    except OSError as error:
        raise CongraspError(f"{folder} cannot be written: {error.strerror}.", "Pass another with --out.") from None
    return found


def _write_grasps(
    paths: Sequence[pathlib.Path], folder: pathlib.Path, progress: Callable[[int], None]
) -> tuple[list[Grasp], float, list[str]]:
    """See `export_grasps`."""
    grasps: list[Grasp] = []
    left_out: list[str] = []
    names: set[str] = set()
    worst = 0.0
    for done, file in enumerate(_files_at(paths), 1):
        try:
            grasp = _grasp_at(file, names)
        except CongraspError as error:
            left_out.append(f"{file}: {error}")
        else:
            if grasps and grasp.hand.name != grasps[0].hand.name:
                raise CongraspError(f"{file} is of another hand, {grasp.hand.name}.", "Export each hand separately.")
            if (off := write_grasp(grasp, folder)) <= TOLERANCE_MM:
                grasps.append(grasp)
                worst = max(worst, off)
            else:
                left_out.append(f"{file}: off by {off:.3g} mm in the benchmark, above the limit of {TOLERANCE_MM} mm")
        progress(done)
    if not grasps:
        raise CongraspError(" ".join(["None of the motions can be exported.", *left_out[:1]]))
    return grasps, worst, left_out


def _files_at(paths: Sequence[pathlib.Path]) -> Iterator[pathlib.Path]:
    """Yields files unchanged, and all results below folders of `congrasp grasp`."""
    for path in paths:
        below = sorted(path.rglob(_MOTION)) if path.is_dir() else []
        yield from below or [path]


def _grasp_at(file: pathlib.Path, names: set[str]) -> Grasp:
    """Returns the grasp of a motion's file, under a name that is added to `names`.

    Raises:
      CongraspError: it is not a motion, its object is not held or has no volume, or the benchmark does not have its
        hand.
    """
    motion = pick_motion(file)
    if not motion.metrics.get("held", motion.success):
        raise CongraspError("The object is not held.")
    name = file.resolve().parent.name if file.name == _MOTION else file_name(motion.object, "the object of a motion")
    free = next(x for i in itertools.count(1) if (x := name if i == 1 else f"{name}-{i}") not in names)
    grasp = benchmark_grasp(free, motion)
    names.add(free)
    return grasp


def benchmark_grasp(name: str, motion: GraspMotion) -> Grasp:
    """The grasp at the end of the approach: before the table is removed, or the object lifted.

    Raises:
      CongraspError: the benchmark does not have the hand.
    """
    match, hand = match_hand(motion), _hand_of(motion)
    obj = convex_object(motion)
    last = max(grasp_span(motion.about, motion.control_dt, motion.table)[1] - 1, 0)
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


def squeezed(hand: Hand, motion: GraspMotion, t: int, kp: float) -> np.ndarray:
    """(F,) rad, targets with which servos of `kp` (N.m/rad) apply the policy's torques in frame `t`.

    m_squeeze = m + tau / kp for each motor's position m, with tau = clip(kp' (m_target - m), limit) of the hand's own
    servos, mean over ten frames up to this one. A motor of several joints turns them by their coefficients.
    """
    own = np.array([(motor.kp, motor.torque_limit) for motor in hand.motors])
    frames = slice(max(t + 1 - _STEADY, 0), t + 1)
    ahead = motor_positions(hand, motion.joint_target[frames] - motion.joint_position[frames])
    further = np.clip(own[:, 0] * ahead, -own[:, 1], own[:, 1]).mean(0) / kp
    q = motion.joint_position[t].astype(float)
    for motor, way in zip(hand.motors, further, strict=True):
        coefficients = np.array([*motor.joints.values()])
        joints = [int(np.flatnonzero(motion.joint_names == joint)[0]) for joint in motor.joints]
        q[joints] += coefficients * way / (coefficients @ coefficients)
    return q


def arrays_of(grasp: Grasp) -> dict[str, np.ndarray]:
    """Arrays of a grasp for the benchmark, by its names.

    Returns:
      `pregrasp_qpos`, `grasp_qpos`, `squeeze_qpos` (7 + F,): the root's place (m) and quaternion (w, x, y, z) in the
      world, and the joints (rad) in the order of `joint_names`; `obj_pose` (7,), likewise, of the frame of the object's
      file; `obj_scale` (), m per unit of that file; `obj_path`, the object's folder beside that of the grasps.
    """
    place = grasp.object_position - grasp.object_rotation.apply(grasp.origin)
    found = {f"{name}_qpos": grasp.match.qpos(*grasp.states[name]) for name in STATES}
    return found | {
        "obj_pose": np.concatenate([place, grasp.object_rotation.as_quat(scalar_first=True)]),
        "obj_scale": np.array(grasp.scale),
        "obj_path": np.array(f"{OBJECTS}/{grasp.name}"),
        "joint_names": np.array(grasp.match.hand.joints),
        "hand": np.array(grasp.match.name),
    }


def write_grasp(grasp: Grasp, folder: pathlib.Path) -> float:
    """Writes a grasp, reads it back, and writes its object; removes it if its error is above `TOLERANCE_MM`.

    Returns:
      The largest error in mm, see `error_mm`.

    Raises:
      CongraspError: the folder cannot be written.
    """
    path = folder / GRASPS / grasp.name / "congrasp" / "0.npz"
    buffer = io.BytesIO()
    arrays: dict[str, Any] = arrays_of(grasp)
    np.savez(buffer, **arrays)
    write_atomically(path, buffer.getvalue())
    error = error_mm(grasp, read_npz(path, "Export it again."))
    if error <= TOLERANCE_MM:
        write_object(folder / OBJECTS / grasp.name, grasp.obj, grasp.origin, grasp.scale)
    else:
        shutil.rmtree(folder / GRASPS / grasp.name)
    return error


def error_mm(grasp: Grasp, arrays: dict[str, np.ndarray]) -> float:
    """Largest distance in mm of joints, and of points 5 cm from them, between a file and the hand's kinematics."""
    levers = np.concatenate([np.zeros((1, 3)), _LEVER * np.eye(3)])
    worst = 0.0
    for name in ("pregrasp", "grasp"):
        state, order = grasp.states[name], grasp.match.order
        data = posed(grasp.hand, state.q)
        joints = [data.joint(joint.name) for joint in grasp.hand.joints]
        bodies = [data.body(grasp.hand.links[link].name) for link in grasp.hand.joint_links]
        anchors, turns = grasp.match.joint_frames(arrays[f"{name}_qpos"])
        for number, j in enumerate(order):
            last = j == max(np.flatnonzero(grasp.hand.joint_links == grasp.hand.joint_links[j]))
            own = Rotation.from_matrix(bodies[j].xmat.reshape(3, 3))
            here = state.rotation.apply(joints[j].xanchor + own.apply(levers)) + state.position
            there = anchors[number] + turns[number].apply(levers)
            distance = np.linalg.norm(here - there, axis=-1)
            worst = max(worst, float(distance.max() if last else distance[0]))
    return 1e3 * worst


def _hand_of(motion: GraspMotion) -> Hand:
    """The hand by its name in a motion."""
    if motion.hand not in {*HANDS, *own_hands()}:
        raise CongraspError(f"There is no hand '{motion.hand}' here.", "Import it with 'congrasp hands import'.")
    return get_hand(motion.hand)


def _rotation(quaternion: np.ndarray) -> Rotation:
    """Rotation of a quaternion (4,) w x y z."""
    return Rotation.from_quat(quaternion.astype(float), scalar_first=True)


def _state(motion: GraspMotion, t: int) -> State:
    """The hand in a frame."""
    position, q = motion.wrist_position[t].astype(float), motion.joint_position[t].astype(float)
    return State(position, _rotation(motion.wrist_quaternion[t]), q)


def _carried(motion: GraspMotion, t: int, last: int) -> State:
    """The hand of frame `t` relative to the object of frame `last`."""
    state = _state(motion, t)
    turn = _rotation(motion.object_quaternion[last]) * _rotation(motion.object_quaternion[t]).inv()
    place = motion.object_position[last] + turn.apply(state.position - motion.object_position[t])
    return State(place, turn * state.rotation, state.q)


def _last_clear(hand: Hand, obj: GraspObject, motion: GraspMotion, last: int) -> tuple[int, float]:
    """The last frame up to `last` in which hand and object are `CLEARANCE` apart, else that of the largest distance.

    Returns:
      The frame, and the distance in m between the hand's shapes and the object's pieces there.
    """
    model = compile_scene(hand, TaskConfig(), obj)
    data = mujoco.MjData(model)
    fingers = [model.joint(joint.name).qposadr[0] for joint in hand.joints]
    body = model.body("object").id
    free = model.jnt_qposadr[model.body_jntadr[body]]
    mine = np.flatnonzero(model.geom_bodyid == body)
    theirs = [g for g in range(model.ngeom) if model.geom_bodyid[g] != body and model.geom_contype[g]]
    base = model.body("hand_base").id
    best, farthest = 0, -np.inf
    for t in range(last, -1, -1):
        model.body_pos[base], model.body_quat[base] = motion.wrist_position[t], motion.wrist_quaternion[t]
        data.qpos[fingers] = motion.joint_position[t]
        data.qpos[free : free + 7] = *motion.object_position[t], *motion.object_quaternion[t]
        mujoco.mj_kinematics(model, data)
        gap = min(mujoco.mj_geomDistance(model, data, a, b, 2 * CLEARANCE, None) for a in theirs for b in mine)
        if gap > farthest:
            best, farthest = t, gap
        if gap >= CLEARANCE:
            break
    return best, float(farthest)
