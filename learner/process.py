"""The learner process: consumes rollouts, publishes policy bundles, and keeps a run directory to
resume from.

Several ranks (`learner.distributed`) train one policy, each with its own actors. The run directory
belongs to rank 0. The others receive configuration, state and versions from it, and write only
journals and failures. All are at the same update.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import pathlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from congrasp.common.config import RunConfig, to_json
from congrasp.common.errors import CongraspError, PhysicsError, TransportError
from congrasp.common.io.files import write_atomically
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.stages import stage
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message, encode, finite
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.algorithms.protocol import (
    LearnedPolicy,
    NonFiniteUpdate,
    TrainState,
    collate,
    rollout_form,
)
from congrasp.learner.checkpoint import Checkpoints, checksum, flatten, restore
from congrasp.learner.distributed.ranks import Ranks, ended_by
from congrasp.learner.hub.admission import Admission, task_ranges
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.limits import Events
from congrasp.learner.hub.queue import RolloutQueue
from congrasp.learner.hub.staleness import Counters, StalenessManager
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.hub.write_ahead import FOLDER, WriteAheadLog
from congrasp.learner.run_directory import (
    CHECKPOINTS,
    INITIAL_FILE,
    POLICY_FILE,
    config_checksum,
    exclusive,
    keep_policy,
    note_version,
    open_run,
    published_version,
    store_config,
)
from congrasp.learner.statistics import CollapseWatch, Pace, overall, summary

_POLL_SECONDS = 0.2
_STALL_SECONDS = 60.0
_SHUTDOWN_SECONDS = 3.0
_MOST_DROPPED = 5  # unusable batches in a row after which training fails
_COUNTERS = "counters and sequences of missing ranks are dropped, new ones start empty"

Notify = Callable[[str, str], None]
"""(level, text) of an event."""


class ReplicasDiffer(CongraspError):
    """The replicas of the weights differ between ranks."""


def run_learner(  # noqa: PLR0913
    run_dir: pathlib.Path,
    config: RunConfig,
    transport: Transport,
    *,
    stop_event: threading.Event,
    resume: bool = False,
    ranks: Ranks | None = None,
    audit: bool = True,
    on_host: bool = True,
    recorder: contextlib.AbstractContextManager[object] | None = None,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    on_event: Notify = lambda level, text: None,
) -> PolicyBundle:
    """Trains until `config.updates` updates are done or `stop_event` is set; returns the last
    policy.

    The run can be resumed in both cases and, after a crash, from its last checkpoint.

    Args:
      run_dir: created by `learner.run_directory.create_run`, if this is rank 0.
      config: the run, the same for all ranks; a resumed run may change settings that affect no
        array.
      transport: endpoint of the learner; the caller closes it.
      stop_event: ends training after the current update.
      resume: resumes from the newest intact checkpoint (of rank 0), which may come from any number
        of ranks.
      ranks: processes of the learner, if there are several.
      audit: writes the journal in `audit/`, if rollouts are on the host.
      on_host: rollouts are on the host, not on a device: accepted ones are written to `accepted/`,
        if configured.
      recorder: context entered while the learner runs, for example to write the run's logs.
      on_update: called with the metrics of every update.
      on_event: called with level and text of every event.

    Raises:
      CongraspError: the directory is not a run directory, or in use; the checkpoint does not match;
        the disk is full; a thread of this process died; training collapsed; another rank ended the
        run.
      PhysicsError: several batches in a row had values that were not finite; state and last batch
        are in `failure/`.
    """
    ranks = ranks or Ranks()
    check_lock: Callable[[], None] = lambda: None  # noqa: E731  of other ranks
    try:
        with contextlib.ExitStack() as stack:
            if ranks.rank == 0:
                open_run(run_dir)
                check_lock = stack.enter_context(
                    exclusive(run_dir, functools.partial(on_event, "warning"))
                )
            deaths = stack.enter_context(_watch_threads())
            stack.enter_context(recorder or contextlib.nullcontext())
            records = _Records(audit and on_host, on_host)
            learner = _Learner(
                run_dir, config, transport, ranks, resume, records, on_event, check_lock
            )
            try:
                learner.train(stop_event, deaths, on_update)
            finally:
                learner.close()
            return learner.bundle()
    except BaseException as error:
        ranks.fail(error)
        raise


@contextlib.contextmanager
def _watch_threads() -> Iterator[list[str]]:
    """Collects exceptions that ended threads of this process, so that it does not continue without
    them.
    """
    deaths: list[str] = []
    previous = threading.excepthook

    def note(arguments: threading.ExceptHookArgs) -> None:
        previous(arguments)
        thread = arguments.thread.name if arguments.thread else "?"
        deaths.append(
            f"thread '{thread}' died of {arguments.exc_type.__name__}: {arguments.exc_value}"
        )

    threading.excepthook = note
    try:
        yield deaths
    finally:
        threading.excepthook = previous


class _Records(NamedTuple):
    """Records of rollouts in the run's directory."""

    journal: bool
    """The outcome of every rollout."""
    accepted: bool
    """Accepted rollouts that no checkpoint holds yet."""


