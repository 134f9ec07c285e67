"""Arrays of a rollout: names, dtypes and symbolic shapes, defined once for all producers and consumers.

Actors can record `RECORDABLE`; the learner's algorithm selects the arrays it learns from, and the learner sends that
selection to the actors. These specs and a run's sizes (`RolloutForm`) determine what is sent, what is admitted, the
layout of a batch, and the axis along which it is sharded over ranks.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

WORLDS = "B"
"""Symbol of the axis of a rollout's worlds, along which rollouts are concatenated in a batch."""


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
"""Arrays by name; their shapes consist of T control steps, B worlds, D observation and A action sizes, P privileged
inputs of the critic, and S inputs of a teacher (`common.task.privileged`)."""

F32 = ("float32",)
_OBSERVATION = ("float16", "float32")

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
