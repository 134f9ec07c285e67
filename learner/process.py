"""The learner process: rollouts in, policy bundles out, and a run directory from which it can be resumed.

A run directory holds `config.json`, `initial.safetensors` where training does not begin with random weights,
`checkpoints/`, `policy.safetensors` (that of the newest checkpoint), `logs/`, `audit/` (what became of every rollout),
`version` (the newest version that was ever published, so that versions rise over a crash, too) and, after an update
that was not finite, `failure/`.
"""

import contextlib
import os
import pathlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from common.config import RunConfig, run_config_from_json, to_json
from common.errors import CongraspError, PhysicsError
from common.files import write_atomically
from common.logs.channels import finite
from common.policy import bundle as bundles
from common.policy.bundle import PolicyBundle, PolicySpec
from common.transport.base import Transport
from common.transport.keys import Keys
from common.wire.codec import Message, encode
from common.wire.messages import RolloutForm
from learner import update as updates
from learner.audit import AuditLog
from learner.checkpoint import Checkpoints, flatten
from learner.collapse import CollapseWatch
from learner.hub import LearnerHub
from learner.staleness import StalenessManager
from learner.statistics import Pace, episode_means, staleness
from learner.update import NonFiniteUpdate

POLICY_FILE = "policy.safetensors"
INITIAL_FILE = "initial.safetensors"
CONFIG_FILE = "config.json"
LOGS = "logs"
_VERSION_FILE = "version"
_POLL_SECONDS = 0.2
_STALL_SECONDS = 60.0
_FAREWELL_SECONDS = 3.0

Notify = Callable[[str, str], None]
"""(level, text) of an event."""


def create_run(run_dir: pathlib.Path, config: RunConfig, initial: PolicyBundle | None = None) -> None:
    """Makes a run directory.

    Args:
      run_dir: where.
      config: the run.
      initial: a policy to begin with instead of random weights: its networks and normalisers.

    Raises:
      CongraspError: there is a run in it already, or the initial policy does not fit the run.
    """
    if (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} holds a run already.", "Choose another --run-dir, or continue it with --resume."
        )
    if initial is not None:
        bundles.policy_spec(config.task, config.network).require(initial.spec, "to begin with")
        run_dir.mkdir(parents=True, exist_ok=True)
        bundles.save(initial, run_dir / INITIAL_FILE)
    write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
    (run_dir / LOGS).mkdir(exist_ok=True)


def open_run(run_dir: pathlib.Path) -> RunConfig:
    """The configuration of a run directory; a CongraspError if it is not one."""
    try:
        text = (run_dir / CONFIG_FILE).read_bytes()
    except OSError:
        raise CongraspError(
            f"{run_dir} is not a run directory: it has no {CONFIG_FILE}.", "Name one made by 'congrasp train'."
        ) from None
    return run_config_from_json(text)


def run_learner(
    run_dir: pathlib.Path,
    config: RunConfig,
    transport: Transport,
    *,
    stop_event: threading.Event,
    resume: bool = False,
    name: str = "0",
    audit: bool = True,
    recorder: contextlib.AbstractContextManager[object] | None = None,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    on_event: Notify = lambda level, text: None,
) -> PolicyBundle:
    """Trains until `config.updates` updates are done or `stop_event` is set; returns the last policy.

    The run can be resumed in both cases, and after a crash from its last checkpoint.

    Args:
      run_dir: made by `create_run`.
      config: the run; when resuming, it may differ from the one that began it in what changes no array.
      transport: the learner's endpoint; it stays the caller's.
      stop_event: ends training after the update that is under way.
      resume: go on from the latest checkpoint.
      name: the learner's name on the wire.
      audit: keep the journal in `audit/`; it needs rollouts on the host, so not where they stay on a device.
      recorder: entered while the learner runs, for example one that writes the run's logs.
      on_update: given the figures of every update.
      on_event: given what is worth a line.

    Raises:
      CongraspError: the directory is not a run's; the checkpoint does not fit; the disk is full; a thread of this
        process died; training collapsed.
      PhysicsError: a value was not finite; state and batch are in `failure/`.
    """
    open_run(run_dir)
    with _watch_threads() as deaths, recorder or contextlib.nullcontext():
        learner = _Learner(run_dir, config, transport, name, resume, audit, on_event)
        try:
            learner.train(stop_event, deaths, on_update)
        finally:
            learner.close()
        return learner.bundle()


