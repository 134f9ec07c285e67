"""Specification of each kind of message, and its validation.

A spec names arrays with their dtypes and shapes. A shape consists of numbers and of symbols such as
T; a symbol has one size throughout a message. Floating-point values must be finite.

The arrays of a rollout are defined once for all producers and consumers. Actors can record
`RECORDABLE`; the learner's algorithm selects the arrays it learns from, and the learner sends that
selection to the actors. These specs and a run's sizes (`RolloutForm`) determine what is sent, what
is admitted, the layout of a batch, and the axis along which it is sharded over ranks.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import check_name
from congrasp.common.wire.codec import Message

WORLDS = "B"
"""Symbol of the axis of a rollout's worlds, along which rollouts are concatenated in a batch."""
F32 = ("float32",)
_OBSERVATION = ("float16", "float32")
LONGEST_TEXT = 4096
"""Limit of a text in the metadata, in characters; the text of a hand has a separate limit
(`common.hands.files`).
"""
REAL = ("float32", "float64")
_INFINITE_HALF = 0x7C00  # exponent bits of a float16 that is infinite or NaN
_BLOCK_VALUES = 1 << 16  # checked at a time, so that temporary arrays are small
_MAX_COUNT = 1 << 53  # larger integers are not exact in JSON
_INDEX = ("int32", "int64")


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Specification of one array of a message."""

    dtypes: tuple[str, ...]
    """Names of the allowed dtypes, the narrowest first."""
    shape: tuple[str | int, ...] | None
    """Sizes and symbols; None admits any shape."""
    optional: bool = False
    """True if the array may be absent."""

    @property
    def worlds_axis(self) -> int:
        """Index of the axis of worlds."""
        assert self.shape is not None
        return self.shape.index(WORLDS)


Schema = Mapping[str, ArraySpec]
"""Arrays by name; their shapes consist of T control steps, B worlds, D observation and A action
sizes, P privileged inputs of the critic, and S inputs of a teacher (`common.task.privileged`)."""


RECORDED: Schema = {
    "observation": ArraySpec(_OBSERVATION, ("T", "B", "D")),
    "action": ArraySpec(F32, ("T", "B", "A")),
    "log_probability": ArraySpec(F32, ("T", "B")),
    "reward": ArraySpec(F32, ("T", "B")),
    "terminal": ArraySpec(("bool",), ("T", "B")),
    "truncated": ArraySpec(("bool",), ("T", "B")),
    "last_observation": ArraySpec(_OBSERVATION, ("B", "D")),
}
"""Arrays that actors record in any rollout (`actors.rollout.Rollout`)."""
PRIVILEGED: Schema = {
    "privileged": ArraySpec(_OBSERVATION, ("T", "B", "P")),
    "last_privileged": ArraySpec(_OBSERVATION, ("B", "P")),
}
"""Additional arrays for a critic with privileged inputs (`common.task.privileged`)."""
TAUGHT: Schema = {"teacher_observation": ArraySpec(_OBSERVATION, ("T", "B", "S"))}
"""Additional arrays for a teacher that labels the rollout (`common.task.privileged`)."""
RECORDABLE: Schema = {**RECORDED, **PRIVILEGED, **TAUGHT}
"""All recordable arrays."""


@dataclasses.dataclass(frozen=True)
class RolloutForm:
    """Common form of a run's rollouts, so that any of them form a batch without recompilation."""

    steps: int
    """T."""
    worlds: int
    """B."""
    observation: int
    """D."""
    action: int
    """A."""
    half: bool
    """Observations are float16 if true, otherwise float32."""
    teacher: int = 0
    """S."""
    privileged: int = 0
    """P."""
    arrays: Schema = dataclasses.field(default_factory=lambda: RECORDED)
    """Arrays from which the run's algorithm learns."""

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the symbols."""
        return {
            "T": self.steps,
            WORLDS: self.worlds,
            "D": self.observation,
            "A": self.action,
            "P": self.privileged,
            "S": self.teacher,
        }

    @property
    def specs(self) -> dict[str, ArraySpec]:
        """Specs of the arrays, each with its single dtype in this run."""
        return {
            name: dataclasses.replace(spec, dtypes=(spec.dtypes[0 if self.half else -1],))
            for name, spec in self.arrays.items()
        }

    def zeros(self, rollouts: int = 1) -> dict[str, np.ndarray]:
        """Returns zero arrays of `rollouts` concatenated rollouts."""
        sizes = {**self.sizes, WORLDS: self.worlds * rollouts}

        def zeros(spec: ArraySpec) -> np.ndarray:
            shape = [sizes[size] if isinstance(size, str) else size for size in spec.shape or ()]
            return np.zeros(shape, spec.dtypes[0])

        return {name: zeros(spec) for name, spec in self.specs.items()}


@dataclasses.dataclass(frozen=True)
class MessageSpec:
    """Specification of one kind of message."""

    kind: str
    """Name in errors."""
    arrays: Mapping[str, ArraySpec] = dataclasses.field(default_factory=dict)
    """Specs by name; a name that ends in `/*` matches any number of arrays below it."""
    meta: Mapping[str, type | tuple[type, ...]] = dataclasses.field(default_factory=dict)
    """Types of the required entries of the metadata; others are allowed."""


_EPISODES = {"episode/*": ArraySpec(F32, ("E",)), "term/*": ArraySpec(F32, ("E",))}

ROLLOUT = MessageSpec(
    "rollout",
    {**RECORDABLE, **_EPISODES},
    {
        "actor": str,
        "incarnation": str,
        "sequence": int,
        "version": int,
        "run_id": str,
        "schema": str,
        "steps": int,
    },
)
"""Actor to learner: T control steps of B worlds, D observation and A action sizes, P inputs of the
critic and S of a teacher, E finished episodes. Of the per-step arrays it holds those that the run's
algorithm learns from."""

BUNDLE = MessageSpec(
    "bundle",
    {
        "actor/*": ArraySpec(REAL, None),
        "critic/*": ArraySpec(REAL, None),
        "observation/mean": ArraySpec(REAL, ("D",)),
        "observation/m2": ArraySpec(REAL, ("D",)),
        "observation/count": ArraySpec(REAL, ()),
        "privileged/mean": ArraySpec(REAL, ("P",), optional=True),
        "privileged/m2": ArraySpec(REAL, ("P",), optional=True),
        "privileged/count": ArraySpec(REAL, (), optional=True),
        "value/mean": ArraySpec(REAL, (), optional=True),
        "value/m2": ArraySpec(REAL, (), optional=True),
        "value/count": ArraySpec(REAL, (), optional=True),
    },
    {
        "version": int,
        "run_id": str,
        "schema": str,
        "hand": str,
        "layout": list,
        "action_size": int,
        "format": int,
    },
)
"""Learner to all: weights and normalisers of one version."""

EPISODE = MessageSpec(
    "episode",
    {
        "link_position": ArraySpec(REAL, ("T", "L", 3)),
        "link_quaternion": ArraySpec(REAL, ("T", "L", 4)),
        "object_position": ArraySpec(REAL, ("T", 3)),
        "object_quaternion": ArraySpec(REAL, ("T", 4)),
        "contact_force": ArraySpec(REAL, ("T", "L", 3)),
        "q": ArraySpec(REAL, ("T", "F")),
        "u": ArraySpec(REAL, ("T", 6)),
        "q_target": ArraySpec(REAL, ("T", "F")),
        "u_target": ArraySpec(REAL, ("T", 6)),
        "action": ArraySpec(REAL, ("T", "A")),
        "table": ArraySpec(("bool",), ("T",)),
        "reward/*": ArraySpec(REAL, ("T",)),
        "error/*": ArraySpec(REAL, ("T",)),
        "goal/*": ArraySpec((*REAL, "bool"), None),
        "active/*": ArraySpec(("bool",), ()),
        "piece_kind": ArraySpec(_INDEX, ("n",)),
        "piece_size": ArraySpec(REAL, ("n", 3)),
        "piece_pos": ArraySpec(REAL, ("n", 3)),
        "piece_quat": ArraySpec(REAL, ("n", 4)),
        "piece_part": ArraySpec(_INDEX, ("n",)),
        "visual_vertices": ArraySpec(REAL, ("V", 3)),
        "visual_faces": ArraySpec(_INDEX, ("Fc", 3)),
        "colour_points": ArraySpec(REAL, ("P", 3), optional=True),
        "colour_values": ArraySpec(("uint8",), ("P", 3), optional=True),
        "surface_points": ArraySpec(REAL, ("N", 3)),
        "surface_avoid": ArraySpec(("bool",), ("N",)),
        "arm/*": ArraySpec((*REAL, *_INDEX, "bool"), None),
    },
    {
        "hand": str,
        "object": str,
        "control_dt": float,
        "version": int,
        "actor": str,
        "success": bool,
        "metrics": dict,
    },
)
"""Actor to subscribers: one world for T steps, for drawing."""

METRICS = MessageSpec("metrics", meta={"time": (int, float), "values": dict})
EVENT = MessageSpec("event", meta={"time": (int, float), "level": str, "text": str})
TICKET = MessageSpec("ticket request", meta={"actor": str, "incarnation": str, "ticket": str})


def validate(message: Message, spec: MessageSpec, **sizes: int) -> dict[str, int]:
    """Validates a message of a known kind.

    Args:
      message: the message; device arrays are not checked for finite values, since they never left
        this process.
      spec: specification of the kind.
      **sizes: sizes of symbols known beforehand.

    Returns:
      The sizes of all symbols.

    Raises:
      CongraspError: the message is invalid; the text names the array or the entry, and the violated
        rule.
    """
    for name, kind in spec.meta.items():
        _check_entry(f"The {spec.kind}'s meta entry '{name}'", name, message.meta.get(name), kind)
    _check_completeness(message, spec)
    symbol_sizes = dict(sizes)
    for name, array in message.arrays.items():
        array_spec = _spec_of(name, spec)
        if array_spec is None:
            raise CongraspError(f"The {spec.kind} has an unknown array {ascii(name)[:60]}.")
        what = f"The {spec.kind}'s array {ascii(name)[:60]}"
        _check_array(what, array, array_spec, symbol_sizes)
    return symbol_sizes


def _check_entry(what: str, name: str, value: Any, kind: type | tuple[type, ...]) -> None:
    """Raises a CongraspError if an entry of the metadata has another type or exceeds a limit."""
    is_unexpected_bool = isinstance(value, bool) and kind is not bool
    if not isinstance(value, kind) or is_unexpected_bool:
        raise CongraspError(f"{what} is {ascii(value)[:60]}, not {_type_name(kind)}.")
    if isinstance(value, str) and name != "hand" and len(value) > LONGEST_TEXT:
        raise CongraspError(f"{what} has {len(value)} characters; the limit is {LONGEST_TEXT}.")
    if isinstance(value, int) and abs(value) > _MAX_COUNT:
        raise CongraspError(f"{what} is too large for a count.")


def _check_completeness(message: Message, spec: MessageSpec) -> None:
    """Raises a CongraspError if a required array is missing."""
    for name, array_spec in spec.arrays.items():
        is_required = not array_spec.optional and not name.endswith("/*")
        if is_required and name not in message.arrays:
            raise CongraspError(f"The {spec.kind} lacks the array '{name}'.")


def _spec_of(name: str, spec: MessageSpec) -> ArraySpec | None:
    """Specification of an array, under its name or its folder's; None if it is unknown."""
    array_spec = spec.arrays.get(name)
    if array_spec is not None:
        return array_spec
    folder, slash, _ = name.partition("/")
    return spec.arrays.get(f"{folder}/*") if slash else None


