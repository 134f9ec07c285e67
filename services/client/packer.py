"""Packs the queries of an episode into vectors, in the layout that a policy's metadata describe;
needs only NumPy.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from congrasp.common.errors import RefusedError
from congrasp.common.wire.codec import Message
from congrasp.services.client.fields import CAMERA, MEASURED, NORMALS, as_numbers, checked, require
from congrasp.services.client.policy import State

PACKED_ARRAY = "packed"
"""Name of the one array of a query or a reply."""
HISTORY_FIELDS = (*MEASURED, "q_target", "u_target")
"""Fields of earlier control steps, which a policy with history observes."""
_POINT_FIELDS = ("cloud", "surface_points", "surface_avoid", "surface_normals")
"""Fields with one row for each point of the object."""


class Packer:
    """Packs the queries of one episode. The fields that stay the same are written only once.

    Attributes:
      settle: largest distance (m) of a reading of the resting object's pose from the mean of the
        earlier ones, see `SensingConfig.settle`; 0 if the policy uses the first pose instead.
    """

    def __init__(
        self,
        layout: Mapping[str, Any],
        episode: Mapping[str, np.ndarray],
        constraints: Mapping[str, Mapping[str, ArrayLike]],
    ):
        """Writes the fields that stay the same during the episode.

        Args:
          layout: `query` of the policy's metadata (`services.serve.requests.Layout.description`).
            Its `fields` have the form name -> [offset in the vector, *shape].
          episode: fields that stay the same.
          constraints: goal arrays of each constraint. Those of a constraint that the policy lacks
            are not packed: the policy refuses its name.

        Raises:
          RefusedError: a field is unknown, absent, of the wrong shape or in another unit.
        """
        self.settle = float(layout["settle"])
        self._max_states = layout["states"]
        self._fields = layout["fields"]
        self._history_lengths: dict[str, int] = {}
        for name in HISTORY_FIELDS:
            if f"past_{name}" in self._fields:
                _offset, length, *_shape = self._fields[f"past_{name}"]
                self._history_lengths[name] = length
        needs = layout["constraints"]
        supported = [name for name in constraints if name in needs]
        goals: dict[str, Any] = {}
        for name in supported:
            for array, value in constraints[name].items():
                goals[f"{name}_{array}"] = value
        fields = {**episode, **checked(goals)}
        for name in supported:
            require(needs[name], fields)
        self._meta = {"constraints": list(constraints), "layout": layout["digest"]}
        self._vector = np.zeros(layout["size"], np.float32)
        self._write(self._vector, fields)

    def pack(self, states: Sequence[State], past: Sequence[State] = ()) -> Message:
        """Packs several states into one query.

        Args:
          states: at most 64; each has the fields `MEASURED` that are in the layout.
          past: earlier control steps with the fields `HISTORY_FIELDS`, newest first. The oldest is
            repeated if a policy observes more steps. If there is none, the state itself is
            repeated, which then needs these fields, too.

        Returns:
          One array (n, S) float32, a row for each state.

        Raises:
          RefusedError: there are too many states, or a field is unknown, absent, of the wrong shape
            or in another unit.
        """
        if len(states) > self._max_states:
            raise RefusedError(
                f"The query has {len(states)} states.",
                f"Pass at most {self._max_states} states at a time.",
            )
        vectors = np.tile(self._vector, (len(states), 1))
        required = [name for name in MEASURED if name in self._fields]
        for vector, state in zip(vectors, states, strict=True):
            require(required, state)
            self._write(vector, checked(state))
            steps = past or [state]  # the first step of an episode has no earlier ones
            self._write(vector, self._past_fields(steps))
        return Message({PACKED_ARRAY: vectors}, self._meta)

    def _past_fields(self, steps: Sequence[State]) -> dict[str, np.ndarray]:
        """Fields `past_*` (history length, ...) of earlier control steps, newest first. The oldest
        step is repeated if there are too few.
        """
        fields = {}
        for name, length in self._history_lengths.items():
            rows = [as_numbers(name, step[name]) for step in steps[:length]]
            rows += rows[-1:] * (length - len(rows))
            fields[f"past_{name}"] = np.stack(rows)
        return fields

    def _write(self, vector: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Writes fields to their places in a vector. Points are resampled to the number that the
        policy observes: they are taken at even distances in their order, or repeated.

        Raises:
          RefusedError: a field is unknown or of the wrong shape.
        """
        point_count = _point_count(fields)
        for name, value in fields.items():
            if name not in self._fields:
                # A policy without normals ignores them and the camera, which is only for normals
                if name in (NORMALS, CAMERA):
                    continue
                raise RefusedError(
                    f"The query has an unknown field '{name}'.",
                    f"Choose from: {', '.join(self._fields)}.",
                )
            offset, *lengths = self._fields[name]
            shape = tuple(lengths)
            expected = shape
            if name in _POINT_FIELDS and point_count is not None:
                expected = (point_count, *shape[1:])
            if value.shape != expected:
                raise RefusedError(
                    f"The field '{name}' has shape {value.shape}; it must be {expected}."
                )
            if expected != shape:
                value = value[np.arange(shape[0]) * len(value) // shape[0]]
            vector[offset : offset + math.prod(shape)] = value.ravel()


def _point_count(fields: Mapping[str, np.ndarray]) -> int | None:
    """Number of rows, at least 1, that all point fields must have: that of the first. None if there
    is no point field, or if the first is a scalar.
    """
    for name in _POINT_FIELDS:
        if name in fields:
            first = fields[name]
            return max(len(first), 1) if first.ndim else None
    return None
