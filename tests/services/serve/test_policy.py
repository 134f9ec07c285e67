"""The two implementations of `Policy`, a bundle in this process and a server's client, asked the
same.
"""

import dataclasses

import numpy as np
import pytest

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import (
    CongraspError,
    ContradictionError,
    RefusedError,
    UnknownConstraintError,
)
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.transport import urls
from congrasp.common.transport.ports import free_port
from congrasp.common.wire.codec import Message
from congrasp.services.client.episode_policy import EpisodePolicy
from congrasp.services.client.policy import Policy
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.inference import Inference, LocalPolicy, PolicyFunction, load_policy
from congrasp.services.serve.requests import Layout
from congrasp.services.serve.server import PolicyServer
from congrasp.services.serve.sources import follow_file
from congrasp.services.train.command import untrained
from tests import task

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
COMBINATIONS = (
    "heading",
    "affordance heading",
    "fingers heading",
    "pose",
    "trajectory",
    "pose trajectory affordance",
    "heading affordance pose trajectory fingers",
)


@pytest.fixture(scope="module")
def episode(example):
    return example


@pytest.fixture(scope="module")
def policies(tmp_path_factory) -> tuple[Policy, Policy]:
    """The same bundle in this process and behind a server."""
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(dataclasses.replace(task.policy(), version=7), path)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with urls.listen(endpoint, "server") as transport:
        server = PolicyServer(transport, "policy", follow_file(path))
        with load_policy(path) as local, PolicyClient(endpoint, timeout=10.0) as remote:
            yield local, remote
        server.close()


def goals(request: GraspRequest) -> dict[str, dict[str, np.ndarray]]:
    """Goal arrays of every constraint around the heading of a request; the trajectory ends at the
    graspable region.
    """
    heading = request.constraints["heading"]
    graspable = request.surface[request.surface[:, 2].argmin()]
    path = graspable + np.linspace(0.2, 0.0, task.TASK.trajectory_points)[:, None] * np.array(
        [0.0, 0.0, 1.0]
    )
    turns = np.tile(IDENTITY, (task.TASK.trajectory_points, 1))
    return {
        "heading": dict(heading),
        "affordance": {},
        "pose": {"q": np.full(20, 0.2), "position": heading["position"], "quaternion": IDENTITY},
        "trajectory": {"position": path, "quaternion": turns},
        "fingers": {"allowed": np.array([True, True, False, False, False])},
    }


def asked(request: GraspRequest, names: str) -> GraspRequest:
    """The request with these constraints, and with the object's upper half as avoid region."""
    chosen = {name: goals(request)[name] for name in names.split()}
    upper = request.surface[:, 2] > np.median(request.surface[:, 2])
    return dataclasses.replace(request, constraints=chosen, avoid=upper)