def _check_array(what: str, array: Any, spec: ArraySpec, sizes: dict[str, int]) -> None:
    """Checks an array's dtype, shape and values.

    Args:
      what: subject of the error's sentence.
      array: the array; a device array is not checked for finite values.
      spec: its specification.
      sizes: sizes by symbol; symbols that occur for the first time are added.

    Raises:
      CongraspError: the array is invalid.
    """
    if str(array.dtype) not in spec.dtypes:
        raise CongraspError(f"{what} has dtype {array.dtype}, not {' or '.join(spec.dtypes)}.")
    if spec.shape is not None and not _fits(array.shape, spec.shape, sizes):
        rule = ", ".join(_axis_text(axis, sizes) for axis in spec.shape)
        raise CongraspError(f"{what} has shape {tuple(array.shape)}, not ({rule}).")
    if isinstance(array, np.ndarray) and not is_finite(array):
        raise CongraspError(f"{what} has values that are not finite.")


def _fits(shape: tuple[int, ...], rule: tuple[str | int, ...], sizes: dict[str, int]) -> bool:
    """True if a shape has these sizes and symbols; adds new symbols to `sizes`."""
    if len(shape) != len(rule):
        return False
    for axis, size in zip(rule, shape, strict=True):
        required = sizes.setdefault(axis, size) if isinstance(axis, str) else axis
        if size != required:
            return False
    return True