@contextlib.contextmanager
def _watch_threads() -> Iterator[list[str]]:
    """Collects what killed threads of this process, so that the rest does not live on as if nothing had happened."""
    deaths: list[str] = []
    previous = threading.excepthook

    def note(arguments: threading.ExceptHookArgs) -> None:
        previous(arguments)
        thread = arguments.thread.name if arguments.thread else "?"
        deaths.append(f"thread '{thread}' died of {arguments.exc_type.__name__}: {arguments.exc_value}")

    threading.excepthook = note
    try:
        yield deaths
    finally:
        threading.excepthook = previous


class _Learner:
    """State of one run between two updates."""

    def __init__(
        self,
        run_dir: pathlib.Path,
        config: RunConfig,
        transport: Transport,
        name: str,
        resume: bool,
        audit: bool,
        on_event: Notify,
    ):
        self._run_dir, self._config, self._transport, self._name = run_dir, config, transport, name
        self._keys = Keys(config.name)

        def tell(level: str, text: str) -> None:
            with contextlib.suppress(OSError):  # standard output may be on a disk that is full
                on_event(level, text)

        self._on_event = tell
        self._spec: PolicySpec = bundles.policy_spec(config.task, config.network)
        self._checkpoints = Checkpoints(run_dir / "checkpoints")
        self._state = updates.init_state(
            config.seed, self._spec.layout, self._spec.action_size, config.network, config.ppo
        )
        self._epoch, self._skipped, hub_state = secrets.token_hex(8), 0, None
        if resume:
            self._state, meta = self._checkpoints.load(self._state)
            self._epoch, self._skipped, hub_state = meta["epoch"], meta["skipped"], meta["hub"]
            self._skip_lost_versions()
            write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
        elif (run_dir / INITIAL_FILE).exists():
            initial = bundles.load(run_dir / INITIAL_FILE)
            params = jax.tree.map(jnp.asarray, initial.params)
            self._state = self._state._replace(params=params, observation=initial.observation, value=initial.value)
        self._hub = LearnerHub(
            transport,
            run=config.name,
            config_json=to_json(config),
            epoch=self._epoch,
            schema=self._spec.schema,
            form=RolloutForm(
                config.rollout_steps,
                config.environments,
                sum(size for _, size in self._spec.layout),
                self._spec.action_size,
                config.half_observations,
            ),
            staleness=StalenessManager(config.ppo.max_staleness, config.ppo.rollouts_per_update),
            name=name,
            durable=hub_state,
            on_event=tell,
            audit=AuditLog(run_dir, name, lambda text: self._event("error", text)) if audit else None,
        )

    def close(self) -> None:
        """Notes what is left; the transport stays open."""
        self._hub.close()

    @property
    def version(self) -> int:
        """Of the newest policy."""
        return self._state.version + self._skipped

    def bundle(self) -> PolicyBundle:
        """The newest policy."""
        state = self._state
        return PolicyBundle(
            self._spec,
            self._config.task,
            state.params,
            state.observation,
            state.value,
            self.version,
            self._epoch,
            state.transitions,
        )

    def train(self, stop: threading.Event, deaths: list[str], on_update: Callable[[dict[str, float]], None]) -> None:
        """Updates until the end, a stop, or a thread's death; leaves a checkpoint behind in each case."""
        self._publish()
        self._warm_up()
        pace, watch = Pace(), CollapseWatch(self._config.collapse_patience)
        saved, due = -1, False
        while self._state.version < self._config.updates and not stop.is_set() and not deaths:
            began = time.monotonic()
            messages = self._next_batch(stop, deaths)
            if messages is None:
                break
            arrived = time.monotonic()
            values = self._update(messages)
            values["wait_seconds"], values["update_seconds"] = arrived - began, time.monotonic() - arrived
            values["steps_per_second"] = pace.steps_per_second(sum(message.meta["steps"] for message in messages))
            values["transitions"] = float(self._state.transitions)
            self._log("metrics", {"update": self._state.version, "version": self.version, "values": values})
            on_update({"update": float(self._state.version), "version": float(self.version), **values})
            # What is learnt on stationary objects is expected to fall when they are let go.
            stationary = self._config.curriculum.stationary(self.version)
            if not stationary and (collapse := watch.add(values)):
                self._event("fatal", f"Training collapsed: {collapse}.")
                raise CongraspError(
                    f"Training collapsed: {collapse}.",
                    "See docs/training.md; --resume goes on from the last checkpoint.",
                )
            due = due or self._state.version % self._config.checkpoint_every == 0
            if due and self._save_if_possible():
                saved, due = self._state.version, False
        if saved != self._state.version:
            self._save()
        if deaths:
            raise CongraspError(f"The learner stopped: {deaths[0]}.", "A checkpoint was written; use --resume.")
        if not stop.is_set():
            self._event("info", f"The run is complete after {self._state.version} updates.")
            self._say_goodbye()

    def _next_batch(self, stop: threading.Event, deaths: list[str]) -> list[Message] | None:
        """The next batch; None when training is to end. A long silence is an event, not an end: actors may return."""
        silent_since = time.monotonic()
        while not stop.is_set() and not deaths:
            messages = self._hub.next_batch(self._config.ppo.rollouts_per_update, _POLL_SECONDS)
            if messages is not None:
                return messages
            if time.monotonic() - silent_since > _STALL_SECONDS:
                self._event("warning", f"No batch of rollouts for {_STALL_SECONDS:.0f} s.")
                silent_since = time.monotonic()
        return None

    def _update(self, messages: list[Message]) -> dict[str, float]:
        figures = {**staleness(messages, self._hub.lag), **episode_means(messages)}
        batch = updates.collate([message.arrays for message in messages])
        try:
            self._state, metrics = updates.update(self._state, batch, self._spec.layout, self._config.ppo)
        except NonFiniteUpdate as error:
            folder = self._run_dir / "failure"
            with contextlib.suppress(CongraspError):
                write_atomically(folder / "state.safetensors", encode(Message(flatten(error.state), {})))
                write_atomically(folder / "batch.safetensors", encode(Message(batch, {})))
            self._event("fatal", str(error))
            raise PhysicsError(str(error), f"State and batch are in {folder}.") from None
        self._publish()
        return {**metrics, **figures}

    def _publish(self) -> None:
        # Overwritten in place, which needs no space on a disk that is full, and not flushed: this must survive the
        # process, and a power cut costs no more than a version.
        try:
            with open(os.open(self._run_dir / _VERSION_FILE, os.O_WRONLY | os.O_CREAT, 0o644), "wb", 0) as file:
                file.write(f"{self.version:020d}\n".encode())
        except OSError as error:
            self._event("error", f"{self._run_dir / _VERSION_FILE} could not be written: {error.strerror}.")
        self._hub.publish_weights(self.bundle().to_message(), self.version)
        meta = {"version": self.version, "epoch": self._epoch, "schema": self._spec.schema}
        self._log("version", {**meta, "update": self._state.version, "transitions": self._state.transitions})

    def _skip_lost_versions(self) -> None:
        """Versions that were published after the checkpoint and died with the process are not given out again."""
        try:
            published = int((self._run_dir / _VERSION_FILE).read_text())
        except (OSError, ValueError):
            return
        if published > self.version:
            self._event("warning", f"{published - self.version} update(s) after the checkpoint were lost.")
            self._skipped += published + 1 - self.version

    def _warm_up(self) -> None:
        """Compiles the update while the actors make the first rollouts."""
        config, spec = self._config, self._spec
        steps, worlds = config.rollout_steps, config.environments * config.ppo.rollouts_per_update
        size = sum(width for _, width in spec.layout)
        dtype = np.float16 if config.half_observations else np.float32
        batch = {
            "observation": np.zeros((steps, worlds, size), dtype),
            "last_observation": np.zeros((worlds, size), dtype),
            "action": np.zeros((steps, worlds, spec.action_size), np.float32),
            "log_probability": np.zeros((steps, worlds), np.float32),
            "reward": np.zeros((steps, worlds), np.float32),
            "terminal": np.zeros((steps, worlds), bool),
        }
        copy = self._state._replace(optimizer=jax.tree.map(jnp.copy, self._state.optimizer))
        updates.update(copy, batch, spec.layout, config.ppo)

    def _save(self) -> None:
        durable = self._hub.durable()
        meta = {"epoch": self._epoch, "skipped": self._skipped, "hub": durable}
        self._checkpoints.save(self._state, meta, self._state.version)
        self._hub.note_saved(durable)
        bundles.save(self.bundle(), self._run_dir / POLICY_FILE)

    def _save_if_possible(self) -> bool:
        """A checkpoint on the way; one that fails is tried again after the next update, and training goes on."""
        try:
            self._save()
        except CongraspError as error:
            self._event("error", f"{error} Training goes on; the next update tries again.")
            return False
        return True

    def _say_goodbye(self) -> None:
        """Sends the actors home, and gives them a moment to hear it."""
        self._hub.finish()
        deadline = time.monotonic() + _FAREWELL_SECONDS
        while time.monotonic() < deadline and any(who["role"] == "actor" for who in self._hub.status()["roles"]):
            time.sleep(_POLL_SECONDS / 4)

    def _event(self, level: str, text: str) -> None:
        self._on_event(level, text)
        self._log("event", {"level": level, "text": text})

    def _log(self, kind: str, meta: dict[str, object]) -> None:
        message = Message(meta=finite({"time": time.time(), **meta}))
        self._transport.publish(self._keys.log(kind, "learner", self._name), message)
