"""Queries of the live policy: which arrays they carry, how they are checked, and how they become one flat vector.

A query names its constraints in the metadata and carries, without batch axis, the fields of
`common.task.types.SceneState`, the object's surface points and the goal fields of its constraints. The whole query
travels to the device as one float32 vector, since one transfer costs as much as thirty times its size.

A query may also be packed: the vector itself as its one array, and in the metadata the digest of the layout that it
follows. Whoever asks a query of names for the `layout` gets it with the answer. Packed queries cost both ends a fourth.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
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
PACKED = "packed"
"""The one array of a packed query."""
_UNIT_TOLERANCE = 0.02
_DOWN, _IDENTITY = np.array((0, 0, -1), np.float32), np.array((1, 0, 0, 0), np.float32)
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
    """A query whose fields are all there."""

    vector: np.ndarray
    """(S,) float32, laid out by `Layout`; its values are checked by `Layout.complete`."""
    asked: tuple[str, ...]
    """Names of the constraints that were asked for."""


class Layout:
    """Names, shapes and places of a query's fields for one hand and task.

    Attributes:
      shapes: field name to shape; the fields of the state, then of the goal, then the surface and the asked bits.
      size: S, length of the flat vector.
      digest: identifies the layout.
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
        places = np.arange(self.size)
        quaternions = [name for name in self.shapes if "quaternion" in name]
        self._quaternions = np.concatenate([self._field(places, name).reshape(-1, 4) for name in quaternions])
        # Which constraint a quaternion belongs to: an index into CONSTRAINTS, or the one after for the state's.
        self._owners = np.concatenate(
            [[_owner(name)] * (math.prod(self.shapes[name]) // 4) for name in quaternions]
        ).astype(int)
        self.digest = hashlib.sha256(json.dumps(self.description()).encode()).hexdigest()[:16]

    def description(self) -> dict[str, Any]:
        """For packers: the vector's size, and offset and shape of every field but those that the server fills in."""
        fields = {name: [self.offsets[name], *shape] for name, shape in self.shapes.items() if name != "asked"}
        return {"size": self.size, "fields": fields}

    def unpack(self, vectors: Any) -> dict[str, Any]:
        """Fields (B, ...) of flat vectors (B, S); works on NumPy arrays and on traced ones."""
        return {name: self._field(vectors, name).reshape(-1, *shape) for name, shape in self.shapes.items()}

    def _field(self, vectors: Any, name: str) -> Any:
        """A field's numbers (..., n) in flat vectors (..., S)."""
        return vectors[..., self.offsets[name] : self.offsets[name] + math.prod(self.shapes[name])]

    def parse(self, message: Message) -> Query:
        """Lays a query out, unless it is packed already; a CongraspError says what is wrong with its form."""
        meta = message.meta
        hand = meta.get("hand", self.hand.name)
        if hand != self.hand.name:
            get_hand(hand)
            raise CongraspError(f"This server's policy is for the hand '{self.hand.name}', not '{hand}'.")
        asked = _asked(meta.get("constraints", ["heading"]))
        vector = self._packed(message) if PACKED in message.arrays else self._named(message.arrays, asked)
        vector[self.offsets["asked"] :] = [name in asked for name in CONSTRAINTS[1:]]
        return Query(vector, asked)

    def _packed(self, message: Message) -> np.ndarray:
        vector, digest = message.arrays[PACKED], message.meta.get("layout")
        if digest != self.digest or len(message.arrays) > 1 or vector.shape != (self.size,):
            raise CongraspError(
                "The packed query does not follow this server's layout.", "Ask for the layout with a query of names."
            )
        return np.array(vector, np.float32)

    def _named(self, arrays: Mapping[str, Any], asked: tuple[str, ...]) -> np.ndarray:
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
        given["surface_points"], given["surface_minus"] = self._surface(given)
        for name, value in given.items():
            shape = self.shapes[name]
            if np.shape(value) != shape:
                raise CongraspError(f"The field '{name}' has shape {np.shape(value)}; it must be {shape}.")
            vector[self.offsets[name] : self.offsets[name] + math.prod(shape)] = np.ravel(value)
        return vector

    def complete(self, vectors: np.ndarray, asked: Sequence[tuple[str, ...]]) -> list[CongraspError | None]:
        """Checks the values of queries (B, S), makes quaternions and directions unit, fills in what nobody asked for.

        Returns:
          What is wrong with each query; the vectors of such are zero afterwards.
        """
        errors: list[CongraspError | None] = [None] * len(vectors)
        wanted = np.array([[*(name in names for name in CONSTRAINTS), True] for names in asked])
        for row in np.flatnonzero(~np.isfinite(vectors).all(1)):
            fields = self.unpack(vectors[row : row + 1])
            bad = next(name for name, value in fields.items() if not np.isfinite(value).all())
            errors[row] = CongraspError(f"The field '{bad}' is not finite.")
            vectors[row] = 0.0
        minus = self._field(vectors, "surface_minus") > 0.5
        for row in np.flatnonzero(wanted[:, CONSTRAINTS.index("affordance")] & (minus.all(1) | ~minus.any(1))):
            text = "An affordance needs surface points on both sides."
            errors[row] = errors[row] or CongraspError(text, "Set some of 'surface_minus'.")
        direction = self._field(vectors, "heading_direction")
        down, lengths = _unit(direction[:, None], wanted[:, :1], _DOWN)
        turns, more = _unit(vectors[:, self._quaternions], wanted[:, self._owners], _IDENTITY)
        lengths = np.concatenate([lengths, more], 1)
        direction[:], vectors[:, self._quaternions] = down[:, 0], turns
        starts = [self.offsets["heading_direction"], *self._quaternions[:, 0]]
        for row, column in np.argwhere(np.abs(lengths - 1.0) > _UNIT_TOLERANCE):
            name = max((n for n in self.offsets if self.offsets[n] <= starts[column]), key=self.offsets.__getitem__)
            text = f"The field '{name}' has length {lengths[row, column]:.3f}, not 1."
            errors[row] = errors[row] or CongraspError(text)
        cross = self._field(vectors, "heading_cross")
        cross[:] = _orthogonal(cross, direction)
        return errors

    def _surface(self, arrays: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Points and labels, brought to the number that the policy looks at."""
        points = np.asarray(arrays["surface_points"])
        if points.ndim != 2 or points.shape[1] != 3 or not 1 <= len(points) <= SURFACE_LIMIT:
            raise CongraspError(
                f"The field 'surface_points' has shape {points.shape}; it must be (N, 3), N at most {SURFACE_LIMIT}."
            )
        minus = np.asarray(arrays.get("surface_minus", np.zeros(len(points), bool)))
        if minus.shape != (len(points),):
            raise CongraspError(f"The field 'surface_minus' has shape {minus.shape}; it must be ({len(points)},).")
        if len(points) == self.task.surface_points:
            return points, minus
        index = np.arange(self.task.surface_points) * len(points) // self.task.surface_points
        return points[index], minus[index]


def _owner(name: str) -> int:
    of = [number for number, constraint in enumerate(CONSTRAINTS) if name in GOAL_FIELDS[constraint]]
    return of[0] if of else len(CONSTRAINTS)


def _unit(vectors: np.ndarray, wanted: np.ndarray, default: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wanted vectors (B, M, n) made unit, the default for the others, and the lengths (B, M) that were, 1 for those."""
    lengths = np.where(wanted, np.sqrt(np.einsum("bmi,bmi->bm", vectors, vectors)), 1.0)
    usable = wanted & (lengths > 0.5)
    return np.where(usable[..., None], vectors / np.where(usable, lengths, 1.0)[..., None], default), lengths


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
    """(B, 3) unit cross-finger directions orthogonal to the heading; any such where one is absent or parallel to it."""
    cross = cross - np.sum(cross * direction, -1, keepdims=True) * direction
    axis = np.eye(3, dtype=np.float32)[np.abs(direction).argmin(-1)]
    other = axis - np.sum(axis * direction, -1, keepdims=True) * direction
    cross = np.where(np.linalg.norm(cross, axis=-1, keepdims=True) < 1e-3, other, cross)
    return cross / np.linalg.norm(cross, axis=-1, keepdims=True)
