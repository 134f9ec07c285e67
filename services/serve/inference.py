"""The policy as one compiled function from a batch of flat queries to joint targets, for a server
and this process.
"""

import functools
import itertools
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.errors import CongraspError, ContradictionError, error_of
from congrasp.common.hands import get_hand, right_name
from congrasp.common.hands.spec import Hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import InferenceParameters, PolicyBundle, mean_action
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task import control, observation
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints.priority import explain, resolve
from congrasp.common.task.features import scene_of
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.types import SceneState
from congrasp.common.wire.codec import Message
from congrasp.services.client.episode_policy import EpisodePolicy
from congrasp.services.client.left_policy import LeftPolicy
from congrasp.services.client.limits import JointLimits
from congrasp.services.client.packer import PACKED_ARRAY
from congrasp.services.client.policy import Policy
from congrasp.services.serve.requests import STATES_LIMIT, Layout, Query

BATCH_SIZES = (1, 4, 16, STATES_LIMIT)
"""Batches are padded to one of these sizes, so that nothing compiles after the warm-up."""


class Inference(NamedTuple):
    """Reply of the policy to a query of n states."""

    vectors: np.ndarray
    """(n, A + F + 6): the policy's mean action in units of action, finger targets (rad), wrist
    targets (m and rad).
    """
    active: list[list[str]]
    """For each state, the active constraints and the reasons, in sentences."""

    def reply(self, meta: Mapping[str, Any]) -> Message:
        """Returns it as a message with further metadata, at least `version` and `total_ms`."""
        return Message({PACKED_ARRAY: self.vectors}, {**meta, "active": self.active})


class _Outputs(NamedTuple):
    """Result of the compiled function for n states."""

    vectors: np.ndarray
    """(n, A + F + 6), see `Inference`."""
    redirected: np.ndarray
    """(n,): 1 where the constraints were redirected, else 0."""
    aligned: np.ndarray
    """(n,): 0 where the constraints contradict each other, else 1."""
    checks: np.ndarray
    """(n, C): see `Layout.complete`."""


