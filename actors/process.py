"""The actor process: pulls weights, steps environments, uploads rollouts, until the run ends."""

import concurrent.futures
import pathlib
import threading
import time
import zlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.env import EnvState, episode_fields
from congrasp.actors.episode import episode_message
from congrasp.actors.harvest import save_references, with_kept_references
from congrasp.actors.link import (
    ActorLink,
    OpenJournal,
    RunFinished,
    RunInfo,
    RunRestarted,
    Ticket,
)
from congrasp.actors.physics import make_physics, prepare_physics
from congrasp.actors.rollout import Rollout, Trace, finished_episodes
from congrasp.actors.training_set import FailureWeights, TrainingSet, training_set
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import RunConfig, run_config_from_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.named_inputs import COPY, OF_ACTORS, check_inputs
from congrasp.common.policy.bundle import PolicyBundle, acting, policy_spec
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.stages import stage
from congrasp.common.task.constraints import draws_references
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.types import Array, Goal, Surface
from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import Message, finite
from congrasp.common.wire.messages import PRIVILEGED, RECORDABLE, TAUGHT


class Followed(NamedTuple):
    """An episode from its beginning."""

    goal: Goal
    """Goal and surface, without a batch axis."""
    surface: Surface
    object_index: int
    trace: Trace
    """Trace up to the episode's last step."""


class Follower:
    """Concatenates the traces of successive rollouts from the beginning of an episode on."""

    def __init__(self) -> None:
        """Creates an idle follower."""
        self._begun: Followed | None = None

    def forget(self) -> None:
        """Drops the followed episode, because the environments restart."""
        self._begun = None

    def add(
        self, trace: Trace, before: EnvState | None, after: EnvState, *, due: bool
    ) -> Followed | None:
        """Adds a rollout.

        Args:
          trace: (T, ...) trace of environment 0.
          before: the environments before the rollout, if environment 0 was at the beginning of an
            episode.
          after: the environments after the rollout.
          due: follows an episode that begins in the rollout, if none is being followed.

        Returns:
          The episode, once its last rollout arrives; None if a later episode ends in the same
          rollout, since the rollout only has metrics of its last one.
        """
        if self._begun is not None:
            parts = zip(self._begun.trace, trace, strict=True)
            self._begun = self._begun._replace(
                trace=Trace(*(np.concatenate([*fields]) for fields in parts))
            )
        elif due and before is not None:
            self._begun = _begun(before, trace, 0)
        elif (
            due
            and len(ends := np.flatnonzero(np.asarray(trace.terminal)))
            and ends[-1] + 1 < len(trace.terminal)
        ):
            self._begun = _begun(after, trace, int(ends[-1]) + 1)
        if self._begun is None or not len(ends := np.flatnonzero(self._begun.trace.terminal)):
            return None
        whole = self._begun._replace(
            trace=Trace(*(field[: ends[0] + 1] for field in self._begun.trace))
        )
        self._begun = None
        return whole if len(ends) == 1 else None


def _begun(state: EnvState, trace: Trace, first: int) -> Followed:
    """Returns an episode with the goal and object of a state, whose trace begins with step `first`
    of a rollout.
    """
    return Followed(
        state.goal.row(0),
        jax.tree.map(lambda array: np.asarray(array[0]), state.surface),
        int(np.asarray(state.reset_state.object_index[0])),
        Trace(*(np.asarray(field)[first:] for field in trace)),
    )


COMPLETE = "the run is complete"
STOPPED = "stopped"
_TICKET_SECONDS = 1.0
_FLUSH_SECONDS = 2.0
_SAVE_SECONDS = 60.0
"""Seconds between two writes of the reference poses from the policy's grasps."""


def run_actor(  # noqa: PLR0913
    transport: Transport,
    *,
    run: str,
    actor: str,
    stop: threading.Event,
    physics: PhysicsName | None = None,
    threads: int = 1,
    patience: float = 60.0,
    on_rollout: Callable[[dict[str, float]], None] = lambda values: None,
    journal: OpenJournal | None = None,
    references: pathlib.Path | None = None,
) -> str:
    """Acts for the learner of `run` until it ends or `stop` is set.

    Args:
      transport: transport connected to the learner.
      run: name of the run.
      actor: this actor's name, unique in the run; it also determines the actor's objects and random
        numbers.
      stop: ends the actor between two rollouts.
      physics: engine; that of the run by default.
      threads: threads of the `native` engine.
      patience: seconds without a learner after which the actor gives up; infinite waits without
        end.
      on_rollout: called with the metrics of every rollout, including its version.
      journal: see `ActorLink`.
      references: file that preserves the reference poses from the policy's grasps across restarts.

    Returns:
      The reason of the end, as a phrase: `COMPLETE` or `STOPPED`.

    Raises:
      CongraspError: the learner is gone, or refuses this actor's rollouts; or a file or folder that
        the run names is missing here or has another content.
    """
    while not stop.is_set():
        with ActorLink(transport, run, actor, patience=patience, journal=journal) as link:
            try:
                info = link.wait_for_config(stop)
                if info is None:
                    break
                config = run_config_from_json(info.config)
                check_inputs(config.inputs, OF_ACTORS, COPY)
                engine = physics or config.physics
                worker = _Actor(
                    config, info, link, transport, engine, threads, on_rollout, references
                )
                worker.act(stop)
                link.flush(_FLUSH_SECONDS)
                break
            except RunFinished:
                link.flush(_FLUSH_SECONDS)
                return COMPLETE
            except RunRestarted:
                continue
    return STOPPED


