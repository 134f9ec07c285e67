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
from congrasp.common.policy.bundle import PolicyBundle, without_critic
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
from congrasp.learner.distributed.ranks import Ending, Ranks, first_ending
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.limits import Events
from congrasp.learner.hub.queue import RolloutContract, RolloutQueue
from congrasp.learner.hub.staleness import Counters, StalenessManager
from congrasp.learner.hub.task_ranges import task_ranges
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

_POLL_S = 0.2
_STALL_S = 60.0
"""Time without a batch after which a warning is sent."""
_SHUTDOWN_S = 3.0
"""Longest time for the actors to leave a finished run."""
_MAX_DROPPED_IN_A_ROW = 5
"""Unusable batches in a row after which training fails."""
_FAILURE_FOLDER = "failure"

Notify = Callable[[str, str], None]
"""(level, text) of an event."""


class ReplicasDiffer(CongraspError):
    """The replicas of the weights differ between ranks."""


def _ignore_update(values: dict[str, float]) -> None:
    """Ignores the metrics of an update."""


def _ignore_event(level: str, text: str) -> None:
    """Ignores an event."""


class Outputs(NamedTuple):
    """Records of a learner's run, and callbacks, in addition to policies and checkpoints."""

    audit: bool = True
    """Writes the journal in `audit/`, if rollouts are on the host."""
    on_host: bool = True
    """Rollouts are on the host, not on a device: accepted ones are written to `accepted/`, if
    configured.
    """
    recorder: contextlib.AbstractContextManager[object] | None = None
    """Context entered while the learner runs, for example to write the run's logs."""
    on_update: Callable[[dict[str, float]], None] = _ignore_update
    """Called with the metrics of every update."""
    on_event: Notify = _ignore_event
    """Called with level and text of every event."""


