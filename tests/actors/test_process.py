"""What an actor sends, with rollouts that a test invents and a real learner's end."""

import dataclasses
import threading
import types
from typing import ClassVar

import jax
import numpy as np
import pytest

from congrasp.actors import process
from congrasp.actors.follower import Follower
from congrasp.actors.link import RunInfo
from congrasp.actors.process import ActorOptions
from congrasp.actors.rollout import Rollout, Trace
from congrasp.actors.training_set import TrainingSet
from congrasp.common.config import NetworkConfig, ObjectsConfig, RunConfig, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import PolicyBundle, policy_spec
from congrasp.common.request import GraspRequest
from congrasp.common.task import metrics
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import goal_of
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.reward import terms
from congrasp.common.task.types import Surface
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import encode
from congrasp.common.wire.messages import EPISODE, PRIVILEGED, RECORDED, validate
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.algorithms.protocol import rollout_form
from congrasp.learner.hub.staleness import StalenessManager
from tests.rollouts import learner_hub

T = 5
B = 3
CONFIG = RunConfig(
    name="t",
    environments=B,
    rollout_steps=T,
    episode_every=1,
    task=TaskConfig(approach_steps=3, hold_steps=2, hold_steps_max=2),
    objects=ObjectsConfig(count=1),
    network=NetworkConfig(hidden=(8,), encoder=2),
    rollouts_per_update=1,
)
HAND = get_hand("human")
SPEC = policy_spec(CONFIG.task, CONFIG.network)
FORM = rollout_form(CONFIG, SPEC, {**RECORDED, **PRIVILEGED})
FIELDS = episode_fields(CONFIG.task)


def invented(episodes: np.ndarray) -> Rollout:
    """A rollout of zeros in which every environment ended an episode with these metrics (B,
    fields).
    """
    zeros = {
        **dict.fromkeys(("q", "q_target"), (T, len(HAND.joints))),
        **dict.fromkeys(("u", "u_target"), (T, 6)),
        **dict.fromkeys(("wrist_position", "object_position"), (T, 3)),
        **dict.fromkeys(("wrist_quaternion", "object_quaternion"), (T, 4)),
        "contact_force": (T, len(HAND.links), 3),
        "action": (T, SPEC.action_size),
        "terms": (T, len(terms(CONFIG.task))),
        "errors": (T, len(metrics.specs(CONFIG.task))),
    }
    flags = {"table": np.zeros(T, bool), "terminal": np.arange(T) == T - 1}
    arrays = {
        **FORM.zeros(),
        "episodes": episodes,
        "occupancy": np.zeros((T, 3), np.float32),
        "has_episode": np.ones(B, bool),
        "trace": Trace(
            **{name: np.zeros(shape, np.float32) for name, shape in zeros.items()}, **flags
        ),
    }
    defaults = dict.fromkeys(Rollout._fields, np.zeros((T, B), np.float32))
    return Rollout(**{**defaults, **arrays})


class InventedWorker:
    """Stands in for environments: gives the same rollout again and again."""

    rollout: Rollout
    weights: ClassVar[list[np.ndarray]] = []
    pools: ClassVar[list[list[str]]] = []

    def __init__(self, *args, **options):
        neutral = goal_of(HAND, CONFIG.task, GraspRequest())
        goal = jax.tree.map(lambda array: array[None], neutral)
        surface = Surface(np.zeros((1, 8, 3), np.float32), np.zeros((1, 8), bool))
        reset_state = types.SimpleNamespace(object_index=np.zeros(1, int))
        self.state = types.SimpleNamespace(
            time=np.zeros(1), goal=goal, surface=surface, reset_state=reset_state
        )

    def configure(self, *args, **options):
        pass

    def renew_references(self):
        pass

    def weigh_objects(self, weight):
        self.weights.append(weight)

    def replace_objects(self, objects, bank):
        self.pools.append([obj.name for obj in objects])

    def collect(self, parameters, steps):
        return self.rollout

    def start(self, bank):
        pass

    def restart(self):
        pass