def _axis_text(axis: str | int, sizes: dict[str, int]) -> str:
    """Size of an axis for an error, with its symbol if it has one."""
    if isinstance(axis, str) and axis in sizes:
        return f"{axis}={sizes[axis]}"
    return str(axis)


def is_finite(array: np.ndarray) -> bool:
    """True if every value is finite; four times as fast as `np.isfinite` for float16."""
    if array.dtype != np.float16:
        return bool(np.isfinite(array).all())
    bits = array.reshape(-1).view(np.uint16)
    return all(
        (bits[start : start + _BLOCK_VALUES] & 0x7FFF).max() < _INFINITE_HALF
        for start in range(0, len(bits), _BLOCK_VALUES)
    )


def _type_name(kind: type | tuple[type, ...]) -> str:
    """Names of the allowed types for an error."""
    if isinstance(kind, type):
        return kind.__name__
    return " or ".join(alternative.__name__ for alternative in kind)


class RolloutHeader(NamedTuple):
    """Origin and policy of a rollout: the metadata entries of `ROLLOUT`, in order."""

    actor: str
    incarnation: str
    """Random identifier of one start of the actor's process."""
    sequence: int
    """Number of the rollout within the incarnation, from zero."""
    version: int
    """Version of the behaviour policy."""
    run_id: str
    """Id of the run; it changes when training starts from scratch."""
    schema: str
    steps: int
    """T*B."""

    @property
    def owner(self) -> tuple[str, str]:
        """Actor and incarnation."""
        return self.actor, self.incarnation


