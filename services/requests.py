"""Queries of the live policy: which arrays they carry, how they are checked, and how they become one flat vector.

A query names its constraints in the metadata and carries, without batch axis, the fields of
`common.task.types.SceneState`, the object's surface points and the goal fields of its constraints. The whole query
travels to the device as one float32 vector, since one transfer costs as much as thirty times its size.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from common.config import TaskConfig
from common.errors import CongraspError
from common.hands import get_hand
from common.hands.spec import Hand
from common.task.types import CONTACTS_PER_LINK, Goal, SceneState
from common.wire.codec import Message

CONSTRAINTS = ("heading", "affordance", "pose", "trajectory")
"""Names that a query may ask for; the last three are bits in this order."""
GOAL_FIELDS = {
    "heading": ("heading_position", "heading_direction"),
    "affordance": (),
    "pose": ("pose_q", "pose_position", "pose_quaternion"),
    "trajectory": ("trajectory_position", "trajectory_quaternion"),
}
"""Goal fields that each constraint needs; `heading_cross` may come along."""
SURFACE_LIMIT = 4096
"""Most surface points in one query; the policy looks at `TaskConfig.surface_points` of them."""
_UNIT_TOLERANCE = 0.02
_OPTIONAL_STATE = (
    "q_velocity",
    "u_velocity",
    "object_velocity",
    "object_angular_velocity",
    "contact_force",
    "contact_position",
    "contact_found",
)


class Query(NamedTuple):
    """A checked query."""

    vector: np.ndarray
    """(S,) float32, laid out by `Layout`."""
    asked: tuple[str, ...]
    """Names of the constraints that were asked for."""


class Layout:
    """Names, shapes and places of a query's fields for one hand and task.

    Attributes:
      shapes: field name to shape; the fields of the state, then of the goal, then the surface and the asked bits.
      size: S, length of the flat vector.
    """

    def __init__(self, hand: Hand, task: TaskConfig):
        fingers, links, points = len(hand.joints), len(hand.links), task.surface_points
        contacts = (links, CONTACTS_PER_LINK)
        special: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("q", "q_velocity", "q_target", "q_initial", "pose_q"), (fingers,)),
            **dict.fromkeys(("u", "u_velocity", "u_target"), (6,)),
            **dict.fromkeys(("contact_force", "contact_position"), (*contacts, 3)),
            **dict.fromkeys(("time", "table"), ()),
            "contact_found": contacts,
            "trajectory_position": (task.trajectory_points, 3),
            "trajectory_quaternion": (task.trajectory_points, 4),
        }
        names = (*SceneState._fields, *(name for name in Goal._fields if name != "mask"))
        self.hand = hand
        self.task = task
        self.shapes = {name: special.get(name, (4,) if "quaternion" in name else (3,)) for name in names}
        self.shapes |= {"surface_points": (points, 3), "surface_minus": (points,), "asked": (3,)}
        self.offsets = {}
        self.size = 0
        for name, shape in self.shapes.items():
            self.offsets[name] = self.size
            self.size += math.prod(shape)

    def unpack(self, vectors: Any) -> dict[str, Any]:
        """Fields (B, ...) of flat vectors (B, S); works on NumPy arrays and on traced ones."""
        return {
            name: vectors[:, self.offsets[name] : self.offsets[name] + math.prod(shape)].reshape(-1, *shape)
            for name, shape in self.shapes.items()
        }

    def parse(self, message: Message) -> Query:
        """Checks a query and lays it out; a CongraspError says what is wrong with it."""
        arrays, meta = message.arrays, message.meta
        hand = meta.get("hand", self.hand.name)
        if hand != self.hand.name:
            get_hand(hand)
            raise CongraspError(f"This server's policy is for the hand '{self.hand.name}', not '{hand}'.")
        asked = _asked(meta.get("constraints", ["heading"]))
        unknown = sorted(arrays.keys() - self.shapes.keys() | arrays.keys() & {"asked"})
        if unknown:
            raise CongraspError(f"The query has an unknown field '{unknown[0]}'.", f"Known: {', '.join(self.shapes)}.")
        required = [name for name in SceneState._fields if name not in _OPTIONAL_STATE]
        required += ["surface_points", *(name for constraint in asked for name in GOAL_FIELDS[constraint])]
        required += ["surface_minus"] if "affordance" in asked else []
        for name in required:
            if name not in arrays:
                raise CongraspError(f"The query lacks the field '{name}'.")
        vector = np.zeros(self.size, np.float32)
        given = dict(arrays)
        given["surface_points"], given["surface_minus"] = self._surface(given, "affordance" in asked)
        for name, value in given.items():
            shape = self.shapes[name]
            if np.shape(value) != shape:
                raise CongraspError(f"The field '{name}' has shape {np.shape(value)}; it must be {shape}.")
            vector[self.offsets[name] : self.offsets[name] + math.prod(shape)] = np.ravel(value)
        if not np.isfinite(vector).all():
            bad = next(name for name, value in given.items() if not np.isfinite(value).all())
            raise CongraspError(f"The field '{bad}' is not finite.")
        self._directions(vector, asked)
        bits = self.offsets["asked"]
        vector[bits:] = [name in asked for name in CONSTRAINTS[1:]]
        return Query(vector, asked)

    def _surface(self, arrays: dict[str, Any], affordance: bool) -> tuple[np.ndarray, np.ndarray]:
        """Points and labels, brought to the number that the policy looks at."""
        points = np.asarray(arrays["surface_points"])
        if points.ndim != 2 or points.shape[1] != 3 or not 1 <= len(points) <= SURFACE_LIMIT:
            raise CongraspError(
                f"The field 'surface_points' has shape {points.shape}; it must be (N, 3), N at most {SURFACE_LIMIT}."
            )
        minus = np.asarray(arrays.get("surface_minus", np.zeros(len(points), bool)))
        if minus.shape != (len(points),):
            raise CongraspError(f"The field 'surface_minus' has shape {minus.shape}; it must be ({len(points)},).")
        if affordance and (minus.all() or not minus.any()):
            raise CongraspError("An affordance needs surface points on both sides.", "Set some of 'surface_minus'.")
        if len(points) == self.task.surface_points:
            return points, minus
        index = np.arange(self.task.surface_points) * len(points) // self.task.surface_points
        return points[index], minus[index]

    def _directions(self, vector: np.ndarray, asked: tuple[str, ...]) -> None:
        """Makes quaternions and directions unit, and completes the goal fields that nobody asked for."""
        fields = {name: field[0] for name, field in self.unpack(vector[None]).items()}
        goal = {name for constraint in asked for name in GOAL_FIELDS[constraint]}
        for name, value in fields.items():
            if name in Goal._fields and name not in goal:
                continue
            if "quaternion" in name or name == "heading_direction":
                norm = np.linalg.norm(value, axis=-1, keepdims=True)
                if np.abs(norm - 1).max() > _UNIT_TOLERANCE:
                    raise CongraspError(
                        f"The field '{name}' has length {norm.flat[np.abs(norm - 1).argmax()]:.3f}, not 1."
                    )
                value /= norm
        for name in ("pose_quaternion", "trajectory_quaternion"):
            if name not in goal:
                fields[name][..., 0] = 1.0
        if "heading_direction" not in goal:
            fields["heading_direction"][2] = -1.0
        fields["heading_cross"][:] = _orthogonal(fields["heading_cross"], fields["heading_direction"])


def _asked(names: Any) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CongraspError("The query's 'constraints' must be a list of names.")
    unknown = [name for name in names if name not in CONSTRAINTS]
    if unknown:
        raise CongraspError(f"There is no constraint '{unknown[0]}'.", f"Choose from: {', '.join(CONSTRAINTS)}.")
    if not {"heading", "pose", "trajectory"} & set(names):
        raise CongraspError("The query asks for neither a heading, a pose nor a trajectory.", "One of them is needed.")
    return tuple(name for name in CONSTRAINTS if name in names)


def _orthogonal(cross: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The cross-finger direction made orthogonal to the heading; any orthogonal one where it is absent or parallel."""
    cross = cross - (cross @ direction) * direction
    if np.linalg.norm(cross) < 1e-3:
        axis = np.eye(3, dtype=np.float32)[np.abs(direction).argmin()]
        cross = axis - (axis @ direction) * direction
    return cross / np.linalg.norm(cross)