class PolicyFunction:
    """The policy of one hand and task, for any weights.

    Attributes:
      layout: layout of queries.
    """

    def __init__(self, hand: Hand, task: TaskConfig):
        self.layout = Layout(hand, task)
        self._compiled = _compiled(hand, task)

    def warm_up(
        self, weights: InferenceParameters, sizes: Sequence[int] = BATCH_SIZES
    ) -> dict[int, float]:
        """Compiles batches of these sizes; returns the seconds that one of each takes from then
        on.
        """
        self.layout.estimate_normals(np.zeros((1, self.layout.size), np.float32))
        seconds = {}
        for size in sizes:
            batch = np.zeros((size, self.layout.size), np.float32)
            for _ in range(2):
                began = time.perf_counter()
                jax.block_until_ready(self._compiled(weights, batch))
                seconds[size] = time.perf_counter() - began
        return seconds

    def __call__(
        self, weights: InferenceParameters, queries: Sequence[Query]
    ) -> list[Inference | Exception]:
        """Answers queries of at most `BATCH_SIZES[-1]` states; an invalid query gets an error."""
        ends = list(itertools.accumulate(len(query.vectors) for query in queries))
        states = ends[-1]
        padded = next(size for size in BATCH_SIZES if size >= states)
        batch = np.zeros((padded, self.layout.size), np.float32)
        np.concatenate([query.vectors for query in queries], out=batch[:states])
        self.layout.estimate_normals(batch[:states])
        outputs = self._outputs(np.asarray(self._compiled(weights, batch))[:states])
        is_faultless = self._are_faultless(outputs)
        answers: list[Inference | Exception] = []
        for query, end in zip(queries, ends, strict=True):
            rows = slice(end - len(query.vectors), end)
            query_outputs = _Outputs(
                vectors=outputs.vectors[rows],
                redirected=outputs.redirected[rows],
                aligned=outputs.aligned[rows],
                checks=outputs.checks[rows],
            )
            error = None if is_faultless else self._find_error(query, query_outputs)
            answers.append(error or _inference(query, query_outputs))
        return answers

    def _outputs(self, values: np.ndarray) -> _Outputs:
        """Splits the rows (n, ...) that the compiled function returns."""
        hand = self.layout.hand
        size = len(hand.motors) + len(hand.joints) + 12
        return _Outputs(
            vectors=values[:, :size],
            redirected=values[:, size],
            aligned=values[:, size + 1],
            checks=values[:, size + 2 :],
        )

    def _are_faultless(self, outputs: _Outputs) -> bool:
        """True if no query of a batch gets an error."""
        return bool(
            self.layout.pass_all(outputs.checks)
            and np.isfinite(outputs.vectors).all()
            and outputs.aligned.all()
        )

    def _find_error(self, query: Query, outputs: _Outputs) -> CongraspError | None:
        """Error of one query; None without one."""
        if error := self.layout.find_error(query, outputs.checks):
            return error
        if not np.isfinite(outputs.vectors).all():
            return CongraspError(
                "The policy's action for this query is not finite.", "Check the state's magnitudes."
            )
        if not outputs.aligned.all():
            return ContradictionError(
                "The constraints contradict each other: the trajectory ends nearer to the avoid "
                "region than to the graspable region of the affordance.",
                "Change the trajectory or the affordance.",
            )
        return None

    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`, as JSON."""
        hand = self.layout.hand
        task = self.layout.task
        limits = None
        if len(hand.motors) == len(hand.joints):
            limits = JointLimits.of_hand(hand, task.control).as_lists()
        return {
            "hand": hand.name,
            "joints": [joint.name for joint in hand.joints],
            "open_pose": hand.q_open.tolist(),
            "limits": limits,
            "period": task.control_dt,
            "approach_steps": task.approach_steps,
            "observation": task.observation,
            "constraints": [constraint.name for constraint in self.layout.known],
            "surface_points": task.surface_points,
            "trajectory_points": task.trajectory_points,
            "query": {**self.layout.description(), "digest": self.layout.digest},
        }


def _inference(query: Query, outputs: _Outputs) -> Inference:
    """Answer to one query without an error."""
    active = []
    for redirected in outputs.redirected.tolist():
        active.append(list(_reasons(query.asked, redirected > 0)))
    return Inference(outputs.vectors, active)


@functools.lru_cache(maxsize=1024)
def _reasons(asked: tuple[str, ...], redirected: bool) -> tuple[str, ...]:
    """Active constraints of a state and the reasons, in sentences."""
    return tuple(explain(asked, redirected=redirected))


@functools.lru_cache(maxsize=8)
def _compiled(hand: Hand, task: TaskConfig) -> Any:
    """Returns the program of the policies of a hand and task, which they share in a process."""
    options = None
    if jax.default_backend() == "cpu":
        # Waking other threads costs more CPU time than they save here.
        options = {"xla_cpu_multi_thread_eigen": False}
    return jax.jit(functools.partial(_infer, Layout(hand, task)), compiler_options=options)


def _infer(layout: Layout, weights: InferenceParameters, vectors: jax.Array) -> jax.Array:
    """For states (B, S): answers (A + F + 6), flags redirected and aligned, and checks (C), as one
    array (B, ...).
    """
    hand = layout.hand
    task = layout.task
    fields, checks = layout.complete(vectors)
    requested: dict[str, jax.Array] = {}
    for index, constraint in enumerate(layout.known):
        if constraint.optional:
            requested[constraint.name] = fields["asked"][:, index] > 0.5
    surface = layout.surface(fields)
    resolution = resolve(hand, surface, layout.goal(fields), requested)
    state = SceneState(**{name: fields[name] for name in SceneState._fields})
    readings = layout.readings(fields)
    if readings is not None:
        state = get_sensor(task).seen(task, state, readings)
    scene = scene_of(hand, task, state, surface, resolution.goal, readings)
    scene = scene._replace(measured=layout.measured(fields))
    mean = mean_action(observation.layout(hand, task), weights, observation.observe(scene))
    action = control.decode(scene, task.control, mean)
    notes = jnp.stack([resolution.redirected, resolution.aligned], -1)
    return jnp.concatenate([mean, action.q_target, action.u_target, notes, checks], -1)


class LocalPolicy(EpisodePolicy):
    """The `Policy` of a bundle."""

    @compiling_entry
    def __init__(self, bundle: PolicyBundle):
        """Compiles `act`, so that no control step waits for it; `act_each` is compiled at its first
        call.

        Args:
          bundle: the policy, which determines the hand.
        """
        super().__init__()
        self._bundle = bundle
        self._function = PolicyFunction(get_hand(bundle.spec.hand), bundle.task)
        self._function.warm_up(bundle.inference_parameters, BATCH_SIZES[:1])

    @library_settings()
    def _fetch_metadata(self) -> dict[str, Any]:
        """The metadata of the bundle."""
        return self._function.metadata()

    @library_settings()
    def _query(self, query: Message) -> Message:
        """Returns the reply of a server with this bundle."""
        began = time.perf_counter()
        try:
            parsed = self._function.layout.parse(query)
            (answer,) = self._function(self._bundle.inference_parameters, [parsed])
            if isinstance(answer, Exception):
                raise answer
        except CongraspError as error:
            raise error_of(error.code, str(error)) from None
        total_ms = 1e3 * (time.perf_counter() - began)
        return answer.reply({"version": self._bundle.version, "total_ms": total_ms})


@compiling_entry
def load_policy(policy: str | os.PathLike[str] = "human") -> Policy:
    """Loads the policy of a file, or the pretrained one of a hand, in this process.

    Args:
      policy: a policy file (`policy.safetensors` in a run's folder), or the name of a hand
        (`human:left` for the left).

    Raises:
      CongraspError: there is no such file or hand, or the file is damaged.
    """
    right, left = right_name(str(policy))
    local = LocalPolicy(bundles.load(named_policy(right)))
    return LeftPolicy(local) if left else local
