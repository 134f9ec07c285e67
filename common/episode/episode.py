"""The episode: a hand that approaches an object, closes, and holds it after table removal.

Metres, radians, seconds, newtons; quaternions are (w, x, y, z) and turn a body's frame into the
world. The world's z axis points up and the table's top is at z = 0. T frames, F finger joints, L
links, C capsules, V vertices and E triangles of the object, N surface points, n pieces.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np

from congrasp.common.episode.arm import ARM_META, MovedArm, arm_of_message
from congrasp.common.episode.constraints import (
    active_constraints,
    block_activity,
    goal_arrays,
    markers,
)
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.episode.message_checks import (
    check_message,
    metrics_of_message,
    numbers_of_entry,
)
from congrasp.common.errors import CongraspError
from congrasp.common.hands import known_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints.markers import Marker
from congrasp.common.wire.codec import Message

_LATEST_PHASE_S = 1e4
_QUATERNIONS = ("wrist_quaternion", "link_quaternion", "object_quaternion")
_UNIT_TOLERANCE = 1e-3
"""Largest difference of a quaternion's length from one."""
_ROUNDED = 1e-2
"""Largest difference of a quaternion's length from one in recordings, which round numbers."""
_ORIGIN = "object_file_origin"
_SCALE = "object_file_scale"
_FIELD_ENTRIES = ("hand", "object", "control_dt", "success", "metrics", _ORIGIN, _SCALE, ARM_META)
"""Entries of a message's metadata that are not in `about`."""