class _Learner:
    """State of one run between two updates."""

    def __init__(  # noqa: PLR0913
        self,
        run_dir: pathlib.Path,
        config: RunConfig,
        transport: Transport,
        ranks: Ranks,
        resume: bool,
        records: "_Records",
        on_event: Notify,
        check_lock: Callable[[], None],
    ):
        self._check_lock = check_lock
        self._run_dir, self._config, self._transport, self._ranks = (
            run_dir,
            config,
            transport,
            ranks,
        )
        self._keys = Keys(config.name)

        def notify(level: str, text: str) -> None:
            with contextlib.suppress(OSError):  # standard output may be on a full disk
                on_event(level, text)

        name, staleness = str(ranks.rank), config.max_staleness
        events = Events(transport, config.name, name, notify)
        self._event = events.add
        self._spec = bundles.policy_spec(config.task, config.network)
        self._algorithm = make_algorithm(self._spec, config)
        self._form = rollout_form(config, self._spec, self._algorithm.batch_schema)
        self._checkpoints = Checkpoints(run_dir / CHECKPOINTS)
        self._state, meta = self._first_state(resume)
        self._dropped = self._dropped_in_a_row = 0
        self._saved, self._unsaved = self._state.version, 0
        self._run_id, self._skipped, hubs = meta["run_id"], meta["skipped"], meta["hubs"]
        log_error = functools.partial(self._event, "error")
        folder = run_dir / FOLDER / name
        # Computed meanwhile: the first rollout needs them.
        ranges = concurrent.futures.ThreadPoolExecutor(1, "ranges").submit(
            task_ranges, config.task, config.curriculum
        )
        self._rollouts = RolloutQueue(
            self._run_id,
            self._form,
            self._spec.schema,
            StalenessManager(staleness, config.rollouts_per_update),
            events,
            durable=_durable(hubs, ranks.rank),
            audit=AuditLog(run_dir, name, log_error) if records.journal else None,
            log=WriteAheadLog(folder, staleness, write=config.write_ahead, log_error=log_error)
            if records.accepted
            else None,
        )
        self._hub = LearnerHub(
            transport, self._rollouts, events, to_json(config), Admission(ranges.result)
        )
        self._is_new = not hubs
        if hubs and len(hubs) != ranks.count:
            self._event(
                "warning",
                f"The checkpoint has {len(hubs)} rank(s), this run has {ranks.count}: {_COUNTERS}.",
            )

    def _first_state(self, resume: bool) -> tuple[TrainState, dict[str, Any]]:
        """Returns the initial state and a checkpoint's metadata, those of rank 0 for all ranks."""
        ranks, config = self._ranks, self._config
        initial = None
        if ranks.rank == 0 and not resume and (self._run_dir / INITIAL_FILE).exists():
            given = bundles.load(self._run_dir / INITIAL_FILE)
            initial = LearnedPolicy(given.params, given.observation, given.value, given.privileged)
        state = self._algorithm.init(config.seed, initial)
        meta: dict[str, Any] = {"run_id": secrets.token_hex(8), "skipped": 0, "hubs": []}
        if ranks.rank == 0:
            newest = self._checkpoints.newest()
            if resume:
                state, meta = self._checkpoints.load(state, self._event)
                keep_policy(self._run_dir, state.version + meta["skipped"], self._event)
                store_config(self._run_dir, config)
            elif newest >= 0:
                raise CongraspError(
                    f"{self._run_dir} has checkpoints of a run.",
                    "Pass --resume to continue it, or another --run-dir.",
                )
            version, newest = state.version + meta["skipped"], newest + meta["skipped"]
            meta = {**meta, "skipped": self._skip_lost_versions(version, newest) + meta["skipped"]}
        if ranks.count > 1:
            message = ranks.exchange(meta, flatten(state) if ranks.rank == 0 else None)
            state, meta = (
                restore(message.arrays, state, "The state of rank 0"),
                message.meta["entries"][0],
            )
        return state, meta

    def close(self) -> None:
        """Saves pending records; the transport stays open."""
        self._rollouts.close()

    @property
    def version(self) -> int:
        """Version of the newest policy."""
        return self._state.version + self._skipped

    def bundle(self) -> PolicyBundle:
        """Bundle of the newest policy."""
        policy = self._algorithm.policy(self._state)
        return PolicyBundle(
            spec=self._spec,
            task=self._config.task,
            version=self.version,
            run_id=self._run_id,
            transitions=self._state.transitions,
            **policy._asdict(),
        )

    def train(  # noqa: C901
        self,
        stop: threading.Event,
        deaths: list[str],
        on_update: Callable[[dict[str, float]], None],
    ) -> None:
        """Updates until the end, a stop, or a thread's death; writes a checkpoint in each case."""
        if (
            self._is_new
        ):  # before any rollout is accepted, so that a resume can recover what a kill undoes
            self._save_if_possible()
        if self._ranks.count > 1:
            # Its collectives must not start while an actor in this process captures its engine's
            # graph, which it does in its first rollout. Until there are weights, the actor builds
            # its training set and its programs.
            self._warm_up()
        self._publish()
        if self._ranks.count == 1:
            self._warm_up()
        pace, watch = Pace(), CollapseWatch(self._config.collapse_patience)
        # Soon after a resume: until there is a checkpoint, rollouts of new versions cannot be
        # recovered.
        end, saved, due = None, -1, not self._is_new
        while self._state.version < self._config.updates and end is None:
            began = time.monotonic()
            end = self._wait(stop, deaths)
            if end is not None:
                break
            arrived = time.monotonic()
            values, steps = self._update()
            values["wait_seconds"], values["update_seconds"] = (
                arrived - began,
                time.monotonic() - arrived,
            )
            values["steps_per_second"] = pace.steps_per_second(steps)
            values["transitions"] = float(self._state.transitions)
            if self._ranks.rank == 0:
                self._log(
                    "metrics",
                    {"update": self._state.version, "version": self.version, "values": values},
                )
            on_update(
                {"update": float(self._state.version), "version": float(self.version), **values}
            )
            # Success is expected to drop when objects are released after the stationary phase.
            stationary = self._config.curriculum.stationary(self.version)
            if not stationary and (collapse := watch.add(values)):
                self._ranks.close()
                self._event("fatal", f"Training collapsed: {collapse}.")
                raise CongraspError(
                    f"Training collapsed: {collapse}.",
                    "See docs/training.md. --resume continues from the last checkpoint.",
                )
            due = due or self._state.version % self._config.checkpoint_every == 0
            if due and self._save_if_possible():
                saved, due = self._state.version, False
        if saved != self._state.version:
            self._save()
        if end is None:
            self._event("info", f"The run is complete after {self._state.version} updates.")
            self._shut_actors_down()
        self._ranks.close()
        if deaths:
            raise CongraspError(
                f"The learner stopped: {deaths[0]}.",
                "A checkpoint was written. Pass --resume to continue.",
            )
        if end is not None and end[0] != self._ranks.rank and not stop.is_set():
            raise TransportError(
                f"Rank {end[0]} ended the run: {end[1]}.",
                "A checkpoint was written. Pass --resume to continue.",
            )

    def _wait(self, stop: threading.Event, deaths: list[str]) -> tuple[int, str] | None:
        """Waits until every rank has a batch; returns the rank that ends training instead, and the
        reason.

        A long wait is an event, not an end, since actors may return.
        """
        posted, silent_since = "", time.monotonic()
        while True:
            end = deaths[0] if deaths else "it was stopped" if stop.is_set() else ""
            found = bool(posted) or self._rollouts.has_batch(
                self._config.rollouts_per_update, 0 if end else _POLL_SECONDS
            )
            state = end or ("ready" if found else "")
            if state != posted:
                self._ranks.post({"end": end}, urgent=bool(end))
                posted = state
            decision = self._ranks.poll(_POLL_SECONDS if posted else 0.0)
            if decision is not None:
                return ended_by(decision.meta["entries"])
            if time.monotonic() - silent_since > _STALL_SECONDS:
                whose = "of another rank " if posted else ""
                self._event("warning", f"No batch of rollouts {whose}for {_STALL_SECONDS:.0f} s.")
                silent_since = time.monotonic()

    def _update(self) -> tuple[dict[str, float], int]:
        """Runs one update on all ranks; returns its metrics and its number of environment steps."""
        messages = self._rollouts.next_batch(self._config.rollouts_per_update, 0.0)
        assert messages is not None, "an available batch cannot disappear"
        batch = collate([message.arrays for message in messages], self._form.arrays)
        lags = [self._rollouts.staleness.lag(int(message.meta["version"])) for message in messages]
        mine = summary(messages, lags)
        batch["lag"] = np.repeat(np.array(lags, np.int32), self._form.worlds)
        try:
            with self._ranks.watchdog(), stage("first update"):
                self._state, metrics = self._algorithm.update(self._state, batch, self._ranks.mesh)
            self._dropped_in_a_row = 0
        except NonFiniteUpdate as error:
            self._rollouts.discard(messages)
            self._state, metrics = self._drop(batch, error), {}
        self._publish()
        everyone = self._ranks.exchange(mine).meta["entries"]
        return {**metrics, "batches_dropped": float(self._dropped), **overall(everyone)}, sum(
            entry["steps"] for entry in everyone
        )

    def _drop(self, batch: Mapping[str, Any], error: NonFiniteUpdate) -> TrainState:
        """Returns the state after an unusable batch: one version later, with the same policy.

        Batch and state are written to `failure/`. All ranks decide alike, because they share the
        update.
        """
        self._dropped, self._dropped_in_a_row = self._dropped + 1, self._dropped_in_a_row + 1
        folder, number = (
            self._run_dir / "failure",
            f"-{self._ranks.rank}" if self._ranks.count > 1 else "",
        )
        with contextlib.suppress(CongraspError):
            write_atomically(folder / f"batch{number}.safetensors", encode(Message(batch, {})))
            if self._ranks.rank == 0:
                write_atomically(
                    folder / "state.safetensors", encode(Message(flatten(error.state), {}))
                )
        if self._dropped_in_a_row < _MOST_DROPPED:
            self._event("error", f"{error} The batch was dropped; state and batch are in {folder}.")
            return error.state._replace(version=error.state.version + 1)
        self._ranks.close()
        self._event("fatal", str(error))
        raise PhysicsError(
            f"{error} It was the {self._dropped_in_a_row}th such batch in a row.",
            f"State and batch are in {folder}.",
        ) from None

    def _publish(self) -> None:
        if self._ranks.rank == 0:
            self._check_lock()
            try:
                note_version(self._run_dir, self.version)
            except CongraspError as error:
                self._event("error", str(error))
        self._hub.publish_weights(self.bundle().to_message(), self.version)
        if self._ranks.rank:
            return
        meta = {"version": self.version, "run_id": self._run_id, "schema": self._spec.schema}
        self._log(
            "version",
            {**meta, "update": self._state.version, "transitions": self._state.transitions},
        )

    def _skip_lost_versions(self, version: int, newest: int) -> int:
        """Skips versions that were published after the checkpoint and lost with the process, so
        that none is reused.

        `newest` is a lower bound of the version of the newest checkpoint, intact or not.
        """
        published = max(newest, published_version(self._run_dir))
        if published <= version:
            return 0
        self._event("warning", f"{published - version} update(s) after the checkpoint were lost.")
        return published + 1 - version

    def _warm_up(self) -> None:
        """Compiles the update while the actors produce the first rollouts."""
        batch = self._form.zeros(self._config.rollouts_per_update)
        copy = self._state._replace(optimizer=jax.tree.map(np.array, self._state.optimizer))
        with self._ranks.watchdog(), stage("compile update"):
            self._algorithm.update(copy, batch, self._ranks.mesh)

    def _save(self) -> None:
        """Writes a checkpoint on rank 0; all ranks call this, and their replicas are compared."""
        durable = self._rollouts.durable()
        state = checksum(self._state) if self._ranks.count > 1 else 0
        everyone = self._ranks.exchange({"hub": durable, "state": state}).meta["entries"]
        if odd := [
            rank for rank, entry in enumerate(everyone) if entry["state"] != everyone[0]["state"]
        ]:
            raise ReplicasDiffer(
                f"The weights of ranks {odd} differ from those of rank 0 after update "
                f"{self._state.version}.",
                "All ranks need the same GPUs and versions. --resume continues from the last "
                "checkpoint.",
            )
        failure = ""
        if self._ranks.rank == 0:
            meta = {
                "run_id": self._run_id,
                "skipped": self._skipped,
                "config": config_checksum(to_json(self._config).encode()),
                "hubs": [entry["hub"] for entry in everyone],
            }
            try:
                self._checkpoints.save(self._state, meta, self._state.version)
                bundles.save(self.bundle(), self._run_dir / POLICY_FILE)
            except CongraspError as error:
                failure = str(error)
        if failure := self._ranks.exchange({"failure": failure}).meta["entries"][0]["failure"]:
            raise CongraspError(failure)
        self._saved = self._state.version
        self._rollouts.note_saved()

    def _save_if_possible(self) -> bool:
        """Writes a checkpoint during training; a failed one is retried after the next update."""
        try:
            self._save()
        except ReplicasDiffer:
            raise
        except CongraspError as error:
            lost = self._state.version - self._saved
            loss = f"A kill now would lose {lost} update(s), those since update {self._saved}."
            self._hub.trouble = f"No checkpoint can be written: {error} {loss}"
            if (
                not self._unsaved or lost >= 4 * self._unsaved
            ):  # again when there is much more to lose
                self._unsaved = max(1, lost)
                self._event(
                    "error", f"{error} Training continues and retries after every update. {loss}"
                )
            return False
        if self._unsaved:
            self._event(
                "info",
                f"Checkpoints can be written again; the newest is of update {self._state.version}.",
            )
        self._unsaved, self._hub.trouble = 0, ""
        return True

    def _shut_actors_down(self) -> None:
        """Notifies the actors that the run is finished, and waits some seconds for them to
        leave.
        """
        self._hub.finish()
        deadline = time.monotonic() + _SHUTDOWN_SECONDS
        while time.monotonic() < deadline and any(
            who["role"] == "actor" for who in self._hub.status()["roles"]
        ):
            time.sleep(_POLL_SECONDS / 4)

    def _log(self, kind: str, meta: dict[str, object]) -> None:
        message = Message(meta=finite({"time": time.time(), **meta}))
        self._transport.publish(self._keys.log(kind, "learner", str(self._ranks.rank)), message)


def _durable(hubs: list[dict[str, Any]], rank: int) -> dict[str, Any] | None:
    """Returns a checkpoint's data of this rank's rollouts; a new rank gets empty data at its
    version.
    """
    if not hubs or rank < len(hubs):
        return hubs[rank] if hubs else None
    return {
        **hubs[0],
        "counters": dataclasses.asdict(Counters()),
        "forgotten_missing": 0,
        "sequences": [],
    }
