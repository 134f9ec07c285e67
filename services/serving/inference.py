"""The policy as one compiled function from a batch of flat queries to joint targets."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from common.config import TaskConfig
from common.constraints.priority import Request, explain, resolve
from common.errors import CongraspError
from common.hands.spec import Hand
from common.policy.bundle import Acting, mean_action
from common.task import control, observation
from common.task.features import features
from common.task.types import MASKS, Goal, SceneState, Surface
from services.serving.requests import Layout, Query

BATCH_SIZES = (1, 8, 64)
"""Batches are padded to one of these, so that nothing compiles after the warm-up."""


class Answer(NamedTuple):
    """What the policy says to one query."""

    vector: np.ndarray
    """(A + F + 6,): the policy's mean action in units of action, finger targets (rad), wrist targets (m and rad)."""
    words: tuple[str, ...]
    """Which constraints are active, and why."""


class PolicyFunction:
    """The policy of one hand and task, for any weights.

    Attributes:
      layout: how queries are laid out.
    """

    def __init__(self, hand: Hand, task: TaskConfig):
        self.layout = Layout(hand, task)
        # Waking other threads costs a CPU more than they save here.
        alone = {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else None
        self._compiled = jax.jit(self._infer, compiler_options=alone)

    def warm_up(self, weights: Acting) -> None:
        """Compiles every batch size."""
        for size in BATCH_SIZES:
            jax.block_until_ready(self._compiled(weights, np.zeros((size, self.layout.size), np.float32)))

    def __call__(self, weights: Acting, queries: Sequence[Query]) -> list[Answer | Exception]:
        """Answers at most `BATCH_SIZES[-1]` queries; a query that cannot be answered gets its own error."""
        count = len(queries)
        batch = np.zeros((next(size for size in BATCH_SIZES if size >= count), self.layout.size), np.float32)
        batch[:count] = [query.vector for query in queries]
        vectors, notes, checks = (np.asarray(part)[:count] for part in self._compiled(weights, batch))
        return [self._answer(*each) for each in zip(queries, vectors, notes, checks, strict=True)]

    def _infer(self, weights: Acting, vectors: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """For queries (B, S): answers (B, A + F + 6), the flags redirected and aligned (B, 2), and checks (B, C)."""
        hand, task = self.layout.hand, self.layout.task
        fields, checks = self.layout.complete(vectors)
        flags = {name: fields[name] > 0.5 for name in ("contact_found", "table", "surface_minus", "asked")}
        state = SceneState(**{name: {**fields, **flags}[name] for name in SceneState._fields})
        surface = Surface(fields["surface_points"], flags["surface_minus"])
        mask = jnp.zeros((len(vectors), len(MASKS)))
        asked = Goal(**{name: mask if name == "mask" else fields[name] for name in Goal._fields})
        resolution = resolve(hand, surface, Request(asked, *jnp.moveaxis(flags["asked"][:, 1:], -1, 0)))
        seen = features(hand, task, state, surface, resolution.goal)
        observed = observation.observe(task, state, seen, resolution.goal)
        mean = mean_action(observation.layout(hand, task), weights, observed)
        action = control.decode(hand, task.control, state, seen, resolution.goal, mean)
        notes = jnp.stack([resolution.redirected, resolution.aligned], -1)
        return jnp.concatenate([mean, action.q_target, action.u_target], -1), notes, checks

    def _answer(self, query: Query, vector: np.ndarray, notes: np.ndarray, checks: np.ndarray) -> Answer | Exception:
        redirected, aligned = notes
        if complaint := self.layout.complaint(query, checks):
            return complaint
        if not np.isfinite(vector).all():
            return CongraspError("The policy's answer to this query is not finite.", "Check the state's magnitudes.")
        if not aligned:
            return CongraspError(
                "The constraints contradict each other: the trajectory ends nearer to O- than to O+ of the affordance.",
                "Change the trajectory or the affordance.",
            )
        asked = {name: name in query.asked for name in ("affordance", "pose", "trajectory")}
        return Answer(vector, tuple(explain(**asked, redirected=bool(redirected))))
