"""What each kind of message must hold, and the check that it does.

A spec names arrays with their dtypes and shapes. A shape is made of numbers and of symbols such as T; a symbol stands
for one size throughout a message. Values must be finite wherever they are floating-point numbers.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import check_name
from congrasp.common.wire.codec import Message
from congrasp.common.wire.schema import F32, RECORDABLE, ArraySpec, RolloutForm

LONGEST_TEXT = 4096
"""Characters of a text in the meta data; a hand's own text has its own limit (`common.hands.files`)."""
REAL = ("float32", "float64")
_INFINITE_HALF = 0x7C00  # exponent bits of a float16 that is infinite or not a number
_BLOCK = 1 << 16
_COUNTS = 1 << 53


@dataclasses.dataclass(frozen=True)
class MessageSpec:
    """One kind of message."""

    kind: str
    """What errors call it."""
    arrays: Mapping[str, ArraySpec] = dataclasses.field(default_factory=dict)
    """Specs by name; a name that ends in `/*` stands for any number of arrays below it."""
    meta: Mapping[str, type | tuple[type, ...]] = dataclasses.field(default_factory=dict)
    """Types of the entries of the meta data that must be there; others may be."""


_INDEX = ("int32", "int64")

_EPISODES = {"episode/*": ArraySpec(F32, ("E",)), "term/*": ArraySpec(F32, ("E",))}

ROLLOUT = MessageSpec(
    "rollout",
    {**RECORDABLE, **_EPISODES},
    {
        "actor": str,
        "incarnation": str,
        "sequence": int,
        "version": int,
        "epoch": str,
        "schema": str,
        "steps": int,
    },
)
"""Actor to learner: T control steps of B worlds, D observation and A action sizes, P and S of what the critic and a
teacher see, E episodes that ended. Of the arrays of the steps there are those that the run's algorithm learns from.
`epoch` is the run's id."""

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
        "value/mean": ArraySpec(REAL, ()),
        "value/m2": ArraySpec(REAL, ()),
        "value/count": ArraySpec(REAL, ()),
    },
    {"version": int, "epoch": str, "schema": str, "hand": str, "layout": list, "action_size": int, "format": int},
)
"""Learner to everyone: weights and normalisers of one version."""

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
        "surface_minus": ArraySpec(("bool",), ("N",)),
    },
    {"hand": str, "object": str, "control_dt": float, "version": int, "actor": str, "success": bool, "metrics": dict},
)
"""Actor to whoever listens: one world for T steps, for drawing."""

METRICS = MessageSpec("metrics", meta={"time": (int, float), "values": dict})
EVENT = MessageSpec("event", meta={"time": (int, float), "level": str, "text": str})
TICKET = MessageSpec("ticket request", meta={"actor": str, "incarnation": str, "ticket": str})
ANNOUNCEMENT = MessageSpec("announcement", meta={"version": int, "epoch": str, "life": str})
"""Learner to everyone: there is a new version. `epoch` is the run's id, another one when training starts from scratch;
`life` is the session's, another one each time the learner's process starts."""


