"""The actor process: pulls weights, steps environments, uploads rollouts, until the run ends."""

import concurrent.futures
import dataclasses
import pathlib
import threading
import time
import zlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.env_state import EnvState
from congrasp.actors.episode import EpisodeFacts, traced_episode
from congrasp.actors.failure_weights import FailureWeights
from congrasp.actors.follower import Follower, TracedEpisode
from congrasp.actors.link import (
    ActorLink,
    OpenJournal,
    RunFinished,
    RunInfo,
    RunRestarted,
    Ticket,
)
from congrasp.actors.physics import make_physics, prepare_physics
from congrasp.actors.references_file import save_references, with_saved_references
from congrasp.actors.rollout import Rollout, finished_episodes
from congrasp.actors.training_set import TrainingSet, training_set
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import RunConfig, run_config_from_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.named_inputs import COPY, OF_ACTORS, check_inputs
from congrasp.common.policy.bundle import PolicyBundle, PolicySpec, acting, policy_spec
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.stages import stage
from congrasp.common.task.constraints import draws_references
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.types import Array
from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import Message, finite
from congrasp.common.wire.messages import PRIVILEGED, RECORDABLE, TAUGHT

COMPLETE = "the run is complete"
STOPPED = "stopped"
_TICKET_TIMEOUT_S = 1.0
"""Wait for a ticket, after which a stop is noticed."""
_FLUSH_TIMEOUT_S = 2.0
"""Wait at the end of the run for the outcomes of rollouts."""
_SAVE_INTERVAL_S = 60.0
"""Time between two writes of the reference poses from the policy's grasps."""


@dataclasses.dataclass(frozen=True)
class ActorOptions:
    """Options of an actor, apart from the configuration that it gets from the learner."""

    run: str
    """Name of the run."""
    actor: str
    """This actor's name, unique in the run; it also determines the actor's objects and random
    numbers."""
    physics: PhysicsName | None = None
    """Engine; None for that of the run."""
    threads: int = 1
    """Threads of the `native` engine."""
    patience: float = 60.0
    """Seconds without a learner after which the actor gives up; infinite waits without end."""
    on_rollout: Callable[[dict[str, float]], None] = lambda values: None
    """Called with the metrics of every rollout, including its version."""
    journal: OpenJournal | None = None
    """See `ActorLink`."""
    references: pathlib.Path | None = None
    """File that preserves the reference poses from the policy's grasps across restarts."""


def run_actor(transport: Transport, options: ActorOptions, stop: threading.Event) -> str:
    """Acts for the learner of a run until the run ends or `stop` is set.

    Args:
      transport: transport connected to the learner.
      options: names of run and actor, and what differs between actors.
      stop: ends the actor between two rollouts.

    Returns:
      The reason of the end, as a phrase: `COMPLETE` or `STOPPED`.

    Raises:
      CongraspError: the learner is gone, or refuses this actor's rollouts; or a file or folder that
        the run names is missing here or has another content.
    """
    while not stop.is_set():
        try:
            return _act_until_restart(transport, options, stop)
        except RunRestarted:
            continue
    return STOPPED


def _act_until_restart(transport: Transport, options: ActorOptions, stop: threading.Event) -> str:
    """Acts for a learner process; see `run_actor`.

    Raises:
      RunRestarted: another process of the learner continues the run.
    """
    with ActorLink(
        transport,
        options.run,
        options.actor,
        patience=options.patience,
        journal=options.journal,
    ) as link:
        try:
            info = link.wait_for_config(stop)
            if info is None:
                return STOPPED
            config = run_config_from_json(info.config)
            check_inputs(config.inputs, OF_ACTORS, COPY)
            actor = _Actor(options, config, info, link, transport)
            actor.act(stop)
            link.flush(_FLUSH_TIMEOUT_S)
            return STOPPED
        except RunFinished:
            link.flush(_FLUSH_TIMEOUT_S)
            return COMPLETE


def first_environments(arrays: dict[str, Array], count: int) -> dict[str, np.ndarray]:
    """Returns the arrays of the first `count` environments of a rollout."""
    first = {}
    for name, array in arrays.items():
        leading = (slice(None),) * RECORDABLE[name].worlds_axis
        first[name] = np.asarray(array[(*leading, slice(count))])
    return first


