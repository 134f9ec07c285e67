"""What each kind of message must hold; everything that arrives over the wire is checked against it."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from common.errors import CongraspError
from common.wire.codec import Message


@dataclasses.dataclass(frozen=True)
class Field:
    """One array: its shape in symbols or numbers, its types, and whether its values must be finite."""

    shape: tuple[str | int, ...]
    dtypes: tuple[str, ...]


ROLLOUT = {
    "observation": Field(("T", "B", "D"), ("float16", "float32")),
    "action": Field(("T", "B", "A"), ("float32",)),
    "log_probability": Field(("T", "B"), ("float32",)),
    "reward": Field(("T", "B"), ("float32",)),
    "terminal": Field(("T", "B"), ("bool",)),
    "last_observation": Field(("B", "D"), ("float16", "float32")),
}
ROLLOUT_META = {
    "actor": str,
    "incarnation": str,
    "sequence": int,
    "version": int,
    "epoch": str,
    "schema": str,
    "steps": int,
}
_EPISODE = Field(("E",), ("float32",))
BUNDLE_META = {
    "version": int,
    "epoch": str,
    "schema": str,
    "hand": str,
    "layout": list,
    "action_size": int,
    "network": dict,
    "task": dict,
    "format": int,
}


def check_meta(meta: Mapping[str, object], spec: Mapping[str, type], kind: str) -> None:
    """Raises a CongraspError that names the missing or mistyped entry."""
    for name, kind_of in spec.items():
        value = meta.get(name)
        if not isinstance(value, kind_of) or (kind_of is int and isinstance(value, bool)):
            raise CongraspError(f"The {kind}'s '{name}' is missing or is not of type {kind_of.__name__}.")


def check_arrays(arrays: Mapping[str, np.ndarray], spec: Mapping[str, Field], kind: str, **sizes: int) -> None:
    """Raises a CongraspError that names the array and the rule it breaks.

    Args:
      arrays: what arrived.
      spec: what must be there, and nothing else.
      kind: word for the message in errors.
      **sizes: sizes of symbols that are known; the others must only agree with each other.
    """
    if missing := spec.keys() - arrays.keys():
        raise CongraspError(f"The {kind} lacks the array '{min(missing)}'.")
    if extra := arrays.keys() - spec.keys():
        raise CongraspError(f"The {kind} has an array '{min(extra)}' that it should not have.")
    for name, field in spec.items():
        array = arrays[name]
        if str(array.dtype) not in field.dtypes:
            raise CongraspError(f"The {kind}'s '{name}' is {array.dtype}, not {' or '.join(field.dtypes)}.")
        if len(array.shape) != len(field.shape):
            raise CongraspError(f"The {kind}'s '{name}' has shape {array.shape}, not {field.shape}.")
        for size, symbol in zip(array.shape, field.shape, strict=True):
            expected = sizes.setdefault(symbol, size) if isinstance(symbol, str) else symbol
            if size != expected:
                raise CongraspError(f"The {kind}'s '{name}' has shape {array.shape}: {symbol} should be {expected}.")
        # A sum is finite only if every value is (and no finite float16 or float32 array sums beyond float64).
        if array.dtype.kind == "f" and not np.isfinite(np.sum(array, dtype=np.float64)):
            raise CongraspError(f"The {kind}'s '{name}' holds values that are not finite.")


def validate_rollout(message: Message, *, observation_size: int, action_size: int, schema: str) -> None:
    """Checks a rollout of any number of steps, worlds and finished episodes."""
    check_meta(message.meta, ROLLOUT_META, "rollout")
    if message.meta["schema"] != schema:
        raise CongraspError(
            f"The rollout's schema {message.meta['schema']} is not the learner's {schema}.",
            "Run actor and learner from the same version.",
        )
    episodes = {name: _EPISODE for name in message.arrays if name.startswith(("episode/", "term/"))}
    check_arrays(message.arrays, ROLLOUT | episodes, "rollout", D=observation_size, A=action_size)
    steps, worlds = message.arrays["reward"].shape
    if steps * worlds == 0 or message.meta["steps"] != steps * worlds:
        raise CongraspError(f"The rollout says {message.meta['steps']} steps and holds {steps} x {worlds}.")


def validate_bundle(message: Message) -> None:
    """Checks a policy bundle's metadata and that its arrays are finite."""
    check_meta(message.meta, BUNDLE_META, "policy bundle")
    for name, array in message.arrays.items():
        if np.asarray(array).dtype.kind == "f" and not np.all(np.isfinite(np.asarray(array))):
            raise CongraspError(f"The policy bundle's '{name}' holds values that are not finite.")