def first_environments(arrays: dict[str, Array], count: int) -> dict[str, np.ndarray]:
    """Returns the arrays of the first `count` environments of a rollout."""
    return {
        name: np.asarray(array[(slice(None),) * RECORDABLE[name].worlds_axis + (slice(count),)])
        for name, array in arrays.items()
    }


class _Actor:
    """Environments, policy and counters of one actor."""

    def __init__(  # noqa: PLR0913
        self,
        config: RunConfig,
        info: RunInfo,
        link: ActorLink,
        transport: Transport,
        physics: PhysicsName,
        threads: int,
        on_rollout: Callable[[dict[str, float]], None],
        references: pathlib.Path | None,
    ):
        arrays, remedy = info.arrays, "Start the actor with the learner's version of congrasp."
        if unknown := set(arrays) - RECORDABLE.keys():
            what = (
                f"The learner's algorithm needs arrays that actors do not record: "
                f"{', '.join(sorted(unknown))}."
            )
            raise CongraspError(what, remedy)
        self._config, self._arrays, self._link, self._transport = config, arrays, link, transport
        self._hand, self._spec = (
            get_hand(config.task.hand),
            policy_spec(config.task, config.network),
        )
        if self._spec.schema != info.schema:
            what = (
                f"The learner's policies have the schema {info.schema}; this actor's have "
                f"{self._spec.schema}."
            )
            raise CongraspError(what, remedy)
        prepare_physics(physics, self._hand, config.task)
        self._number = zlib.crc32(link.actor.encode())
        self._own_references = config.task.own_references and draws_references(config.task)
        self._references = references if self._own_references else None
        self._saved = time.monotonic()
        training = training_set(self._hand, config, self._number)
        self._objects = training.objects
        with stage("engine"):
            self._physics = make_physics(
                physics, self._hand, config.task, self._objects, threads=threads
            )
        self._worker = RolloutWorker(
            self._hand,
            config.task,
            self._physics,
            None,
            acting(self._spec.layout, mean=False),
            batch=config.environments,
            # Another incarnation must not repeat the episodes of the one it replaces.
            seed=zlib.crc32(f"{config.seed}/{link.actor}/{link.incarnation}".encode()),
            half_precision=config.half_observations,
            staggered=True,
            taught=not TAUGHT.keys().isdisjoint(arrays),
            privileged=() if PRIVILEGED.keys().isdisjoint(arrays) else self._objects,
        )
        with concurrent.futures.ThreadPoolExecutor(1, "programs") as meanwhile:
            programs = meanwhile.submit(self._compile, training)
            bank = training.bank
            if self._references:
                bank = with_kept_references(self._references, self._hand, config.task, bank)
            programs.result()
        with stage("first episodes"):
            self._worker.start(bank)
        self._failures = self._failure_weights(bank)
        self._on_rollout = on_rollout
        self._bundle: PolicyBundle | None = None
        self._rollouts = self._next_episode = 0
        self._follower = Follower()

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
            asked = time.monotonic()
            while not stop.is_set():
                ticket = self._link.acquire_ticket(_TICKET_SECONDS)
                if ticket is None:
                    continue
                granted = time.monotonic()
                if not self._refresh():
                    self._link.give_back(ticket)
                    stop.wait(_TICKET_SECONDS)
                    continue
                assert self._bundle is not None
                self._rollout(self._bundle, ticket, _Since(asked, granted))
                asked = time.monotonic()
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
        self._objects, bank = training.objects, training.bank
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
            if ticket := self._link.acquire_ticket(
                _TICKET_SECONDS
            ):  # waits for the learner, but not indefinitely
                self._link.give_back(ticket)
        assert self._bundle is not None
        self._configure(self._bundle.version)
        if self._physics.compiled:
            return
        with stage("programs"):
            for _ in range(
                2
            ):  # the second time, after a restart of environments, which is traced separately
                self._worker.collect(self._bundle.inference_parameters, self._config.rollout_steps)
                self._worker.restart()

    def _configure(self, version: int) -> None:
        """Sets the curriculum's weights and phase under the policy of this version."""
        config = self._config
        self._worker.configure(
            config.curriculum.weights(config.task.reward, version),
            stationary=config.curriculum.stationary(version),
        )

    def _refresh(self) -> bool:
        """Fetches the newest policy; returns True if there is any."""
        message = self._link.weights(-1 if self._bundle is None else self._bundle.version)
        if message is not None:
            bundle = PolicyBundle.from_message(message, "of the learner")
            self._spec.require(bundle.spec, "of the learner")
            self._bundle = bundle
        return self._bundle is not None

    def _rollout(self, bundle: PolicyBundle, ticket: Ticket, since: "_Since") -> None:
        """Produces a rollout under a ticket and uploads it, with metrics and logs."""
        config, before = self._config, self._worker.state
        began = time.monotonic()
        self._configure(bundle.version)
        started_fresh = before is not None and bool(np.asarray(before.time)[0] == 0)
        with stage("first rollout"):
            rollout = jax.block_until_ready(
                self._worker.collect(bundle.inference_parameters, config.rollout_steps)
            )
        steps = config.rollout_steps * config.environments
        taken = {name: getattr(rollout, name) for name in self._arrays}
        episodes, left_out = countable(finished_episodes(rollout, config.task))
        arrays = taken | episodes
        if self._own_references:
            self._worker.renew_references()
            if self._references and time.monotonic() - self._saved > _SAVE_SECONDS:
                save_references(self._references, self._worker.bank)
                self._saved = time.monotonic()
        if self._failures is not None:
            self._failures.add(episodes["episode/object_index"], episodes["episode/held"])
            self._worker.weigh_objects(self._failures.weights)
        meta = {"version": bundle.version, "schema": self._spec.schema, "steps": steps}
        collected = time.monotonic()
        self._link.upload(Message(arrays, meta), ticket)
        ended = time.monotonic()
        values = {
            "steps_per_second": steps / (ended - began),
            "share/waiting": (since.granted - since.asked) / (ended - since.asked),
            "share/transport": (began - since.granted + ended - collected) / (ended - since.asked),
            "rollouts": self._rollouts + 1.0,
            "episodes_left_out": float(left_out),
            **buffer_occupancy(np.asarray(rollout.occupancy)),
            **(self._failures.metrics() if self._failures is not None else {}),
        }
        self._publish(
            "metrics",
            Message({}, {"time": time.time(), "version": bundle.version, "values": values}),
        )
        self._on_rollout({"version": float(bundle.version), **values})
        due, after = self._rollouts >= self._next_episode, self._worker.state
        assert after is not None
        if episode := self._follower.add(
            rollout.trace, before if started_fresh else None, after, due=due
        ):
            self._publish_episode(bundle, rollout, episode)
            self._next_episode = self._rollouts + config.episode_every
        if config.log_rollout_every and self._rollouts % config.log_rollout_every == 0:
            self._publish("rollout", self._sampled(bundle, taken))
        self._rollouts += 1
        if config.objects.renew_every and self._rollouts % config.objects.renew_every == 0:
            self._renew_objects()

    def _sampled(self, bundle: PolicyBundle, arrays: dict[str, Array]) -> Message:
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
        return Message(
            first_environments(
                arrays, self._config.log_rollout_worlds or self._config.environments
            ),
            meta,
        )

    def _publish_episode(self, bundle: PolicyBundle, rollout: Rollout, episode: Followed) -> None:
        """Publishes the episode of environment 0."""
        episodes = dict(
            zip(episode_fields(self._config.task), np.asarray(rollout.episodes)[0], strict=True)
        )
        metrics = {
            name.removeprefix("episode/"): float(v)
            for name, v in episodes.items()
            if "episode/" in name
        }
        obj = self._objects[episode.object_index]
        meta = {
            "time": time.time(),
            "version": bundle.version,
            "actor": self._link.actor,
            "success": metrics["success"] > 0,
            "metrics": metrics,
        }
        message = episode_message(
            self._hand, self._config.task, episode.trace, episode.goal, episode.surface, obj, meta
        )
        self._publish("episode", message)

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
    buffers, limited = occupancy[:, :2], occupancy[:, 2]
    contacts, rows = buffers.max(0)
    return {
        "overflow": float((buffers > 1.0).any(-1).sum()),
        "contacts_peak": float(contacts),
        "rows_peak": float(rows),
        "solver_limited": float(limited.mean()),
    }


def countable(episodes: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """Returns the episodes with finite metrics (E,), and the number of others, which the learner
    would reject.
    """
    fine = np.isfinite(np.stack(list(episodes.values()))).all(0)
    return {name: values[fine] for name, values in episodes.items()}, int((~fine).sum())
