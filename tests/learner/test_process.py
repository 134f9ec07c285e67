"""The learner process with actors that act with its bundles on made-up observations."""

import collections
import contextlib
import dataclasses
import threading
import time

import jax
import numpy as np
import pytest

from congrasp.common.config import NetworkConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError, PhysicsError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.learner.algorithms import ppo
from congrasp.learner.hub.admission import Admission
from congrasp.learner.process import Outputs, run_learner
from congrasp.learner.run_directory import create_run, initial_notes, open_run
from tests.compiled import program_count
from tests.learner.made_up_actor import MadeUpActor

CONFIG = RunConfig(
    name="t",
    environments=2,
    rollout_steps=4,
    updates=3,
    checkpoint_every=2,
    network=NetworkConfig(hidden=(8,), encoder=2),
    ppo=PPOConfig(epochs=1, minibatches=2),
)


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def act(hub):
    """A function that starts made-up actors, which end with the test."""
    actors = []

    def make(*arguments, **options) -> MadeUpActor:
        actors.append(MadeUpActor(MemoryTransport(hub), *arguments, **options))
        return actors[-1]

    yield make
    for actor in actors:
        actor.stop.set()
        actor.join(10.0)


def learn(run_dir, hub, config=CONFIG, stop_event=None, *, resume=False, **outputs) -> PolicyBundle:
    """Runs a learner; `outputs` are fields of `Outputs`."""
    with MemoryTransport(hub) as transport:
        return run_learner(
            run_dir,
            config,
            transport,
            stop_event=stop_event or threading.Event(),
            resume=resume,
            outputs=Outputs(**outputs),
        )


def test_a_run_from_beginning_to_end(tmp_path, hub, act):
    create_run(tmp_path, CONFIG)
    logs = MemoryTransport(hub).subscribe(Keys("t").logs, depth=1000)
    actors = [act(name) for name in "ab"]
    entered = []

    @contextlib.contextmanager
    def recorder():
        entered.append("in")
        yield
        entered.append("out")

    last = learn(tmp_path, hub, recorder=recorder())
    for actor in actors:
        actor.join(10.0)
        assert actor.ended == "The run is finished."
    assert entered == ["in", "out"]

    assert last.version == 3
    assert last.transitions == 3 * 2 * 8
    shipped = bundles.load(tmp_path / "policy.safetensors")
    assert shipped.version == 3
    assert shipped.run_id == last.run_id
    jax.tree.map(np.testing.assert_array_equal, shipped.params, jax.device_get(last.params))
    assert open_run(tmp_path) == CONFIG
    assert (
        tmp_path / "checkpoints" / "latest"
    ).resolve().name == "checkpoint_000000003.safetensors"

    received = list(iter(lambda: logs.receive(0.0), None))
    kinds = collections.defaultdict(list)
    for key, message in received:
        kinds[key.split("/")[3]].append(message.meta)
    assert [meta["update"] for meta in kinds["metrics"]] == [1, 2, 3]
    assert [meta["version"] for meta in kinds["version"]] == [0, 1, 2, 3]
    values = kinds["metrics"][-1]["values"]
    assert values["episode/success"] == 0.75
    assert values["episodes"] == 8
    assert 0 <= values["staleness_mean"] <= values["staleness_max"] <= CONFIG.max_staleness
    assert all(np.isfinite(value) for value in values.values())
    assert any("complete after 3 updates" in meta["text"] for meta in kinds["event"])


def test_a_stopped_run_is_resumed_with_the_same_actor(tmp_path, hub, act):
    create_run(tmp_path, CONFIG)
    actor = act()
    stop = threading.Event()
    forever = dataclasses.replace(CONFIG, updates=10**6)
    first = learn(
        tmp_path, hub, forever, stop, on_update=lambda values: values["update"] == 3 and stop.set()
    )
    assert first.version == 3
    assert actor.is_alive()
    compiled = program_count(ppo.optimise)
    last = learn(tmp_path, hub, dataclasses.replace(CONFIG, updates=6), resume=True)
    assert program_count(ppo.optimise) == compiled
    actor.join(10.0)
    assert actor.ended == "The run is finished."
    assert last.version == 6
    assert last.transitions == 6 * 2 * 8
    assert last.run_id == first.run_id
    assert open_run(tmp_path).updates == 6
    assert actor.versions == sorted(actor.versions)