def run_learner(
    run_dir: pathlib.Path,
    config: RunConfig,
    transport: Transport,
    *,
    stop_event: threading.Event,
    resume: bool = False,
    ranks: Ranks | None = None,
    outputs: Outputs = Outputs(),  # noqa: B008
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
      outputs: records and callbacks.

    Raises:
      CongraspError: the directory is not a run directory, or in use; the checkpoint does not match;
        the disk is full; a thread of this process died; training collapsed; another rank ended the
        run.
      PhysicsError: several batches in a row had values that were not finite; state and last batch
        are in `failure/`.
    """
    ranks = ranks or Ranks()
    try:
        with contextlib.ExitStack() as stack:
            check_lock = _no_lock
            if ranks.rank == 0:
                open_run(run_dir)
                warn = functools.partial(outputs.on_event, "warning")
                check_lock = stack.enter_context(exclusive(run_dir, warn))
            deaths = stack.enter_context(_watch_threads())
            if outputs.recorder is not None:
                stack.enter_context(outputs.recorder)
            learner = _Learner(run_dir, config, transport, ranks, resume, outputs, check_lock)
            try:
                learner.train(stop_event, deaths)
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


def _no_lock() -> None:
    """Check of the lock of a rank that holds none."""


class _Learner:
    """State of one run between two updates."""

    def __init__(
        self,
        run_dir: pathlib.Path,
        config: RunConfig,
        transport: Transport,
        ranks: Ranks,
        resume: bool,
        outputs: Outputs,
        check_lock: Callable[[], None],
    ):
        self._check_lock = check_lock
        self._run_dir = run_dir
        self._config = config
        self._transport = transport
        self._ranks = ranks
        self._outputs = outputs
        self._keys = Keys(config.name)
        events = Events(transport, config.name, str(ranks.rank), self._notify)
        self._event = events.add
        self._spec = bundles.policy_spec(config.task, config.network)
        self._algorithm = make_algorithm(self._spec, config)
        self._form = rollout_form(config, self._spec, self._algorithm.batch_schema)
        self._checkpoints = Checkpoints(run_dir / CHECKPOINTS)
        self._state, meta = self._first_state(resume)
        self._dropped = 0
        self._dropped_in_a_row = 0
        self._saved = self._state.version
        """Update of the newest checkpoint."""
        self._reported_loss = 0
        """Updates that a kill would have lost when the last failure of a checkpoint was reported; 0
        if checkpoints can be written.
        """
        self._run_id = meta["run_id"]
        self._skipped = meta["skipped"]
        hubs = meta["hubs"]
        self._is_new = not hubs
        # Computed meanwhile: the first rollout needs them.
        ranges = concurrent.futures.ThreadPoolExecutor(1, "ranges").submit(
            task_ranges, config.task, config.curriculum
        )
        self._rollouts = self._make_queue(events, _durable(hubs, ranks.rank))
        self._hub = LearnerHub(
            transport, self._rollouts, events, to_json(config), Admission(ranges.result)
        )
        if hubs and len(hubs) != ranks.count:
            self._event(
                "warning",
                f"The checkpoint has {len(hubs)} rank(s), this run has {ranks.count}: counters and "
                f"sequences of missing ranks are dropped, new ones start empty.",
            )

    def _notify(self, level: str, text: str) -> None:
        """Passes an event on; standard output may be on a full disk."""
        with contextlib.suppress(OSError):
            self._outputs.on_event(level, text)

    def _make_queue(self, events: Events, durable: dict[str, Any] | None) -> RolloutQueue:
        """Returns the queue of this rank's rollouts, with its records."""
        config = self._config
        name = str(self._ranks.rank)
        log_error = functools.partial(self._event, "error")
        audit = None
        if self._outputs.audit and self._outputs.on_host:
            audit = AuditLog(self._run_dir, name, log_error)
        write_ahead = None
        if self._outputs.on_host:
            write_ahead = WriteAheadLog(
                self._run_dir / FOLDER / name,
                config.max_staleness,
                write=config.write_ahead,
                log_error=log_error,
            )
        return RolloutQueue(
            RolloutContract(self._run_id, self._form, self._spec.schema),
            StalenessManager(config.max_staleness, config.rollouts_per_update),
            events,
            durable=durable,
            audit=audit,
            log=write_ahead,
        )

    def _first_state(self, resume: bool) -> tuple[TrainState, dict[str, Any]]:
        """Returns the initial state and a checkpoint's metadata, those of rank 0 for all ranks."""
        ranks = self._ranks
        initial = None
        initial_file = self._run_dir / INITIAL_FILE
        if ranks.rank == 0 and not resume and initial_file.exists():
            bundle = bundles.load(initial_file)
            initial = LearnedPolicy(
                bundle.params, bundle.observation, bundle.value, bundle.privileged
            )
        state = self._algorithm.init(self._config.seed, initial)
        meta: dict[str, Any] = {"run_id": secrets.token_hex(8), "skipped": 0, "hubs": []}
        if ranks.rank == 0:
            newest = self._checkpoints.newest()
            if resume:
                state, meta = self._checkpoints.load(state, self._event)
                keep_policy(self._run_dir, state.version + meta["skipped"], self._event)
                store_config(self._run_dir, self._config)
            elif newest >= 0:
                raise CongraspError(
                    f"{self._run_dir} has checkpoints of a run.",
                    "Pass --resume to continue it, or another --run-dir.",
                )
            skipped = meta["skipped"]
            lost = self._skip_lost_versions(state.version + skipped, newest + skipped)
            meta = {**meta, "skipped": lost + skipped}
        if ranks.count > 1:
            arrays = flatten(state) if ranks.rank == 0 else None
            message = ranks.exchange(meta, arrays)
            state = restore(message.arrays, state, "The state of rank 0")
            meta = message.meta["entries"][0]
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

    def train(self, stop: threading.Event, deaths: list[str]) -> None:
        """Updates until the end, a stop, or a thread's death; writes a checkpoint in each case."""
        self._begin()
        pace = Pace()
        watch = CollapseWatch(self._config.collapse_patience)
        end = None
        saved = -1
        # Soon after a resume: until there is a checkpoint, rollouts of new versions cannot be
        # recovered.
        due = not self._is_new
        while self._state.version < self._config.updates:
            began = time.monotonic()
            end = self._wait(stop, deaths)
            if end is not None:
                break
            values = self._run_update(began, pace)
            self._report(values)
            self._check_collapse(watch, values)
            due = due or self._state.version % self._config.checkpoint_every == 0
            if due and self._save_if_possible():
                saved = self._state.version
                due = False
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
        if end is not None and end.rank != self._ranks.rank and not stop.is_set():
            raise TransportError(
                f"Rank {end.rank} ended the run: {end.reason}.",
                "A checkpoint was written. Pass --resume to continue.",
            )

    def _begin(self) -> None:
        """Writes the first checkpoint of a new run, publishes the first weights, and compiles the
        update.
        """
        if self._is_new:
            # Before any rollout is accepted, so that a resume can recover what a kill undoes
            self._save_if_possible()
        if self._ranks.count > 1:
            # Its collectives must not start while an actor in this process captures its engine's
            # graph, which it does in its first rollout. Until there are weights, the actor builds
            # its training set and its programs.
            self._warm_up()
        self._publish()
        if self._ranks.count == 1:
            self._warm_up()

    def _run_update(self, began: float, pace: Pace) -> dict[str, float]:
        """Runs one update; returns its metrics and durations.

        Args:
          began: `time.monotonic()` at the start of the wait for the batch.
          pace: measures the steps per second.
        """
        arrived = time.monotonic()
        values, steps = self._update()
        values["wait_seconds"] = arrived - began
        values["update_seconds"] = time.monotonic() - arrived
        values["steps_per_second"] = pace.steps_per_second(steps)
        values["transitions"] = float(self._state.transitions)
        return values

    def _report(self, values: dict[str, float]) -> None:
        """Publishes the metrics of an update."""
        update = self._state.version
        if self._ranks.rank == 0:
            self._log("metrics", {"update": update, "version": self.version, "values": values})
        counts = {"update": float(update), "version": float(self.version)}
        self._outputs.on_update({**counts, **values})

    def _check_collapse(self, watch: CollapseWatch, values: dict[str, float]) -> None:
        """Raises a CongraspError if training has collapsed."""
        # Success is expected to drop when objects are released after the stationary phase.
        if self._config.curriculum.stationary(self.version):
            return
        collapse = watch.add(values)
        if not collapse:
            return
        self._ranks.close()
        self._event("fatal", f"Training collapsed: {collapse}.")
        raise CongraspError(
            f"Training collapsed: {collapse}.",
            "See docs/training.md. --resume continues from the last checkpoint.",
        )

    def _wait(self, stop: threading.Event, deaths: list[str]) -> Ending | None:
        """Waits until every rank has a batch; returns the rank that ends training instead, if any.

        A long wait is an event, not an end, since actors may return.
        """
        posted = ""
        silent_since = time.monotonic()
        while True:
            end = ""
            if deaths:
                end = deaths[0]
            elif stop.is_set():
                end = "it was stopped"
            state = end
            if self._has_batch(posted, end) and not end:
                state = "ready"
            if state != posted:
                self._ranks.post({"end": end}, urgent=bool(end))
                posted = state
            timeout = _POLL_S if posted else 0.0
            decision = self._ranks.poll(timeout)
            if decision is not None:
                return first_ending(decision.meta["entries"])
            if time.monotonic() - silent_since > _STALL_S:
                of_other_rank = "of another rank " if posted else ""
                self._event("warning", f"No batch of rollouts {of_other_rank}for {_STALL_S:.0f} s.")
                silent_since = time.monotonic()

    def _has_batch(self, posted: str, end: str) -> bool:
        """True if this rank has a batch of rollouts; waits `_POLL_S` for one unless training ends.

        Args:
          posted: state that this rank has posted. Its batch cannot disappear after that.
          end: reason of the end of training, or empty.
        """
        if posted:
            return True
        timeout = 0.0 if end else _POLL_S
        return self._rollouts.has_batch(self._config.rollouts_per_update, timeout)

    def _update(self) -> tuple[dict[str, float], int]:
        """Runs one update on all ranks; returns its metrics and its number of environment steps."""
        messages = self._rollouts.next_batch(self._config.rollouts_per_update, 0.0)
        assert messages is not None, "an available batch cannot disappear"
        batch = collate([message.arrays for message in messages], self._form.arrays)
        lags = [self._rollouts.staleness.lag(int(message.meta["version"])) for message in messages]
        of_this_rank = summary(messages, lags)
        batch["lag"] = np.repeat(np.array(lags, np.int32), self._form.worlds)
        try:
            with self._ranks.watchdog(), stage("first update"):
                self._state, metrics = self._algorithm.update(self._state, batch, self._ranks.mesh)
            self._dropped_in_a_row = 0
        except NonFiniteUpdate as error:
            self._rollouts.discard(messages)
            self._state = self._drop(batch, error)
            metrics = {}
        self._publish()
        summaries = self._ranks.exchange(of_this_rank).meta["entries"]
        values = {**metrics, "batches_dropped": float(self._dropped), **overall(summaries)}
        return values, sum(entry["steps"] for entry in summaries)

    def _drop(self, batch: Mapping[str, Any], error: NonFiniteUpdate) -> TrainState:
        """Returns the state after an unusable batch: one version later, with the same policy.

        Batch and state are written to `failure/`. All ranks decide alike, because they share the
        update.
        """
        self._dropped += 1
        self._dropped_in_a_row += 1
        folder = self._run_dir / _FAILURE_FOLDER
        batch_file = "batch.safetensors"
        if self._ranks.count > 1:
            batch_file = f"batch-{self._ranks.rank}.safetensors"
        with contextlib.suppress(CongraspError):
            write_atomically(folder / batch_file, encode(Message(batch, {})))
            if self._ranks.rank == 0:
                state = encode(Message(flatten(error.state), {}))
                write_atomically(folder / "state.safetensors", state)
        if self._dropped_in_a_row < _MAX_DROPPED_IN_A_ROW:
            self._event("error", f"{error} The batch was dropped; state and batch are in {folder}.")
            return error.state._replace(version=error.state.version + 1)
        self._ranks.close()
        self._event("fatal", str(error))
        raise PhysicsError(
            f"{error} It was the {self._dropped_in_a_row}th such batch in a row.",
            f"State and batch are in {folder}.",
        ) from None

    def _publish(self) -> None:
        """Publishes the newest policy; rank 0 stores and logs its version."""
        if self._ranks.rank == 0:
            self._check_lock()
            try:
                note_version(self._run_dir, self.version)
            except CongraspError as error:
                self._event("error", str(error))
        policy = without_critic(self.bundle())  # actors need no more
        self._hub.publish_weights(policy.to_message(), self.version)
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
        entries = self._ranks.exchange({"hub": durable, "state": state}).meta["entries"]
        expected = entries[0]["state"]
        different = [rank for rank, entry in enumerate(entries) if entry["state"] != expected]
        if different:
            raise ReplicasDiffer(
                f"The weights of ranks {different} differ from those of rank 0 after update "
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
                "hubs": [entry["hub"] for entry in entries],
            }
            try:
                self._checkpoints.save(self._state, meta, self._state.version)
                bundles.save(self.bundle(), self._run_dir / POLICY_FILE)
            except CongraspError as error:
                failure = str(error)
        failure_of_first = self._ranks.exchange({"failure": failure}).meta["entries"][0]["failure"]
        if failure_of_first:
            raise CongraspError(failure_of_first)
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
            # Reported again when there is much more to lose
            if not self._reported_loss or lost >= 4 * self._reported_loss:
                self._reported_loss = max(1, lost)
                self._event(
                    "error", f"{error} Training continues and retries after every update. {loss}"
                )
            return False
        if self._reported_loss:
            self._event(
                "info",
                f"Checkpoints can be written again; the newest is of update {self._state.version}.",
            )
        self._reported_loss = 0
        self._hub.trouble = ""
        return True

    def _shut_actors_down(self) -> None:
        """Notifies the actors that the run is finished, and waits some seconds for them to
        leave.
        """
        self._hub.finish()
        deadline = time.monotonic() + _SHUTDOWN_S
        while time.monotonic() < deadline:
            roles = [entry["role"] for entry in self._hub.status()["roles"]]
            if "actor" not in roles:
                return
            time.sleep(_POLL_S / 4)

    def _log(self, kind: str, meta: dict[str, object]) -> None:
        """Publishes a line of the learner's log."""
        message = Message(meta=finite({"time": time.time(), **meta}))
        self._transport.publish(self._keys.log(kind, "learner", str(self._ranks.rank)), message)


def _durable(hubs: list[dict[str, Any]], rank: int) -> dict[str, Any] | None:
    """Returns a checkpoint's data of this rank's rollouts; a new rank gets empty data at its
    version.
    """
    if not hubs:
        return None
    if rank < len(hubs):
        return hubs[rank]
    return {
        **hubs[0],
        "counters": dataclasses.asdict(Counters()),
        "forgotten_missing": 0,
        "sequences": [],
    }
