"""A grasp motion as one self-describing NPZ file, the source of exports in the formats of this
folder's modules.

Metres, radians, seconds, newtons; quaternions are (w, x, y, z) and turn a body's frame into the
world. The world's z axis points up and the table's top is at z = 0. T frames, F finger joints, L
links, C capsules, K waypoints.
"""

import dataclasses
import importlib
import io
import json
import math
import os
import pathlib
import tempfile
from collections.abc import Sequence
from typing import Annotated, Any, get_type_hints

import numpy as np

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.hands import known_hand
from congrasp.common.hands.spec import Hand, capsule_ends
from congrasp.common.io.arrays import check_arrays, read_npz
from congrasp.common.io.files import check_free, write_atomically
from congrasp.common.io.inputs import file_name
from congrasp.common.io.spelling import check_spelling
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.wire.codec import Message
from congrasp.services.record.episode import (
    ARM_ARRAYS,
    MovedArm,
    active_constraints,
    arm_of,
    arm_of_episode,
)

FORMAT = 2
MAX_BYTES = 256 << 20
"""Limit of the total size of a motion's arrays, bytes."""
TRAJECTORY_START = 10**9
"""Time of the first point of a trajectory, ns."""
_LARGEST = 1e6
_INDICES = ("object_colour_values", "object_faces", "joint_link", "link_parent", "capsule_link")
_META = "meta"
_OLDER = {"pose_joints": "pose_q"}
"""Names of goal arrays in files of format 1."""
_GOALS = {
    f"{constraint.name}_{name}": (
        f"({', '.join(map(str, array.shape))}{',' * (len(array.shape) == 1)}) {array.meaning}"
    )
    for constraint in CONSTRAINTS
    for name, array in constraint.arrays.items()
}
"""Meaning of the goal arrays; like the others, each begins with the shape."""
_POINTS, _VALUES = "object_colour_points", "object_colour_values"
_COLOURS = {
    _POINTS: "(P, 3) m, object frame, points of the surface whose colours are known",
    _VALUES: "(P, 3) sRGB from 0 to 255 there",
}
_OWN = {**_COLOURS, **ARM_ARRAYS}
"""Arrays of motions whose object has colours, or with an arm."""
FORMATS = {"glb": ".glb", "usd": ".usda", "bvh": ".bvh", "ros2": "", "lerobot": ""}
"""Name and suffix of each format; `services.export.<name>` writes it. Those without a suffix are
folders.
"""
DATASETS = ("lerobot",)
"""Formats that hold several motions, and videos."""
_QUATERNIONS = ("wrist_quaternion", "link_quaternion", "object_quaternion")
# Largest difference of a quaternion's length from one, and in a recording
_UNIT, _ROUNDED = (
    1e-3,
    1e-2,
)