def test_a_learner_without_journals_writes_nothing_of_rollouts(tmp_path, hub, act):
    """As where they stay on a device."""
    create_run(tmp_path, CONFIG)
    act()
    assert learn(tmp_path, hub, on_host=False).version == 3
    assert not (tmp_path / "accepted").exists()
    assert not (tmp_path / "audit").exists()


def test_a_resume_without_link_and_version_file_overwrites_nothing(tmp_path, hub, act):
    """The newest checkpoint is damaged, the link gone and the version zeroed: it goes on from the
    one before.
    """
    create_run(tmp_path, CONFIG)
    act()
    stop = threading.Event()
    forever = dataclasses.replace(CONFIG, updates=10**6)
    learn(
        tmp_path, hub, forever, stop, on_update=lambda values: values["update"] == 5 and stop.set()
    )
    checkpoints = tmp_path / "checkpoints"
    (checkpoints / "latest").unlink()
    (checkpoints / "checkpoint_000000005.safetensors").write_bytes(damaged := b"damaged")
    (tmp_path / "version").write_bytes(bytes(21))
    policy = (tmp_path / "policy.safetensors").read_bytes()
    with pytest.raises(CongraspError, match=r"has checkpoints of a run\. Pass --resume"):
        learn(tmp_path, hub)
    seen = []
    logged = []
    learn(
        tmp_path,
        hub,
        dataclasses.replace(CONFIG, updates=7),
        resume=True,
        on_update=lambda values: seen.append((values["update"], values["version"])),
        on_event=lambda level, text: logged.append(text),
    )
    # Versions up to 5 are out, and 6 is what the resume begins with
    assert seen == [
        (5, 7),
        (6, 8),
        (7, 9),
    ]
    assert f"Resuming from the checkpoint {checkpoints}/checkpoint_000000004.safetensors." in logged
    assert any("000000005.safetensors is damaged" in text for text in logged)
    assert (checkpoints / "checkpoint_000000005.safetensors.aside").read_bytes() == damaged
    assert (tmp_path / "policy.safetensors.aside").read_bytes() == policy


def test_too_many_unusable_batches_in_a_row_end_the_run(tmp_path, hub, act, monkeypatch):
    config = dataclasses.replace(CONFIG, updates=20)
    create_run(tmp_path, config)
    # What is within the ranges breaks nothing
    monkeypatch.setattr(Admission, "check", lambda self, message: None)
    act(reward=1e37)
    with pytest.raises(
        PhysicsError, match=r"update 5: .* 5th such batch in a row.*failure"
    ) as caught:
        learn(tmp_path, hub, config)
    assert "\n" not in str(caught.value)
    assert {path.name for path in (tmp_path / "failure").iterdir()} == {
        "state.safetensors",
        "batch.safetensors",
    }
    # What waited is taken up by a resume, the batch itself is not.
    stored = {int(path.stem.split("~")[3]) for path in (tmp_path / "accepted" / "0").iterdir()}
    assert not stored & {0, 1}


def test_an_unusable_batch_is_dropped(tmp_path, hub, act, monkeypatch):
    config = dataclasses.replace(CONFIG, updates=8)
    create_run(tmp_path, config)
    monkeypatch.setattr(Admission, "check", lambda self, message: None)
    actor = act(reward=1e37)
    logged = []
    seen = []

    def on_event(level, text):
        if "The batch was dropped" in text:
            logged.append((level, text))
            actor.reward = 1.0

    last = learn(tmp_path, hub, config, on_event=on_event, on_update=seen.append)
    dropped = [values["batches_dropped"] for values in seen]
    assert 1 <= len(logged) == dropped[-1] < 5
    assert logged[0][0] == "error"
    assert [values["update"] for values in seen] == list(range(1, 9))
    assert last.version == 8
    learnt = [values for values in seen if "policy_loss" in values]
    assert len(learnt) == 8 - len(logged)
    assert np.isfinite([values["policy_loss"] for values in learnt]).all()
    assert np.isfinite(last.value.mean)
    assert abs(last.value.mean) < 100


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dead_thread_ends_the_run_and_leaves_a_checkpoint(tmp_path, hub):
    create_run(tmp_path, CONFIG)

    def die() -> None:
        time.sleep(0.2)
        raise ZeroDivisionError("for a test")

    thread = threading.Thread(target=die, name="ingest")
    with pytest.raises(CongraspError, match="'ingest' died of ZeroDivisionError: for a test"):
        learn(tmp_path, hub, on_event=lambda level, text: None, recorder=_started(thread))
    thread.join(5.0)
    assert (tmp_path / "checkpoints" / "latest").exists()


