"""The arrays of a rollout: names, dtypes and shapes in symbols, spelled once for everyone who makes or takes them.

Actors can record `RECORDABLE`; the learner's algorithm names those that it learns from, and the learner tells them.
From these specs and a run's sizes (`RolloutForm`) follow what is sent, what is admitted, what a batch looks like, and
along which axis it is divided among ranks.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

WORLDS = "B"
"""Symbol of the axis of a rollout's worlds, along which rollouts are laid side by side in a batch."""


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """One array of a message."""

    dtypes: tuple[str, ...]
    """Names of the dtypes that it may have, the narrowest first."""
    shape: tuple[str | int, ...] | None
    """Sizes and symbols; None admits any shape."""
    optional: bool = False
    """Whether the array may be absent."""

    @property
    def worlds_axis(self) -> int:
        """The axis of the worlds."""
        assert self.shape is not None
        return self.shape.index(WORLDS)


Schema = Mapping[str, ArraySpec]
"""Arrays by name; their shapes are made of T control steps, B worlds, D observation and A action sizes, P of the
critic's privileged inputs, and S of the observation of a policy that sees all."""

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
"""What actors record of any rollout (`actors.rollout.Rollout`)."""
PRIVILEGED: Schema = {
    "privileged": ArraySpec(_OBSERVATION, ("T", "B", "P")),
    "last_privileged": ArraySpec(_OBSERVATION, ("B", "P")),
}
"""What they record in addition for a critic with privileged inputs (`common.task.privileged`)."""
TAUGHT: Schema = {"teacher_observation": ArraySpec(_OBSERVATION, ("T", "B", "S"))}
"""What they record in addition where there is a teacher, to ask it with (`common.task.teaching`)."""
RECORDABLE: Schema = {**RECORDED, **PRIVILEGED, **TAUGHT}
"""All of these."""


@dataclasses.dataclass(frozen=True)
class RolloutForm:
    """What the rollouts of one run have in common, so that any of them make a batch without another compilation."""

    steps: int
    """T."""
    worlds: int
    """B."""
    observation: int
    """D."""
    action: int
    """A."""
    half: bool
    """Observations are float16, or else float32."""
    teacher: int = 0
    """S."""
    privileged: int = 0
    """P."""
    arrays: Schema = dataclasses.field(default_factory=lambda: RECORDED)
    """The arrays that the run's algorithm learns from."""

    @property
    def sizes(self) -> dict[str, int]:
        """Values of the symbols."""
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
        """The arrays with the one dtype that each has in this run."""
        return {
            name: dataclasses.replace(spec, dtypes=(spec.dtypes[0 if self.half else -1],))
            for name, spec in self.arrays.items()
        }

    def zeros(self, rollouts: int = 1) -> dict[str, np.ndarray]:
        """The arrays of so many rollouts side by side, all zeros."""
        sizes = {**self.sizes, WORLDS: self.worlds * rollouts}

        def zeros(spec: ArraySpec) -> np.ndarray:
            shape = [sizes[size] if isinstance(size, str) else size for size in spec.shape or ()]
            return np.zeros(shape, spec.dtypes[0])

        return {name: zeros(spec) for name, spec in self.specs.items()}