@pytest.fixture
def heard(monkeypatch):
    """Runs an actor on one invented rollout; what the learner took, and what the logs heard."""

    def run(rollout: Rollout, config: RunConfig = CONFIG):
        objects = [procedural.generate(0, "box"), procedural.generate(0, "mug")]
        monkeypatch.setattr(InventedWorker, "rollout", rollout, raising=False)
        monkeypatch.setattr(process, "RolloutWorker", InventedWorker)
        invented = types.SimpleNamespace(weight=np.ones(len(objects)))
        training = TrainingSet(
            objects, lambda: pytest.fail("nothing is compiled"), lambda: invented
        )
        numbers = []
        prepared = []
        monkeypatch.setattr(
            process, "prepare_physics", lambda *engine: prepared.append(len(numbers))
        )
        monkeypatch.setattr(
            process, "training_set", lambda hand, config, number: numbers.append(number) or training
        )
        broker = MemoryHub()
        stop = threading.Event()
        with MemoryTransport(broker) as server, MemoryTransport(broker) as peer:
            logs = server.subscribe(Keys("t").logs, depth=100)
            hub, rollouts = learner_hub(
                server,
                "t",
                config_json=to_json(config),
                schema=SPEC.schema,
                form=FORM,
                staleness=StalenessManager(0, 1),
            )
            algorithm = make_algorithm(SPEC, CONFIG)
            policy = jax.device_get(algorithm.policy(algorithm.init(0)))
            bundle = PolicyBundle(
                spec=SPEC,
                task=CONFIG.task,
                version=0,
                run_id="e",
                transitions=0,
                **policy._asdict(),
            )
            hub.publish_weights(bundle.to_message(), 0)
            options = ActorOptions(run="t", actor="a", physics="native", patience=5.0)
            actor = threading.Thread(
                target=process.run_actor,
                args=(peer, options, stop),
            )
            actor.start()
            batch = rollouts.next_batch(1, 30.0)
            stop.set()
            actor.join(30.0)
            received = list(iter(lambda: logs.receive(0.0), None))
        assert prepared == [0], "the engine is prepared before there are objects"
        # The next objects by their seeds
        assert list(np.diff(numbers)) == [1] * len(InventedWorker.pools)
        return batch, {key.split("/")[3]: message for key, message in received if "/actor/" in key}

    return run


@pytest.fixture
def run_for(monkeypatch):
    """Runs an actor whose learner needs rollouts of these arrays and policies of this schema."""

    def run(schema: str, arrays: tuple[str, ...]) -> None:
        info = RunInfo(to_json(CONFIG), "e", schema, arrays)
        monkeypatch.setattr(process.ActorLink, "wait_for_config", lambda link, stop: info)
        options = ActorOptions(run="t", actor="a", physics="native")
        with MemoryTransport(MemoryHub()) as transport:
            process.run_actor(transport, options, threading.Event())

    return run


def test_arrays_that_actors_do_not_record_are_refused(run_for):
    with pytest.raises(
        CongraspError, match=r"do not record: torque\. Start the actor with the learner's version"
    ):
        run_for(SPEC.schema, ("reward", "torque"))


def test_another_policy_schema_is_refused_before_objects_are_built(run_for, monkeypatch):
    monkeypatch.setattr(process, "training_set", lambda *_: pytest.fail("its objects were built"))
    with pytest.raises(
        CongraspError, match=rf"schema 0; this actor's have {SPEC.schema}\. Start the actor with"
    ):
        run_for("0", ("reward",))


def test_occupancy_metrics_by_hand():
    occupancy = np.array(
        [[0.5, 0.1, 0.0], [1.0, 0.2, 0.5], [1.25, 0.2, 0.25], [0.3, 1.5, 0.25]], np.float32
    )
    metrics = {"overflow": 2.0, "contacts_peak": 1.25, "rows_peak": 1.5, "solver_limited": 0.25}
    assert process.buffer_occupancy(occupancy) == metrics


def test_nonfinite_episode_metrics_are_left_out(heard):
    episodes = np.tile(np.arange(len(FIELDS), dtype=np.float32), (B, 1))
    episodes[0, FIELDS.index("episode/heading_rad")] = np.nan
    episodes[2, FIELDS.index("term/contact")] = np.inf
    batch, logs = heard(invented(episodes))
    assert batch is not None, "the learner refused the rollout"
    arrays = batch[0].arrays
    for i, name in enumerate(FIELDS):  # environment 1's
        np.testing.assert_array_equal(arrays[name], [i], err_msg=name)
    assert logs["metrics"].meta["values"]["episodes_left_out"] == 2
    episode = logs["episode"].meta["metrics"]
    assert "heading_rad" not in episode
    assert episode["heading_m"] == FIELDS.index("episode/heading_m")
    for message in logs.values():
        # A number that JSON has not would be an error here, and the end of the actor
        encode(message)
    validate(logs["episode"], EPISODE)