def _check_versions(info: RunInfo, spec: PolicySpec) -> None:
    """Raises a CongraspError unless this actor records what the learner's algorithm needs, with its
    policies.
    """
    remedy = "Start the actor with the learner's version of congrasp."
    unknown = set(info.arrays) - RECORDABLE.keys()
    if unknown:
        raise CongraspError(
            f"The learner's algorithm needs arrays that actors do not record: "
            f"{', '.join(sorted(unknown))}.",
            remedy,
        )
    if spec.schema != info.schema:
        raise CongraspError(
            f"The learner's policies have the schema {info.schema}; this actor's have "
            f"{spec.schema}.",
            remedy,
        )


class _Actor:
    """Environments, policy and counters of one actor."""

    def __init__(
        self,
        options: ActorOptions,
        config: RunConfig,
        info: RunInfo,
        link: ActorLink,
        transport: Transport,
    ):
        self._config = config
        self._arrays = info.arrays
        self._link = link
        self._transport = transport
        self._hand = get_hand(config.task.hand)
        self._spec = policy_spec(config.task, config.network)
        _check_versions(info, self._spec)
        physics = options.physics or config.physics
        prepare_physics(physics, self._hand, config.task)
        self._number = zlib.crc32(link.actor.encode())
        self._own_references = config.task.own_references and draws_references(config.task)
        self._references = options.references if self._own_references else None
        self._saved = time.monotonic()
        training = training_set(self._hand, config, self._number)
        self._objects = training.objects
        with stage("engine"):
            self._physics = make_physics(
                physics, self._hand, config.task, self._objects, threads=options.threads
            )
        self._worker = self._new_worker()
        with concurrent.futures.ThreadPoolExecutor(1, "programs") as meanwhile:
            programs = meanwhile.submit(self._compile, training)
            bank = training.bank
            if self._references:
                bank = with_saved_references(self._references, self._hand, config.task, bank)
            programs.result()
        with stage("first episodes"):
            self._worker.start(bank)
        self._failures = self._failure_weights(bank)
        self._on_rollout = options.on_rollout
        self._bundle: PolicyBundle | None = None
        self._rollouts = 0
        self._next_episode = 0
        self._follower = Follower()

    def _new_worker(self) -> RolloutWorker:
        """Returns environments that record what the learner's algorithm needs."""
        config = self._config
        link = self._link
        is_taught = not TAUGHT.keys().isdisjoint(self._arrays)
        is_privileged = not PRIVILEGED.keys().isdisjoint(self._arrays)
        # Another incarnation must not repeat the episodes of the one it replaces.
        seed = zlib.crc32(f"{config.seed}/{link.actor}/{link.incarnation}".encode())
        return RolloutWorker(
            self._hand,
            config.task,
            self._physics,
            None,
            acting(self._spec.layout, mean=False),
            batch=config.environments,
            seed=seed,
            half_precision=config.half_observations,
            staggered=True,
            taught=is_taught,
            privileged=self._objects if is_privileged else (),
        )

    def _compile(self, training: TrainingSet) -> None:
        """Compiles the programs of a compiled engine's rollouts before the bank of the training set
        is built.
        """
        if self._physics.compiled:
            with stage("programs"):
                self._worker.compile(
                    training.form(), self._spec.inference_form, self._config.rollout_steps
                )

    def act(self, stop: threading.Event) -> None:
        """Produces rollouts until `stop` is set or the run ends."""
        try:
            self._warm_up(stop)
            requested_at = time.monotonic()
            while not stop.is_set():
                ticket = self._link.acquire_ticket(_TICKET_TIMEOUT_S)
                if ticket is None:
                    continue
                granted_at = time.monotonic()
                if not self._refresh(ticket.required_version):
                    self._link.give_back(ticket)
                    stop.wait(_TICKET_TIMEOUT_S)
                    continue
                assert self._bundle is not None
                self._rollout(self._bundle, ticket, _Since(requested_at, granted_at))
                requested_at = time.monotonic()
        finally:
            if self._references:
                save_references(self._references, self._worker.bank)
            self._physics.close()

    def _failure_weights(self, bank: ConstraintBank) -> FailureWeights | None:
        """Returns counters of the current objects, if the run draws objects by failure."""
        if not self._config.objects.by_failure:
            return None
        return FailureWeights(np.asarray(bank.weight), [obj.family for obj in self._objects])

    def _renew_objects(self) -> None:
        """Replaces all objects, and starts new episodes with them."""
        self._number += 1
        training = training_set(self._hand, self._config, self._number)
        bank = training.bank
        self._objects = training.objects
        self._worker.replace_objects(self._objects, bank)
        self._worker.restart()
        self._follower.forget()
        self._failures = self._failure_weights(bank)

    def _warm_up(self, stop: threading.Event) -> None:
        """Waits for the first policy, and compiles the programs around an engine that JAX cannot
        trace.

        This is before the first ticket is requested, so that its rollout is not stale when it is
        finished.
        """
        while not self._refresh():
            if stop.is_set():
                return
            # Waits for the learner, but not indefinitely
            ticket = self._link.acquire_ticket(_TICKET_TIMEOUT_S)
            if ticket is not None:
                self._link.give_back(ticket)
        assert self._bundle is not None
        self._configure(self._bundle.version)
        if self._physics.compiled:
            return
        with stage("programs"):
            # The second time, after a restart of environments, which is traced separately
            for _ in range(2):
                self._worker.collect(self._bundle.inference_parameters, self._config.rollout_steps)
                self._worker.restart()

    def _configure(self, version: int) -> None:
        """Sets the curriculum's weights and phase under the policy of this version."""
        config = self._config
        self._worker.configure(
            config.curriculum.weights(config.task.reward, version),
            stationary=config.curriculum.stationary(version),
        )

    def _refresh(self, required: int | None = None) -> bool:
        """Fetches the newest policy, or one that is not older than a ticket requires if newer ones
        take long; returns True if there is any.
        """
        version = -1 if self._bundle is None else self._bundle.version
        message = self._link.weights(version, required)
        if message is not None:
            bundle = PolicyBundle.from_message(message, "of the learner")
            self._spec.require(bundle.spec, "of the learner")
            self._bundle = bundle
        return self._bundle is not None

    def _rollout(self, bundle: PolicyBundle, ticket: Ticket, since: "_Since") -> None:
        """Produces a rollout under a ticket and uploads it, with metrics and logs."""
        config = self._config
        before = self._worker.state
        began = time.monotonic()
        self._configure(bundle.version)
        is_beginning = before is not None and bool(np.asarray(before.time)[0] == 0)
        with stage("first rollout"):
            rollout = jax.block_until_ready(
                self._worker.collect(bundle.inference_parameters, config.rollout_steps)
            )
        steps = config.rollout_steps * config.environments
        arrays = {name: getattr(rollout, name) for name in self._arrays}
        episodes, left_out = finite_episodes(finished_episodes(rollout, config.task))
        self._learn_from(episodes)
        meta = {"version": bundle.version, "schema": self._spec.schema, "steps": steps}
        collected = time.monotonic()
        self._link.upload(Message(arrays | episodes, meta), ticket)
        ended = time.monotonic()
        transport = began - since.granted + ended - collected
        values = {
            "steps_per_second": steps / (ended - began),
            "share/waiting": (since.granted - since.asked) / (ended - since.asked),
            "share/transport": transport / (ended - since.asked),
            "rollouts": self._rollouts + 1.0,
            "episodes_left_out": float(left_out),
            **buffer_occupancy(np.asarray(rollout.occupancy)),
        }
        if self._failures is not None:
            values |= self._failures.metrics()
        self._publish(
            "metrics",
            Message({}, {"time": time.time(), "version": bundle.version, "values": values}),
        )
        self._on_rollout({"version": float(bundle.version), **values})
        self._follow(bundle, rollout, before if is_beginning else None)
        if config.log_rollout_every and self._rollouts % config.log_rollout_every == 0:
            self._publish("rollout", self._sample_of_rollout(bundle, arrays))
        self._rollouts += 1
        if config.objects.renew_every and self._rollouts % config.objects.renew_every == 0:
            self._renew_objects()

    def _learn_from(self, episodes: dict[str, np.ndarray]) -> None:
        """Updates references and sampling weights by the finished episodes of a rollout."""
        if self._own_references:
            self._worker.renew_references()
            if self._references and time.monotonic() - self._saved > _SAVE_INTERVAL_S:
                save_references(self._references, self._worker.bank)
                self._saved = time.monotonic()
        if self._failures is not None:
            self._failures.add(episodes["episode/object_index"], episodes["episode/held"])
            self._worker.weigh_objects(self._failures.weights)

    def _follow(self, bundle: PolicyBundle, rollout: Rollout, before: EnvState | None) -> None:
        """Publishes the followed episode of environment 0 if it ends in the rollout; `before` as in
        `Follower.add`.
        """
        after = self._worker.state
        assert after is not None
        due = self._rollouts >= self._next_episode
        episode = self._follower.add(rollout.trace, before, after, due=due)
        if episode is None:
            return
        self._publish_episode(bundle, rollout, episode)
        self._next_episode = self._rollouts + self._config.episode_every

    def _sample_of_rollout(self, bundle: PolicyBundle, arrays: dict[str, Array]) -> Message:
        """Returns a rollout's first environments, with the metadata that a reader needs to parse
        the arrays.
        """
        meta = {
            "time": time.time(),
            "version": bundle.version,
            "actor": self._link.actor,
            "rollout": self._rollouts,
            "hand": self._hand.name,
            "control_dt": self._config.task.control_dt,
            "layout": [[name, size] for name, size in self._spec.layout],
            "environments": self._config.environments,
        }
        count = self._config.log_rollout_worlds or self._config.environments
        return Message(first_environments(arrays, count), meta)

    def _publish_episode(
        self, bundle: PolicyBundle, rollout: Rollout, episode: TracedEpisode
    ) -> None:
        """Publishes the episode of environment 0."""
        row = np.asarray(rollout.episodes)[0]
        metrics = {}
        for name, value in zip(episode_fields(self._config.task), row, strict=True):
            if "episode/" in name:
                metrics[name.removeprefix("episode/")] = float(value)
        obj = self._objects[episode.object_index]
        origin = {
            "time": time.time(),
            "version": bundle.version,
            "actor": self._link.actor,
        }
        facts = EpisodeFacts(metrics["success"] > 0, metrics, origin)
        traced = traced_episode(
            self._hand, self._config.task, episode.trace, episode.goal, episode.surface, obj, facts
        )
        self._publish("episode", traced.to_message())

    def _publish(self, kind: str, message: Message) -> None:
        """Publishes a message for logs under this actor's name."""
        # JSON has no NaN: one such number would make the whole message invalid.
        message = Message(message.arrays, finite(message.meta))
        self._transport.publish(self._link.keys.log(kind, "actor", self._link.actor), message)


class _Since(NamedTuple):
    """Times of one rollout, on the monotonic clock."""

    asked: float
    """Time at which the actor requested a ticket."""
    granted: float
    """Time at which it received one and continued with the newest weights."""


def buffer_occupancy(occupancy: np.ndarray) -> dict[str, float]:
    """Metrics of `Rollout.occupancy`: steps that exceeded contacts or rows, the fullest, and
    unconverged solutions.
    """
    buffers = occupancy[:, :2]
    limited = occupancy[:, 2]
    contacts, rows = buffers.max(0)
    return {
        "overflow": float((buffers > 1.0).any(-1).sum()),
        "contacts_peak": float(contacts),
        "rows_peak": float(rows),
        "solver_limited": float(limited.mean()),
    }


def finite_episodes(episodes: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """Returns the episodes with finite metrics (E,), and the number of others, which the learner
    would reject.
    """
    finite = np.isfinite(np.stack(list(episodes.values()))).all(0)
    selected = {name: values[finite] for name, values in episodes.items()}
    return selected, int((~finite).sum())