def same(one, other):
    """Whether two answers are the same to the last digit; times apart."""
    assert one.version == other.version
    assert one.active == other.active
    for name in ("action", "q_target", "u_target"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("names", COMBINATIONS)
def test_both_answers_are_equal(policies, episode, names):
    states = [
        {**episode.state, "q": episode.state["q"] + 0.01 * i, "table": np.bool_(i < 3)}
        for i in range(5)
    ]
    answers = []
    for policy in policies:
        policy.reset(asked(episode.request, names))
        answers.append(
            [
                *(policy.act(state) for state in states),
                *policy.act_each(states),
                policy.act(states[0]),
            ]
        )
        policy.reset(asked(episode.request, names))
        answers[-1] += [*policy.act_each(states), policy.act(states[0])]
    for one, other in zip(*answers, strict=True):
        same(one, other)
    first, second = answers[0][:2]
    assert first.version == 7
    assert first.active
    assert not np.array_equal(first.action, second.action)


def test_answers_may_be_changed(policies, episode):
    for policy in policies:
        answers = []
        for factor in (1.0, 0.0):
            policy.reset(episode.request)
            first = policy.act(episode.state)
            for array in first[:3]:
                array *= factor
            answers.append(policy.act(episode.state))
        same(*answers)


BAD_REQUESTS = [
    ({"constraints": {"levitation": {}}}, UnknownConstraintError),
    ({"constraints": {"heading": {}}}, RefusedError),
    ({"constraints": {"heading": {"weight": np.zeros(1)}}}, RefusedError),
    ({"constraints": {"affordance": {}}}, RefusedError),
    ({"surface": np.zeros((5, 2))}, RefusedError),
    ({"wrist": (np.full(3, np.nan), IDENTITY)}, RefusedError),
    ({"q": "open"}, RefusedError),
    ({"constraints": {"heading": "above"}}, RefusedError),
    ({"constraints": ["heading"]}, RefusedError),
    ({"q": np.full(20, 45.0)}, RefusedError),
    ({"surface": 1000 * np.random.default_rng(0).uniform(-0.05, 0.05, (64, 3))}, RefusedError),
    ({"wrist": np.eye(4)}, RefusedError),
    ({"object_pose": np.eye(4)}, RefusedError),
    ({"q": None, "object_pose": None}, RefusedError),
    ({"above": True}, RefusedError),
]
BAD_STATES = [
    ({"u": np.zeros(5)}, r"shape \(5,\)"),
    ({"weight": np.zeros(1)}, "unknown field 'weight'"),
    ({"u": np.full(6, np.inf)}, "'u' is not finite"),
    ({"u": "still"}, "not a numeric array"),
    ({"q": None}, "lacks the field 'q'"),
]


@pytest.mark.parametrize(("change", "error"), BAD_REQUESTS)
def test_bad_requests(policies, episode, change, error):
    messages = []
    for policy in policies:
        with pytest.raises(CongraspError) as caught:
            policy.reset(dataclasses.replace(episode.request, **change))
            policy.act(episode.state)
        assert type(caught.value) is error
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    assert "\n" not in messages[0]


@pytest.mark.parametrize(("change", "words"), BAD_STATES)
def test_bad_states_leave_the_episode(policies, episode, change, words):
    messages = []
    answers = []
    for policy in policies:
        policy.reset(asked(episode.request, "heading"))
        policy.act(episode.state)
        state = {
            name: value for name, value in {**episode.state, **change}.items() if value is not None
        }
        with pytest.raises(RefusedError, match=words) as caught:
            policy.act(state)
        messages.append(str(caught.value))
        answers.append(policy.act(episode.state))
    assert messages[0] == messages[1]
    same(*answers)


def test_a_missing_field_of_a_request_is_named(policies, episode):
    for policy in policies:
        with pytest.raises(RefusedError, match=r"^The request lacks 'surface' and 'wrist'"):
            policy.reset(dataclasses.replace(episode.request, surface=None, wrist=None))


@pytest.mark.parametrize("where", ["q", "u", "q_initial", "pose_q"])
def test_angles_in_degrees_are_refused_wherever_they_are(policies, episode, where):
    request = asked(episode.request, "pose")
    degrees = np.full(20, 12.5)
    state = episode.state
    if where == "pose_q":
        request.constraints["pose"]["q"] = degrees
    for policy in policies:
        with pytest.raises(
            RefusedError, match=rf"The field '{where}' has an angle of 12\.5\. Give it in radians"
        ):
            policy.reset(
                dataclasses.replace(request, q=degrees if where == "q_initial" else request.q)
            )
            policy.act({**state, where: degrees[: state[where].size]} if where in state else state)


def test_both_refuse_a_contradiction(policies, episode):
    highest = episode.request.surface[episode.request.surface[:, 2].argmax()]
    request = asked(episode.request, "trajectory affordance")
    path = {
        **goals(episode.request)["trajectory"],
        "position": np.tile(highest, (task.TASK.trajectory_points, 1)),
    }
    for policy in policies:
        policy.reset(
            dataclasses.replace(request, constraints={"affordance": {}, "trajectory": path})
        )
        with pytest.raises(
            ContradictionError, match="trajectory ends nearer to the avoid region than to the grasp"
        ):
            policy.act(episode.state)


def test_an_episode_must_have_begun(episode):
    policy = EpisodePolicy()
    for ask in (lambda: policy.act(episode.state), lambda: policy.act_each([episode.state])):
        with pytest.raises(RefusedError, match="no episode yet"):
            ask()


def test_policies_are_loaded_by_hand_and_by_file(tmp_path, monkeypatch):
    monkeypatch.setattr(PolicyFunction, "warm_up", lambda *arguments: None)
    with load_policy() as policy:
        assert policy.metadata()["hand"] == "human"
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        load_policy("paw")
    with pytest.raises(CongraspError, match=r"none\.safetensors cannot be read"):
        load_policy(tmp_path / "none.safetensors")


STUDENT = RunConfig(
    task=TaskConfig(constraints=("heading",), observation="tracked", history=4),
    network=NetworkConfig(hidden=(16,), encoder=4),
)


class ObservedPolicy(LocalPolicy):
    """Keeps the fields of its queries; the next one can be in the layout of another server."""

    def __init__(self, bundle):
        self.sent = []
        self.is_outdated = False
        self._observed = Layout(get_hand(bundle.spec.hand), bundle.task)
        super().__init__(bundle)

    def _query(self, query):
        if self.is_outdated:
            self.is_outdated = False
            query = Message(query.arrays, {**query.meta, "layout": "of another server"})
        else:
            self.sent.append(self._observed.unpack(self._observed.parse(query).vectors))
        return super()._query(query)


def test_history_of_a_student(episode):
    """The vector that is inferred from holds the control steps before this one, newest first, and
    at the begin its first reading; velocities and forces that a client sends change nothing."""
    policy = ObservedPolicy(untrained(STUDENT))
    sent = policy.sent
    policy.reset(
        dataclasses.replace(
            episode.request, constraints={"heading": episode.request.constraints["heading"]}
        )
    )
    states = [
        {
            **episode.state,
            "q": episode.state["q"] + 0.01 * i,
            "object_position": np.full(3, 0.1 * i),
        }
        for i in range(6)
    ]
    answers = [policy.act(state) for state in states]
    q = np.float32([state["q"] for state in states])
    np.testing.assert_array_equal(sent[0]["past_q"][0], q[[0, 0, 0]])
    np.testing.assert_array_equal(sent[1]["past_q"][0], q[[0, 0, 0]])
    np.testing.assert_array_equal(sent[2]["past_q"][0], q[[1, 0, 0]])
    np.testing.assert_array_equal(sent[5]["past_q"][0], q[[4, 3, 2]])
    np.testing.assert_allclose(
        sent[5]["past_object_position"][0], [[0.4] * 3, [0.3] * 3, [0.2] * 3], rtol=1e-6
    )
    targets = np.float32([answers[i].q_target for i in (3, 2, 1)])
    np.testing.assert_array_equal(sent[5]["past_q_target"][0], targets)
    np.testing.assert_array_equal(sent[5]["q_target"][0], answers[4].q_target)
    same(
        policy.act_each([states[0]])[0],
        policy.act_each([{**states[0], "object_velocity": np.ones(3)}])[0],
    )
    expected = policy.act_each([states[3]])[0]
    policy.is_outdated = True
    same(policy.act_each([states[3]])[0], expected)
    moved = {**states[0], "u": states[0]["u"] + np.array([0.01, 0, 0, 0, 0, 0])}
    assert not np.array_equal(
        policy.act_each([moved])[0].u_target, policy.act_each([states[0]])[0].u_target
    )


def test_a_policy_with_a_camera_takes_clouds_and_no_pose(episode):
    """Its request and states hold clouds; a newer one changes the answer, and a pose is refused."""
    camera = dataclasses.replace(STUDENT.task, observation="camera")
    policy = LocalPolicy(untrained(dataclasses.replace(STUDENT, task=camera)))
    tracked = episode.request
    cloud = np.asarray(episode.request.surface) + episode.request.object_pose[0]
    heading = tracked.constraints["heading"]
    heading = {**heading, "position": np.asarray(heading["position"]) + tracked.object_pose[0]}
    request = dataclasses.replace(
        tracked,
        constraints={"heading": heading},
        surface=None,
        object_pose=None,
        avoid=None,
        cloud=cloud[:100],
    )
    state = {name: episode.state[name] for name in ("q", "u", "table") if name in episode.state}
    policy.reset(request)
    for _ in range(3):
        answer = policy.act(state)
    assert answer.q_target.shape == state["q"].shape
    assert policy.metadata()["observation"] == "camera"
    again = policy.act_each(
        [state, {**state, "cloud": cloud[:100]}, {**state, "cloud": cloud[:60] + 0.01}]
    )
    np.testing.assert_array_equal(again[0].action, again[1].action)
    assert not np.array_equal(again[2].action, again[0].action)
    with pytest.raises(RefusedError, match="unknown field 'object_position'"):
        policy.act({**state, "object_position": np.zeros(3)})
    with pytest.raises(RefusedError, match="lacks 'q'"):
        policy.reset(dataclasses.replace(request, q=None))


class Recorder(EpisodePolicy):
    """Keeps the fields of each query, and wants every joint at zero."""

    def __init__(self, task):
        super().__init__()
        self.function = PolicyFunction(get_hand(task.hand), task)
        self.sent = []

    def _fetch_metadata(self):
        return self.function.metadata()

    def _query(self, query):
        layout = self.function.layout
        self.sent.append(
            {name: x[0] for name, x in layout.unpack(layout.parse(query).vectors).items()}
        )
        zeros = np.zeros((1, len(layout.hand.motors) + len(layout.hand.joints) + 12), np.float32)
        return Inference(zeros, [[]]).reply({"version": 1, "total_ms": 0.0})


@pytest.mark.parametrize(
    ("settle", "expected"), [(0.04, [0.0, 6.0, 4.0, 4.0, 4.0]), (0.0, [0.0] * 5)]
)
def test_a_student_averages_the_resting_object(episode, settle, expected):
    """Readings 0, 12, 0, 90 and 0 mm from the first one: the fourth has moved; one that is refused
    does not count.
    """
    policy = Recorder(dataclasses.replace(STUDENT.task, sensing=SensingConfig(settle=settle)))
    policy.reset(
        dataclasses.replace(
            episode.request, constraints={"heading": episode.request.constraints["heading"]}
        )
    )
    start = episode.state["object_position"]
    policy.act(episode.state)
    for x in (0.012, 0.0, 0.09, 0.0):
        with pytest.raises(RefusedError, match="unknown field 'colour'"):
            policy.act({**episode.state, "colour": np.zeros(3)})
        policy.act({**episode.state, "object_position": start + np.array([x, 0.0, 0.0])})
    positions = [
        1e3 * (sent["object_position_initial"] - start) for sent in policy.sent if "past_q" in sent
    ]
    np.testing.assert_allclose([x for x, _, _ in positions], expected, atol=1e-4)


def test_normals_of_an_episode_are_those_of_its_points(episode):
    """New points of a state have zeros, for which the policy estimates some."""
    policy = Recorder(TaskConfig(constraints=("heading",), surface_normals=True))
    normals = np.eye(3, dtype=np.float32)[np.arange(len(episode.request.surface)) % 3]
    policy.reset(dataclasses.replace(episode.request, normals=normals))
    for new in ({}, {"surface_points": episode.request.surface}):
        policy.act({**episode.state, **new})
    first, moved = (sent["surface_normals"] for sent in policy.sent)
    np.testing.assert_array_equal([first, moved], [normals, 0 * normals])