def validate_rollout(
    message: Message, form: RolloutForm, *, schema: str | None = None
) -> RolloutHeader:
    """Validates a rollout.

    Args:
      message: a rollout.
      form: required arrays, sizes and types.
      schema: required policy schema; None for any.

    Raises:
      CongraspError: the rollout is invalid; the text names the array or the entry, and the violated
        rule.
    """
    spec = dataclasses.replace(ROLLOUT, arrays={**form.specs, **_EPISODES})
    validate(message, spec, **form.sizes)
    header = RolloutHeader(*(message.meta[name] for name in ROLLOUT.meta))
    check_name("actor", header.actor)
    check_name("incarnation", header.incarnation)
    if not (0 <= header.sequence < _MAX_COUNT and 0 <= header.version < _MAX_COUNT):
        raise CongraspError("The rollout's meta entries 'sequence' and 'version' must be counts.")
    if header.steps != form.steps * form.worlds:
        raise CongraspError(
            f"The rollout's meta entry 'steps' is {header.steps}, not T*B = "
            f"{form.steps}*{form.worlds}."
        )
    if schema is not None and header.schema != schema:
        raise CongraspError(
            f"The rollout was made with the policy schema {ascii(header.schema)[:40]}, not "
            f"{schema}.",
            "Restart the actor with the learner's version of congrasp.",
        )
    return header


def validate_bundle(message: Message, *, schema: str | None = None) -> None:
    """Validates a policy bundle as far as possible without its network.

    Args:
      message: a bundle.
      schema: required policy schema; None for any.

    Raises:
      CongraspError: the bundle is invalid; the text names the array or the entry, and the violated
        rule.
    """
    validate(message, BUNDLE)
    if not any(name.startswith("actor/") for name in message.arrays):
        raise CongraspError("The bundle has no arrays of an actor.")
    if schema is not None and message.meta["schema"] != schema:
        raise CongraspError(
            f"The bundle has the policy schema {ascii(message.meta['schema'])[:40]}, not {schema}."
        )