class Pieces(NamedTuple):
    """The object's convex collision pieces."""

    kind: np.ndarray
    """(n,) indices of `common.objects.spec.PIECE_KINDS`."""
    size: np.ndarray
    """(n, 3) m, see `common.objects.spec.Piece`."""
    pos: np.ndarray
    """(n, 3) m, object frame."""
    quat: np.ndarray
    """(n, 4) w x y z, piece frame to object frame."""
    part: np.ndarray
    """(n,) indices of the object's parts."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """Content of recordings that motion files lack."""

    hand_reference: str
    """Name of a hand of the package, or the whole text of another (`Hand.reference`)."""
    wrist_joints: Annotated[
        np.ndarray, "(T, 6) m and rad, slides and intrinsic x-y-z hinges of the virtual wrist"
    ]
    wrist_targets: Annotated[np.ndarray, "(T, 6) m and rad, targets of their position servos"]
    action: Annotated[np.ndarray, "(T, A) actions of the policy"]
    rewards: dict[str, np.ndarray]
    """(T,) reward of each term, by its name in `common.task.reward`."""
    errors: dict[str, np.ndarray]
    """(T,) errors of the constraints in rad, m or shares, by their names in
    `common.task.metrics`.
    """
    pieces: Pieces

    def at_frames(self, frames: np.ndarray) -> "Recorded":
        """Returns the content in other frames (n,) of the episode."""
        return dataclasses.replace(
            self,
            wrist_joints=self.wrist_joints[frames],
            wrist_targets=self.wrist_targets[frames],
            action=self.action[frames],
            rewards={name: values[frames] for name, values in self.rewards.items()},
            errors={name: values[frames] for name, values in self.errors.items()},
        )

    def preceded_by(self, earlier: "Recorded") -> "Recorded":
        """Returns the content with that of an earlier episode before it."""
        return dataclasses.replace(
            self,
            wrist_joints=_joined(earlier.wrist_joints, self.wrist_joints),
            wrist_targets=_joined(earlier.wrist_targets, self.wrist_targets),
            action=_joined(earlier.action, self.action),
            rewards=_all_joined(earlier.rewards, self.rewards),
            errors=_all_joined(earlier.errors, self.errors),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """A hand that approaches an object, closes, and holds it after table removal."""

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
    """Origin: version of the policy, file of the object, command; `phases`, see the property."""
    time: Annotated[np.ndarray, "(T,) s"]
    table: Annotated[np.ndarray, "(T,) bool, True while the table is present"]
    joint_position: Annotated[np.ndarray, "(T, F) rad, finger joints in the order of joint_names"]
    joint_target: Annotated[np.ndarray, "(T, F) rad, targets of the joint position servos"]
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
    active: dict[str, bool]
    """Activity of each block of the observation, by name. Motion files have only `constraints`, and
    count as active in all of their blocks.
    """
    arm: MovedArm | None = None
    """The arm that carries the hand, if there is one. Its wrist deviates from the hand's by its
    tracking error.
    """
    recorded: Recorded | None = None
    """Further content of recordings; None in motion files."""

    @classmethod
    def from_message(cls, message: Message) -> "Episode":
        """Returns the episode of a message, from any peer or recording.

        Raises:
          CongraspError: the message is invalid; the text names the array or the entry, and the
            violated rule.
        """
        arrays = {name: np.asarray(value) for name, value in message.arrays.items()}
        meta = message.meta
        message = Message(arrays, meta)
        check_message(message)
        hand = known_hand(meta["hand"])
        active = block_activity(arrays)
        colours = None
        if "colour_values" in arrays:
            colours = Colours(arrays["colour_points"], arrays["colour_values"])
        of_hand: dict[str, Any] = hand_arrays(hand)
        return cls(
            hand=hand.name,
            object=meta["object"],
            success=meta["success"],
            control_dt=meta["control_dt"],
            constraints=active_constraints(active),
            metrics=metrics_of_message(message),
            about={name: value for name, value in meta.items() if name not in _FIELD_ENTRIES},
            time=meta["control_dt"] * np.arange(len(arrays["table"])),
            table=arrays["table"],
            joint_position=arrays["q"],
            joint_target=arrays["q_target"],
            link_position=arrays["link_position"],
            link_quaternion=arrays["link_quaternion"],
            link_force=arrays["contact_force"],
            object_position=arrays["object_position"],
            object_quaternion=arrays["object_quaternion"],
            object_vertices=arrays["visual_vertices"],
            object_faces=arrays["visual_faces"],
            object_file_origin=numbers_of_entry(meta, _ORIGIN, np.zeros(3)),
            object_file_scale=numbers_of_entry(meta, _SCALE, np.ones(())),
            **of_hand,
            surface_points=arrays["surface_points"],
            surface_avoid=arrays["surface_avoid"],
            colours=colours,
            goal=goal_arrays(arrays),
            active=active,
            arm=arm_of_message(message),
            recorded=_recorded(meta["hand"], arrays),
        )

    def to_message(self) -> Message:
        """Returns the message of a recorded episode, the inverse of `from_message`.

        Its arrays are `link_position`, `link_quaternion`, `object_position`, `object_quaternion`,
        `table`, `surface_points` and `surface_avoid` as here; `contact_force` (link_force), `q`,
        `q_target` (joint_position, joint_target), `u`, `u_target` (wrist_joints, wrist_targets),
        `action`, `reward/<term>`, `error/<name>`, `goal/<constraint>_<field>`, `active/<block>`,
        `piece_*`, `visual_vertices`, `visual_faces`, and with colours `colour_points` and
        `colour_values`; `arm/*` with an arm. Its metadata are `hand` (the reference), `object`,
        `control_dt`, `version`, `success`, `metrics`, the frame of the object's file, and `about`.

        Raises:
          CongraspError: the episode is that of a motion file.
        """
        recorded = self.require_recorded()
        pieces = recorded.pieces
        arrays = {
            "link_position": self.link_position,
            "link_quaternion": self.link_quaternion,
            "object_position": self.object_position,
            "object_quaternion": self.object_quaternion,
            "contact_force": self.link_force,
            "q": self.joint_position,
            "u": recorded.wrist_joints,
            "q_target": self.joint_target,
            "u_target": recorded.wrist_targets,
            "action": recorded.action,
            "table": self.table,
            **_in_folder("reward", recorded.rewards),
            **_in_folder("error", recorded.errors),
            **_in_folder("goal", self.goal),
            **_in_folder("active", self.active),
            "surface_points": self.surface_points,
            "surface_avoid": self.surface_avoid,
            "piece_kind": pieces.kind,
            "piece_size": pieces.size,
            "piece_pos": pieces.pos,
            "piece_quat": pieces.quat,
            "piece_part": pieces.part,
            "visual_vertices": self.object_vertices,
            "visual_faces": self.object_faces,
        }
        if self.colours:
            arrays["colour_points"] = self.colours.points
            arrays["colour_values"] = self.colours.values
        meta = {
            "hand": recorded.hand_reference,
            "object": self.object,
            "control_dt": self.control_dt,
            "version": self.version,
            "success": self.success,
            "metrics": self.metrics,
            **self.about,
            _SCALE: float(self.object_file_scale),
            _ORIGIN: self.object_file_origin.tolist(),
        }
        message = Message(arrays, meta)
        if self.arm:
            return self.arm.add_to(message)
        return message

    def require_recorded(self) -> Recorded:
        """Returns the content that motion files lack.

        Raises:
          CongraspError: the episode is that of a motion file.
        """
        if self.recorded is None:
            raise CongraspError(
                "A motion file has neither actions nor rewards.", "Pass a recording (.mcap)."
            )
        return self.recorded

    def known_hand(self) -> Hand:
        """Returns the hand of a recorded episode; see `common.hands.known_hand`.

        Raises:
          CongraspError: the episode is that of a motion file.
        """
        return known_hand(self.require_recorded().hand_reference)

    @property
    def steps(self) -> int:
        """T, number of frames."""
        return len(self.time)

    @property
    def version(self) -> int:
        """Version of the policy; -1 if unknown."""
        return int(self.about.get("version", -1))

    @property
    def wrist_position(self) -> np.ndarray:
        """(T, 3) m, world."""
        return self.link_position[:, 0]

    @property
    def wrist_quaternion(self) -> np.ndarray:
        """(T, 4), wrist frame to world."""
        return self.link_quaternion[:, 0]

    @property
    def phases(self) -> dict[str, float]:
        """Start times of the phases (approach, grasp, lift, hold), s, without invalid times."""
        phases = self.about.get("phases")
        if not isinstance(phases, dict):
            return {}
        times = {}
        for name, time in phases.items():
            if isinstance(time, int | float) and 0 <= time < _LATEST_PHASE_S:
                times[str(name)] = float(time)
        return times

    @property
    def grasp_span(self) -> tuple[int, int]:
        """First step of the grasp, and first step after it: that of the lift, or without the
        table.
        """
        phases = self.phases
        end = int(np.sum(self.table))
        if "lift" in phases:
            end = self._step_at(phases["lift"])
        start = self._step_at(phases.get("grasp", 0.0))
        return min(start, end), end

    def _step_at(self, seconds: float) -> int:
        """The step nearest to a time, T at most."""
        return round(min(seconds / self.control_dt, self.steps))

    def markers(self) -> Iterator[tuple[str, Marker]]:
        """Yields the markers of each active constraint, object frame, with its name.

        Raises:
          LookupError: a goal array of an active constraint is missing.
        """
        return markers(self.goal, self.active)

    def at_frames(self, frames: np.ndarray) -> "Episode":
        """Returns the episode in other frames (n,), such as every second one; `control_dt` stays
        unchanged.
        """
        timed: dict[str, Any] = {name: getattr(self, name)[frames] for name in _TIMED}
        return dataclasses.replace(
            self,
            **timed,
            arm=self.arm and self.arm.at_frames(frames),
            recorded=self.recorded and self.recorded.at_frames(frames),
        )

    def preceded_by(self, earlier: "Episode") -> "Episode":
        """Returns this episode with all frames of an earlier one before it, without an arm.

        Raises:
          CongraspError: one of them is that of a motion file.
        """
        timed: dict[str, Any] = {}
        for name in _TIMED:
            timed[name] = _joined(getattr(earlier, name), getattr(self, name))
        timed["time"] = self.control_dt * np.arange(earlier.steps + self.steps)
        recorded = self.require_recorded().preceded_by(earlier.require_recorded())
        return dataclasses.replace(self, **timed, arm=None, recorded=recorded)

    def normalised(self) -> "Episode":
        """Returns the episode with quaternions of length one, in place of the rounded ones of
        recordings.
        """
        return dataclasses.replace(
            self,
            link_quaternion=_normalised(self.link_quaternion),
            object_quaternion=_normalised(self.object_quaternion),
        )

    def check_quaternions(self, what: str) -> None:
        """Raises a CongraspError for quaternions that are not normalised.

        Args:
          what: name of the episode or of its file, for the error.
        """
        for owner in (self, self.arm):
            for name in _QUATERNIONS:
                quaternions = getattr(owner, name, None)
                if quaternions is None:
                    continue
                lengths = np.linalg.norm(quaternions, axis=-1)
                if not (np.abs(lengths - 1) <= _UNIT_TOLERANCE).all():
                    raise CongraspError(
                        f"{what}'s {name} has quaternions that are not normalised.",
                        "Run 'congrasp grasp' again.",
                    )


def _meanings() -> dict[str, str]:
    """Meaning of each array of an episode, with its shape, by the name of its field."""
    meanings = {}
    for name, hint in get_type_hints(Episode, include_extras=True).items():
        if hasattr(hint, "__metadata__"):
            meanings[name] = hint.__metadata__[0]
    return meanings


ARRAYS = _meanings()
"""Meaning of each array of an episode, with its shape, by the name of its field."""
_TIMED = [name for name, meaning in ARRAYS.items() if meaning.startswith("(T,")]
"""Fields with a value for each frame."""


def _recorded(hand_reference: str, arrays: Mapping[str, np.ndarray]) -> Recorded:
    """Returns the content of a message that motion files lack."""
    pieces = Pieces(
        kind=arrays["piece_kind"],
        size=arrays["piece_size"],
        pos=arrays["piece_pos"],
        quat=arrays["piece_quat"],
        part=arrays["piece_part"],
    )
    return Recorded(
        hand_reference=hand_reference,
        wrist_joints=arrays["u"],
        wrist_targets=arrays["u_target"],
        action=arrays["action"],
        rewards=_from_folder("reward", arrays),
        errors=_from_folder("error", arrays),
        pieces=pieces,
    )


def _in_folder(folder: str, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays of a message under the names FOLDER/NAME."""
    return {f"{folder}/{name}": np.asarray(value) for name, value in values.items()}


def _from_folder(folder: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of a message with the names FOLDER/NAME, by NAME."""
    prefix = f"{folder}/"
    values = {}
    for name, array in arrays.items():
        if name.startswith(prefix):
            values[name.removeprefix(prefix)] = array
    return values


def _joined(earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Frames of one array before those of another, in the type of the latter."""
    return np.concatenate([earlier.astype(later.dtype), later])


def _all_joined(
    earlier: Mapping[str, np.ndarray], later: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """`_joined` arrays by name."""
    return {name: _joined(earlier[name], values) for name, values in later.items()}


def _normalised(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of length one; those whose length differs by more than `_ROUNDED` are
    unchanged.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return quaternions / np.where(np.abs(lengths - 1) <= _ROUNDED, lengths, 1)