def validate(message: Message, spec: MessageSpec, **sizes: int) -> dict[str, int]:
    """Checks a message against its kind.

    Args:
      message: the message; arrays that live on a device are not checked for finite values, as they never left this
        process.
      spec: the kind.
      **sizes: values of symbols that are known beforehand.

    Returns:
      The values of all symbols.

    Raises:
      CongraspError: naming the array or the entry, and the rule that it breaks.
    """
    for name, kind in spec.meta.items():
        value = message.meta.get(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise CongraspError(
                f"The {spec.kind}'s meta entry '{name}' is {ascii(value)[:60]}, not {_type_name(kind)}."
            )
        if isinstance(value, str) and name != "hand" and len(value) > LONGEST_TEXT:
            raise CongraspError(
                f"The {spec.kind}'s meta entry '{name}' has {len(value)} characters, more than {LONGEST_TEXT}."
            )
        if isinstance(value, int) and abs(value) > _COUNTS:
            raise CongraspError(f"The {spec.kind}'s meta entry '{name}' is beyond all counts.")
    for name, array_spec in spec.arrays.items():
        if not name.endswith("/*") and not array_spec.optional and name not in message.arrays:
            raise CongraspError(f"The {spec.kind} lacks the array '{name}'.")
    known = dict(sizes)
    for name, array in message.arrays.items():
        folder, below, _ = name.partition("/")
        known_spec = spec.arrays.get(name) or spec.arrays.get(f"{folder}/*" if below else "")
        if known_spec is None:
            raise CongraspError(f"The {spec.kind} has an unknown array {ascii(name)[:60]}.")
        _check(f"The {spec.kind}'s array {ascii(name)[:60]}", array, known_spec, known)
    return known


def _check(what: str, array: Any, spec: ArraySpec, known: dict[str, int]) -> None:
    if str(array.dtype) not in spec.dtypes:
        raise CongraspError(f"{what} has dtype {array.dtype}, not {' or '.join(spec.dtypes)}.")
    if spec.shape is not None:
        fits = len(array.shape) == len(spec.shape) and all(
            size == (known.setdefault(symbol, size) if isinstance(symbol, str) else symbol)
            for symbol, size in zip(spec.shape, array.shape, strict=True)
        )
        if not fits:
            rule = ", ".join(f"{s}={known[s]}" if isinstance(s, str) and s in known else str(s) for s in spec.shape)
            raise CongraspError(f"{what} has shape {tuple(array.shape)}, not ({rule}).")
    if isinstance(array, np.ndarray) and not is_finite(array):
        raise CongraspError(f"{what} has values that are not finite.")


def is_finite(array: np.ndarray) -> bool:
    """Whether every value is a finite number; four times as fast for float16 as `np.isfinite`."""
    if array.dtype != np.float16:
        return bool(np.isfinite(array).all())
    bits = array.reshape(-1).view(np.uint16)
    return all((bits[start : start + _BLOCK] & 0x7FFF).max() < _INFINITE_HALF for start in range(0, len(bits), _BLOCK))


def _type_name(kind: type | tuple[type, ...]) -> str:
    return kind.__name__ if isinstance(kind, type) else " or ".join(one.__name__ for one in kind)


class RolloutHeader(NamedTuple):
    """Who made a rollout, and under which policy: the meta entries of `ROLLOUT`, in their order."""

    actor: str
    incarnation: str
    """Random, one for each start of the actor's process."""
    sequence: int
    """Counts the rollouts of an incarnation from zero."""
    version: int
    """Version of the policy that acted."""
    run_id: str
    """Identifies the training; the meta entry `epoch`."""
    schema: str
    steps: int
    """T*B."""

    @property
    def owner(self) -> tuple[str, str]:
        """Actor and incarnation."""
        return self.actor, self.incarnation


def validate_rollout(message: Message, form: RolloutForm, *, schema: str | None = None) -> RolloutHeader:
    """Checks a rollout.

    Args:
      message: a rollout.
      form: arrays, sizes and types that it must have.
      schema: the policy schema that it must have been made with, if that matters.

    Raises:
      CongraspError: naming the array or the entry, and the rule that it breaks.
    """
    validate(message, dataclasses.replace(ROLLOUT, arrays={**form.specs, **_EPISODES}), **form.sizes)
    header = RolloutHeader(*(message.meta[name] for name in ROLLOUT.meta))
    check_name("actor", header.actor)
    check_name("incarnation", header.incarnation)
    if not (0 <= header.sequence < _COUNTS and 0 <= header.version < _COUNTS):
        raise CongraspError("The rollout's meta entries 'sequence' and 'version' must be counts.")
    if header.steps != form.steps * form.worlds:
        raise CongraspError(
            f"The rollout's meta entry 'steps' is {header.steps}, not T*B = {form.steps}*{form.worlds}."
        )
    if schema is not None and header.schema != schema:
        raise CongraspError(
            f"The rollout was made with the policy schema {ascii(header.schema)[:40]}, not {schema}.",
            "Start the actor anew, with the version of congrasp that the learner has.",
        )
    return header


def validate_bundle(message: Message, *, schema: str | None = None) -> None:
    """Checks a policy bundle as far as that needs no network.

    Args:
      message: a bundle.
      schema: the policy schema that it must have, if that matters.

    Raises:
      CongraspError: naming the array or the entry, and the rule that it breaks.
    """
    validate(message, BUNDLE)
    if not any(name.startswith("actor/") for name in message.arrays):
        raise CongraspError("The bundle has no arrays of an actor.")
    if schema is not None and message.meta["schema"] != schema:
        raise CongraspError(f"The bundle has the policy schema {ascii(message.meta['schema'])[:40]}, not {schema}.")