@dataclasses.dataclass(frozen=True, eq=False)
class GraspMotion:
    """A hand that approaches an object, closes, and holds it after table removal.

    Other values are stored as JSON under the name `meta`, with the meaning of every array.
    """

    hand: str
    """Name of the hand."""
    object: str
    """Name of the object."""
    success: bool
    """True if the object was held a quarter of a second after table removal; `metrics["held"]`: to
    the end.
    """
    control_dt: float
    """Seconds between two frames."""
    constraints: tuple[str, ...]
    """Names of the active constraints, weakest first."""
    metrics: dict[str, float]
    """Errors, forces and reward of the episode, by the names in `common.task.metrics`."""
    about: dict[str, Any]
    """Origin: version of the policy, file of the object, command."""
    time: Annotated[np.ndarray, "(T,) s"]
    table: Annotated[np.ndarray, "(T,) bool, whether the table stands"]
    wrist_position: Annotated[np.ndarray, "(T, 3) m, world"]
    wrist_quaternion: Annotated[np.ndarray, "(T, 4) w x y z, wrist frame to world"]
    joint_position: Annotated[np.ndarray, "(T, F) rad, finger joints in the order of joint_names"]
    joint_target: Annotated[np.ndarray, "(T, F) rad, what the joints' position servos aimed at"]
    link_position: Annotated[
        np.ndarray, "(T, L, 3) m, world, origins of the links in the order of link_names"
    ]
    link_quaternion: Annotated[
        np.ndarray, "(T, L, 4) w x y z, link frame to world; link 0, the palm, is the wrist"
    ]
    link_force: Annotated[
        np.ndarray, "(T, L, 3) N, world, net contact force of the object on each link"
    ]
    object_position: Annotated[np.ndarray, "(T, 3) m, world, the object's centre of mass"]
    object_quaternion: Annotated[np.ndarray, "(T, 4) w x y z, object frame to world"]
    object_vertices: Annotated[
        np.ndarray, "(V, 3) m, object frame: axes of its file, origin at its centre of mass"
    ]
    object_faces: Annotated[np.ndarray, "(E, 3) indices of object_vertices"]
    object_file_origin: Annotated[
        np.ndarray, "(3,) m: object frame = object_file_scale * file - object_file_origin"
    ]
    object_file_scale: Annotated[np.ndarray, "() m per unit of the object's file"]
    joint_names: Annotated[np.ndarray, "(F,) text"]
    joint_link: Annotated[
        np.ndarray, "(F,) the link that a joint moves; joints of one link act in this order"
    ]
    joint_axis: Annotated[
        np.ndarray, "(F, 3) unit, link frame; with all joints at zero links are turned as the wrist"
    ]
    joint_anchor: Annotated[np.ndarray, "(F, 3) m, wrist frame with all joints at zero"]
    joint_limits: Annotated[np.ndarray, "(F, 2) rad, lower and upper"]
    link_names: Annotated[np.ndarray, "(L,) text"]
    link_parent: Annotated[np.ndarray, "(L,) index of the link that carries it, -1 for the palm"]
    capsule_link: Annotated[np.ndarray, "(C,) link of each capsule of the hand's shape"]
    capsule_ends: Annotated[np.ndarray, "(C, 2, 3) m, link frame"]
    capsule_radius: Annotated[np.ndarray, "(C,) m"]
    surface_points: Annotated[np.ndarray, "(N, 3) m, object frame, points of the surface"]
    surface_avoid: Annotated[
        np.ndarray, "(N,) bool, must not be touched (where affordance is among the constraints)"
    ]
    colours: Colours | None
    """Colours of the object, in its frame, if it has any."""
    goal: dict[str, np.ndarray]
    """Goal arrays of the policy's constraints, by constraint and field: `heading_direction`,
    `pose_q`.
    """
    arm: MovedArm | None = None
    """The arm that carries the hand, if there is one. Its wrist deviates from the hand's by its
    tracking error.
    """


_HINTS = get_type_hints(GraspMotion, include_extras=True)
_ARRAYS = {
    name: hint.__metadata__[0] for name, hint in _HINTS.items() if hasattr(hint, "__metadata__")
}
_FACTS = tuple(
    name for name in _HINTS if name not in _ARRAYS and name not in ("goal", "colours", "arm")
)


def at_rate(motion: GraspMotion, fps: float) -> GraspMotion:
    """Returns the motion at another frame rate: for each of its times the nearest frame, at most
    half a step off.

    Raises:
      CongraspError: the rate is above the motion's own, or not above zero.
    """
    own = 1 / motion.control_dt
    if not 0 < fps <= own + 1e-6:
        raise CongraspError(
            f"--fps is {fps:g}.", f"The motion has {own:g} frames a second: set at most as many."
        )
    time = np.arange(int((len(motion.time) - 1) * fps / own + 1e-6) + 1) / fps
    nearest = np.minimum(np.round(time * own).astype(int), len(motion.time) - 1)
    timed = [name for name, meaning in _ARRAYS.items() if meaning.startswith(("(T,", "(T)"))]
    arrays = {name: getattr(motion, name)[nearest] for name in timed}
    arrays["time"] = time.astype(motion.time.dtype)
    return dataclasses.replace(
        motion, **arrays, control_dt=1 / fps, arm=motion.arm and motion.arm.at(nearest)
    )


def robot_joints(motion: GraspMotion) -> list[str]:
    """Returns the names of the arm's joints, if there is an arm, and of the hand's, all
    different.
    """
    arm = motion.arm.joint_names.tolist() if motion.arm else []
    return [
        *arm,
        *(f"hand_{name}" if name in arm else name for name in motion.joint_names.tolist()),
    ]


