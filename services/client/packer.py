"""Queries of an episode as vectors, in the layout that a policy's metadata describe; needs only
NumPy.
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


class Packer:
    """An episode's queries as vectors, most of which stays the same.

    Attributes:
      settle: m, see `SensingConfig`; 0 if the object's first pose is that of the request.
    """

    def __init__(
        self,
        layout: Mapping[str, Any],
        episode: Mapping[str, np.ndarray],
        constraints: Mapping[str, Mapping[str, ArrayLike]],
    ):
        """Begins an episode.

        Args:
          layout: `query` of the policy's metadata.
          episode: fields that stay the same.
          constraints: goal arrays of each constraint. Those of a constraint that the policy lacks
            are not packed: the policy refuses its name.

        Raises:
          RefusedError: a field is unknown, absent, of the wrong shape or in another unit.
        """
        self.settle = float(layout["settle"])
        self._max_states = layout["states"]
        self._fields = layout["fields"]
        self._history = {
            name: self._fields[f"past_{name}"][1]
            for name in HISTORY_FIELDS
            if f"past_{name}" in self._fields
        }
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
        """The query in each of several states, after the control steps of `past`, newest first.

        The oldest step is repeated where the history reaches back beyond the start of the episode.

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
            self._write(vector, self._earlier_steps(past or [state]))
        return Message({PACKED_ARRAY: vectors}, self._meta)

    def _earlier_steps(self, past: Sequence[State]) -> dict[str, np.ndarray]:
        """Fields (steps, ...) of earlier control steps, of which the oldest is repeated."""
        fields = {}
        for name, steps in self._history.items():
            rows = [as_numbers(name, reading[name]) for reading in past[:steps]]
            rows += rows[-1:] * (steps - len(rows))
            fields[f"past_{name}"] = np.stack(rows)
        return fields

    def _write(self, vector: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Writes fields to their places in a vector; points are spread over as many as the policy
        observes.
        """
        lengths = [fields[name].shape[:1] for name in _POINT_FIELDS if name in fields]
        points = lengths[0] if lengths else ()
        for name, value in fields.items():
            if name not in self._fields:
                if name in (NORMALS, CAMERA):  # the policy does not observe normals
                    continue
                raise RefusedError(
                    f"The query has an unknown field '{name}'.",
                    f"Choose from: {', '.join(self._fields)}.",
                )
            offset, *rest = self._fields[name]
            shape = tuple(rest)
            expected = shape
            if name in _POINT_FIELDS and points:
                expected = (max(*points, 1), *shape[1:])
            if value.shape != expected:
                raise RefusedError(
                    f"The field '{name}' has shape {value.shape}; it must be {expected}."
                )
            if expected != shape:
                value = value[np.arange(shape[0]) * len(value) // shape[0]]
            vector[offset : offset + math.prod(shape)] = value.ravel()