@contextlib.contextmanager
def _started(thread: threading.Thread):
    thread.start()
    yield


def test_a_collapse_ends_the_run_with_an_error(tmp_path, hub, act):
    config = dataclasses.replace(CONFIG, updates=20, collapse_patience=3)
    create_run(tmp_path, config)
    act(links=0.0)
    events = []
    with pytest.raises(
        CongraspError, match="Training collapsed: for 3 updates the hand has hardly touched"
    ):
        learn(tmp_path, hub, config, on_event=lambda level, text: events.append((level, text)))
    assert events[-1][0] == "fatal"
    assert (tmp_path / "checkpoints" / "latest").exists()


def test_training_starts_from_an_initial_policy(tmp_path, hub):
    create_run(tmp_path / "one", CONFIG)
    stopped = threading.Event()
    stopped.set()
    initial = learn(tmp_path / "one", hub, dataclasses.replace(CONFIG, seed=7), stopped)
    create_run(tmp_path / "two", CONFIG, initial)
    begun = learn(tmp_path / "two", hub, CONFIG, stopped)
    assert begun.version == 0
    assert begun.run_id != initial.run_id
    jax.tree.map(np.testing.assert_array_equal, begun.params, initial.params)
    other = dataclasses.replace(initial, spec=dataclasses.replace(initial.spec, hand="claw"))
    with pytest.raises(CongraspError, match=r"'claw'.*'human'"):
        create_run(tmp_path / "three", CONFIG, other)
    assert not (tmp_path / "three").exists()


def test_training_of_a_policy_without_critic_begins_one(tmp_path, hub):
    create_run(tmp_path / "one", CONFIG)
    stopped = threading.Event()
    stopped.set()
    trained = learn(tmp_path / "one", hub, dataclasses.replace(CONFIG, seed=7), stopped)
    initial = bundles.without_critic(trained)
    (note,) = initial_notes(initial, CONFIG, tmp_path / "mine.safetensors")
    assert "mine.safetensors" in note
    assert "critic" in note
    assert not list(initial_notes(trained, CONFIG, tmp_path / "mine.safetensors"))
    create_run(tmp_path / "two", CONFIG, initial)
    begun = learn(tmp_path / "two", hub, CONFIG, stopped)
    assert begun.actor_sha256 == trained.actor_sha256
    fresh = bundles.with_new_critic(initial, CONFIG.seed).params["critic"]
    jax.tree.map(np.testing.assert_array_equal, begun.params["critic"], fresh)
    assert bundles.load(tmp_path / "two" / "policy.safetensors").has_critic


def test_directories_that_are_no_runs_or_runs_already(tmp_path, hub):
    with pytest.raises(CongraspError, match="not a run directory"):
        learn(tmp_path, hub)
    create_run(tmp_path, CONFIG)
    with pytest.raises(CongraspError, match="already contains a run"):
        create_run(tmp_path, CONFIG)
    with pytest.raises(CongraspError, match="no checkpoint"):
        learn(tmp_path, hub, resume=True)


def test_resuming_with_other_networks_is_refused(tmp_path, hub):
    create_run(tmp_path, CONFIG)
    stopped = threading.Event()
    stopped.set()
    learn(tmp_path, hub, CONFIG, stopped)
    with pytest.raises(CongraspError, match="does not match this run: 'params/actor"):
        learn(
            tmp_path,
            hub,
            dataclasses.replace(CONFIG, network=NetworkConfig(hidden=(9,), encoder=2)),
            resume=True,
        )