def test_objects_change_at_the_configured_interval(heard, monkeypatch):
    monkeypatch.setattr(InventedWorker, "pools", [])
    episodes = invented(np.zeros((B, len(FIELDS)), np.float32))
    heard(episodes)
    assert InventedWorker.pools == []
    heard(
        episodes,
        dataclasses.replace(CONFIG, objects=dataclasses.replace(CONFIG.objects, renew_every=1)),
    )
    assert InventedWorker.pools[0] == ["box_0", "mug_0"]


def test_objects_that_fall_are_drawn_more_often_with_by_failure(heard, monkeypatch):
    monkeypatch.setattr(InventedWorker, "weights", [])
    episodes = np.zeros((B, len(FIELDS)), np.float32)
    episodes[:, FIELDS.index("episode/object_index")] = np.arange(B) % 2
    # Of the two boxes one falls, the mug does not
    episodes[:, FIELDS.index("episode/held")] = np.arange(B) > 0
    heard(invented(episodes))
    assert InventedWorker.weights == []
    config = dataclasses.replace(
        CONFIG, objects=dataclasses.replace(CONFIG.objects, by_failure=True)
    )
    _, logs = heard(invented(episodes), config)
    box, mug = InventedWorker.weights[0]
    assert 1.0 < box <= 2.0
    assert 0.5 <= mug < 1.0
    values = logs["metrics"].meta["values"]
    # One of three fell, with the weight of five episodes beside those of each family.
    assert values["failure/box"] == pytest.approx((1 + 5 / 3) / 7)
    assert values["failure/mug"] == pytest.approx((5 / 3) / 6)


class Goal(str):
    """A goal with one row."""

    def row(self, index):
        return self


def state(name, obj=0):
    surface = Surface(np.zeros((1, 8, 3)), np.zeros((1, 8), bool))
    reset_state = types.SimpleNamespace(object_index=np.array([obj]))
    return types.SimpleNamespace(goal=Goal(name), surface=surface, reset_state=reset_state)


def rollout(*times, ended=()):
    """A trace whose wrist's height is the time in the episode."""
    fields = dict.fromkeys(Trace._fields, np.zeros((len(times), 2)))
    q = np.array(times, float)[:, None]
    return Trace(**{**fields, "q": q, "terminal": np.isin(np.arange(len(times)), ended)})


def test_episode_across_rollouts_is_followed_to_its_end():
    follower = Follower()
    # The first episode goes on from before, the next one begins with the third step.
    assert follower.add(rollout(8, 9, 0, ended=[1]), None, state("next", 3), due=True) is None
    assert follower.add(rollout(1, 2, 3), None, state("none"), due=False) is None
    traced = follower.add(rollout(4, 5, 0, ended=[1]), None, state("other"), due=False)
    assert traced.goal == "next"
    assert traced.object_index == 3
    assert traced.trace.q.ravel().tolist() == [0, 1, 2, 3, 4, 5]
    # It follows nothing then, until one is due again.
    assert (
        follower.add(rollout(0, 1, 2, 3, 4, 5, ended=[5]), state("fresh"), state("none"), due=False)
        is None
    )
    traced = follower.add(
        rollout(0, 1, 2, 3, 4, 5, 0, ended=[5]), state("fresh", 2), state("none"), due=True
    )
    assert traced.goal == "fresh"
    assert traced.object_index == 2
    assert len(traced.trace.q) == 6
    # What a rollout says of its last episode is not said of another.
    assert (
        follower.add(rollout(0, 1, 0, 1, 2, ended=[1, 4]), state("fresh"), state("none"), due=True)
        is None
    )
    assert (
        follower.add(rollout(0, 1, ended=[1]), state("last"), state("none"), due=True).goal
        == "last"
    )


def test_follower_ignores_finished_and_forgotten_episodes():
    follower = Follower()
    assert follower.add(rollout(7, 8, ended=[1]), None, state("none"), due=True) is None
    assert follower.add(rollout(0, 1), state("fresh"), state("none"), due=True) is None
    follower.forget()
    assert follower.add(rollout(2, 3), None, state("none"), due=True) is None
    assert follower.add(rollout(0, 1), state("again"), state("none"), due=True) is None
    assert follower.add(rollout(2, 3, ended=[1]), None, state("none"), due=True).goal == "again"