def joint_trajectory(
    motion: GraspMotion, fingers: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Returns the points of a trajectory for a controller: it begins and ends at rest, one second
    after its start.

    Controllers reject a goal whose last point moves, and jump to a point at time zero.

    Args:
      motion: the motion.
      fingers: (T, F) angles of the fingers, rad.

    Returns:
      Positions and velocities (T, N) of the joints of `robot_joints`, and T times since the start,
      ns.
    """
    positions = (
        fingers if motion.arm is None else np.concatenate([motion.arm.joint_position, fingers], 1)
    )
    velocities = np.zeros(positions.shape)
    velocities[1:-1] = (positions[2:] - positions[:-2]) / (2 * motion.control_dt)
    return positions, velocities, [TRAJECTORY_START + round(1e9 * t) for t in motion.time.tolist()]


def motion_of_episode(episode: Message) -> GraspMotion:
    """Returns the motion of an episode, in memory or read from MCAP
    (`services.record.reader.read_episodes`).
    """
    arrays, meta = (
        {name: np.asarray(value) for name, value in episode.arrays.items()},
        dict(episode.meta),
    )
    hand = known_hand(meta.pop("hand"))
    dt = float(meta.pop("control_dt"))
    arm = arm_of_episode(episode)
    meta.pop("arm", None)
    of_hand: dict[str, Any] = hand_arrays(hand)
    links = _normalised(arrays["link_quaternion"])
    return GraspMotion(
        hand=hand.name,
        object=file_name(meta.pop("object"), "the object of a motion"),
        success=bool(meta.pop("success")),
        control_dt=dt,
        constraints=active_constraints(arrays),
        metrics={name: float(value) for name, value in meta.pop("metrics", {}).items()},
        about=meta,
        time=dt * np.arange(len(arrays["table"])),
        table=arrays["table"].astype(bool),
        wrist_position=arrays["link_position"][:, 0],
        wrist_quaternion=links[:, 0],
        joint_position=arrays["q"],
        joint_target=arrays["q_target"],
        link_position=arrays["link_position"],
        link_quaternion=links,
        link_force=arrays["contact_force"],
        object_position=arrays["object_position"],
        object_quaternion=_normalised(arrays["object_quaternion"]),
        object_vertices=arrays["visual_vertices"],
        object_faces=arrays["visual_faces"],
        object_file_origin=np.asarray(meta.pop("object_file_origin", (0.0, 0.0, 0.0)), np.float64),
        object_file_scale=np.asarray(meta.pop("object_file_scale", 1.0), np.float64),
        **of_hand,
        surface_points=arrays["surface_points"],
        surface_avoid=arrays["surface_avoid"].astype(bool),
        colours=Colours(arrays["colour_points"], arrays["colour_values"])
        if "colour_values" in arrays
        else None,
        goal={
            name.removeprefix("goal/"): value
            for name, value in arrays.items()
            if name.removeprefix("goal/") in _GOALS
        },
        arm=arm,
    )


def _normalised(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of length one; those whose length differs by more than `_ROUNDED` are
    unchanged.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return quaternions / np.where(np.abs(lengths - 1) <= _ROUNDED, lengths, 1)


def hand_arrays(hand: Hand) -> dict[str, np.ndarray]:
    """Joints, links and capsules of a hand, by the names of a motion's arrays."""
    index = {link.name: i for i, link in enumerate(hand.links)}
    return {
        "joint_names": np.array([joint.name for joint in hand.joints]),
        "joint_link": hand.joint_links.astype(np.int32),
        "joint_axis": np.array([joint.axis for joint in hand.joints]),
        "joint_anchor": np.array([joint.anchor for joint in hand.joints]),
        "joint_limits": np.array([(joint.lower, joint.upper) for joint in hand.joints]),
        "link_names": np.array([link.name for link in hand.links]),
        "link_parent": np.array([index.get(link.parent, -1) for link in hand.links], np.int32),
        "capsule_link": np.array(
            [i for i, link in enumerate(hand.links) for _ in link.capsules], np.int32
        ),
        "capsule_ends": np.concatenate([capsule_ends(link) for link in hand.links]),
        "capsule_radius": np.array(
            [capsule.radius for link in hand.links for capsule in link.capsules]
        ),
    }


def save_motion(path: str | os.PathLike[str], motion: GraspMotion) -> None:
    """Writes a motion as NPZ, atomically.

    Raises:
      CongraspError: the file cannot be written.
    """
    own = dict(zip(_COLOURS, motion.colours, strict=True)) if motion.colours else {}
    own |= motion.arm.arrays() if motion.arm else {}
    meta = {
        "format": FORMAT,
        **{name: getattr(motion, name) for name in _FACTS},
        **({"arm": motion.arm.name} if motion.arm else {}),
        "units": "m, rad, s, N",
        "quaternions": "(w, x, y, z)",
        "world": "z up, table's top at z = 0",
        "arrays": {
            **_ARRAYS,
            **{name: _OWN[name] for name in own},
            **{name: _GOALS[name] for name in motion.goal},
        },
    }
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {
        **{name: getattr(motion, name) for name in _ARRAYS},
        **own,
        **motion.goal,
    }
    arrays[_META] = np.array(json.dumps(meta))
    np.savez_compressed(buffer, **arrays)
    write_atomically(pathlib.Path(path), buffer.getvalue())


def load_motion(path: str | os.PathLike[str]) -> GraspMotion:
    """Reads a motion.

    Raises:
      CongraspError: there is no such file, it is another kind of file, larger than `MAX_BYTES`, or
        damaged, or a quaternion is not normalised.
    """
    remedy = "Run 'congrasp grasp' again."
    arrays = read_npz(pathlib.Path(path), remedy, kind="a grasp motion", largest=MAX_BYTES)
    try:
        meta = json.loads(str(arrays.pop(_META)))
        if meta["format"] not in (1, FORMAT):
            raise CongraspError(f"{path} has format {meta['format']!r:.20}, not {FORMAT}.", remedy)
        facts = {name: meta[name] for name in _FACTS}
        facts["constraints"] = tuple(facts["constraints"])
        _check_facts(facts)
        named = {_OLDER.get(name, name): array for name, array in arrays.items()}
        goal = {name: array for name, array in named.items() if name in _GOALS}
        own = _COLOURS if _COLOURS.keys() & arrays.keys() else {}
        _check_arrays(
            {**arrays, **goal}, {**_ARRAYS, **own, **{name: _GOALS[name] for name in goal}}
        )
        colours = Colours(arrays[_POINTS], arrays[_VALUES].astype(np.uint8)) if own else None
        arm = arm_of(str(meta["arm"]), arrays, len(arrays["time"])) if "arm" in meta else None
        motion = GraspMotion(
            **facts, **{name: arrays[name] for name in _ARRAYS}, colours=colours, goal=goal, arm=arm
        )
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise CongraspError(f"{path} is not a grasp motion ({reason[:200]}).", remedy) from None
    _check(motion, path)
    return motion


def _check_facts(facts: dict[str, Any]) -> None:
    """Raises a ValueError or CongraspError for a fact with another type than in `GraspMotion`."""
    for name in ("hand", "object"):
        file_name(facts[name], f"the {name} of a motion")
    if not (isinstance(facts["success"], bool) and isinstance(facts["about"], dict)):
        raise ValueError("success is no boolean, or about no object")
    if not all(isinstance(name, str) for name in facts["constraints"]):
        raise ValueError("constraints are no names")
    numbers = {"control_dt": facts["control_dt"], **facts["metrics"]}
    for name, number in numbers.items():
        if not isinstance(number, (int, float)) or not math.isfinite(number):
            raise ValueError(f"{name} is not a finite number")
    if not 0 < numbers["control_dt"] <= 1:
        raise ValueError("control_dt is not above 0 and at most 1 s")


def _check_arrays(arrays: dict[str, np.ndarray], meanings: dict[str, str]) -> None:
    """Raises a ValueError if an array does not match its meaning, or has invalid values."""
    sizes = check_arrays(arrays, meanings, indices=_INDICES, largest=_LARGEST)
    faces = arrays["object_faces"]
    if faces.min() < 0 or faces.max() >= sizes["V"]:
        raise ValueError("object_faces names vertices that do not exist")
    for name, below in (("link_parent", "L"), ("joint_link", "L"), ("capsule_link", "L")):
        if arrays[name].min() < -(name == "link_parent") or arrays[name].max() >= sizes[below]:
            raise ValueError(f"{name} names links that do not exist")
    for name in ("joint_names", "link_names"):
        if len(np.unique(arrays[name])) < len(arrays[name]):
            raise ValueError(f"{name} has a name twice")
    colours = arrays.get(_VALUES, np.zeros(1))
    if colours.min() < 0 or colours.max() > 255:
        raise ValueError(f"{_VALUES} are not from 0 to 255")
    if not (arrays["joint_limits"][:, 0] <= arrays["joint_limits"][:, 1]).all():
        raise ValueError("joint_limits are in the wrong order")
    if not (arrays["capsule_radius"] > 0).all() or not 0 < arrays["object_file_scale"] < _LARGEST:
        raise ValueError("capsule_radius or object_file_scale is not above zero")


def pick_motion(path: pathlib.Path, index: int = -1, *, success: bool = False) -> GraspMotion:
    """The motion of an NPZ file, or an episode recorded at `path` (see `pick_episode`).

    Raises:
      CongraspError: `path` is missing or holds no motion, or an NPZ file's index is neither -1 nor
        0.
    """
    if not path.exists():
        raise CongraspError(
            f"There is no {path}.", "Pass a motion (.npz), a recording (.mcap) or a run's folder."
        )
    if path.suffix == ".npz":
        if index not in (-1, 0):
            raise CongraspError(
                f"{path} is one motion and has no number {index}.", "Remove --index."
            )
        return load_motion(path)
    if path.is_file() and path.suffix != ".mcap":
        raise CongraspError(
            f"{path} holds no motion.", "Pass a grasp.npz, a recording (.mcap) or a run's folder."
        )
    from congrasp.services.record.reader import pick_episode  # with MCAP's packages

    return motion_of_episode(pick_episode(path, index, success=success))


def export_motions(
    motions: Sequence[GraspMotion],
    kind: str,
    path: pathlib.Path,
    *,
    camera: bool = False,
    force: bool = False,
) -> None:
    """Writes motions in a format.

    Args:
      motions: one, or several if the format supports them.
      kind: one of `FORMATS`.
      path: the file or folder to write.
      camera: also records videos, if the format has them.
      force: replaces an existing file; a folder is never replaced.

    Raises:
      CongraspError: `path` exists already, has another suffix or cannot be written, a motion has
        invalid poses, or the format cannot hold what was given.
    """
    if len(motions) > 1 and kind not in DATASETS:
        raise CongraspError(
            f"A {kind} file holds one motion, but {len(motions)} were given.", "Pass one at a time."
        )
    if camera and kind not in DATASETS:
        raise CongraspError(
            f"A {kind} file holds no video.", f"Remove --camera, or pass --to {DATASETS[0]}."
        )
    if (suffix := FORMATS[kind]) and path.suffix.lower() != suffix:
        named = path.with_suffix("") if path.suffix and suffix.startswith(path.suffix) else path
        name = path / f"grasp{suffix}" if path.is_dir() else f"{named}{suffix}"
        raise CongraspError(
            f"The name of a {kind} file ends in {suffix}, and {path} does not.", f"Use --out {name}"
        )
    if path.is_dir():
        raise CongraspError(
            f"The folder {path} exists already.", "Remove it or pass another with --out."
        )
    check_free(path, force=force)
    for motion in motions:
        _check(motion, "The motion")
    module = importlib.import_module(f"congrasp.services.export.{kind}")
    with os_errors_as(f"{path} cannot be written", "Pass another with --out."):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workplace:
            module.write(
                pathlib.Path(workplace, path.name), motions, **({"camera": True} if camera else {})
            )
            written = [
                (file, path.with_name(file.name)) for file in pathlib.Path(workplace).iterdir()
            ]
            for _, target in written:
                check_spelling(target)
                check_free(target, force=force)
            for file, target in written:
                file.replace(target)


def default_name(motion: GraspMotion, kind: str) -> pathlib.Path:
    """Default path of a motion: the object's name in the working directory."""
    return pathlib.Path(f"{motion.object}{FORMATS[kind] or f'-{kind}'}")


def _check(motion: GraspMotion, what: object) -> None:
    """Raises a CongraspError for quaternions that are not normalised, which recordings may also
    hold.
    """
    for owner in (motion, motion.arm):
        for name in _QUATERNIONS:
            values = getattr(owner, name, None)
            if (
                values is not None
                and not (np.abs(np.linalg.norm(values, axis=-1) - 1) <= _UNIT).all()
            ):
                raise CongraspError(
                    f"{what}'s {name} has quaternions that are not normalised.",
                    "Run 'congrasp grasp' again.",
                )
