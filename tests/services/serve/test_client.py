"""The thin client against a server of canned answers: what it sends, remembers, and survives."""

import contextlib

import numpy as np
import pytest

from congrasp.common.errors import RefusedError, TransportError
from congrasp.common.hands import get_hand
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.ports import free_port, local_url, shifted
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.client.worker_endpoints import worker_endpoints
from congrasp.services.ops.certificates import create_authority, issue
from congrasp.services.serve.inference import Inference, PolicyFunction
from tests.waits import eventually

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
REQUEST = GraspRequest(
    {"heading": {"position": np.zeros(3), "direction": np.array([0.0, 0.0, -1.0])}},
    surface=np.zeros((4, 3)),
    q=np.full(20, 0.1),
    wrist=(np.array([0.0, 0.0, 0.3]), IDENTITY),
    object_pose=(np.array([0.0, 0.0, 0.05]), IDENTITY),
)
STATE = {
    "q": np.full(20, 0.2),
    "u": np.zeros(6),
    "object_position": np.array([0.0, 0.0, 0.05]),
    "object_quaternion": IDENTITY,
}


HAND = get_hand("human")


class CannedServer:
    """Answers the n-th query with targets of value n, and keeps the fields of the queries."""

    def __init__(self, endpoint: str, points: int = 4):
        self.function = PolicyFunction(HAND, TaskConfig(surface_points=points, trajectory_points=2))
        self.fields: list[dict[str, np.ndarray]] = []
        self.described = 0
        self.transport = ZenohTransport(listen=[endpoint], flows=("policy",))
        self.transport.serve(below(Keys("policy").act), self._act)
        self.transport.serve(Keys("policy").health, self._describe)

    def _describe(self, key: str, request: Message) -> Message:
        self.described += 1
        return Message({}, self.function.metadata())

    def _act(self, key: str, request: Message) -> Message:
        layout = self.function.layout
        self.fields.append(
            {name: x[0] for name, x in layout.unpack(layout.parse(request).vectors).items()}
        )
        n = np.float32(len(self.fields))
        targets = np.concatenate([np.zeros(26), np.full(20, n), np.full(6, -n)]).astype(np.float32)
        return Inference(targets[None], [["words"]]).reply({"version": 3, "total_ms": 0.5})

    def close(self) -> None:
        self.transport.close()


@pytest.fixture
def endpoint():
    return f"tcp/127.0.0.1:{free_port()}"


def answered(client):
    with contextlib.suppress(TransportError):
        return client.act(STATE)


def test_the_client_remembers_the_episode_and_the_previous_targets(endpoint):
    server = CannedServer(endpoint)
    with PolicyClient(endpoint) as client:
        client.reset(REQUEST)
        answer = client.act(STATE)
        client.act({**STATE, "table": False})
        client.reset(REQUEST)
        client.act(STATE)
    server.close()
    first, second, third = server.fields
    assert server.described == 1
    assert answer.version == 3
    assert answer.active == ("words",)
    assert answer.server_ms == 0.5
    np.testing.assert_array_equal(answer.u_target, np.full(6, -1.0))
    np.testing.assert_allclose(first["q_target"], REQUEST.q, rtol=1e-6)
    np.testing.assert_array_equal(second["q_target"], np.full(20, 1.0))
    np.testing.assert_array_equal(second["u_target"], np.full(6, -1.0))
    np.testing.assert_allclose(third["q_target"], REQUEST.q, rtol=1e-6)
    assert [float(arrays["time"]) for arrays in (first, second, third)] == [0.0, 1.0, 0.0]
    assert [bool(arrays["table"]) for arrays in (first, second, third)] == [True, False, True]
    np.testing.assert_allclose(second["q_initial"], REQUEST.q, rtol=1e-6)


def test_the_client_reconnects_to_a_restarted_server(endpoint):
    server = CannedServer(endpoint)
    with PolicyClient(endpoint) as client:
        client.reset(REQUEST)
        client.act(STATE)
        server.close()
        with pytest.raises(TransportError):
            client.act(STATE)
        server = CannedServer(endpoint)
        eventually(lambda: answered(client))
        # The failed query moved neither the clock nor the targets of the episode.
        assert float(server.fields[0]["time"]) == 1.0
        np.testing.assert_array_equal(server.fields[0]["q_target"], np.full(20, 1.0))
    server.close()


def test_the_layout_is_requested_again_when_another_server_has_another_one(endpoint):
    server = CannedServer(endpoint)
    with PolicyClient(endpoint) as client:
        client.reset(REQUEST)
        client.act(STATE)
        assert client.act(STATE).q_target[0] == 2.0
        server.close()
        server = CannedServer(endpoint, points=3)
        eventually(lambda: answered(client))
        client.act(STATE)
        assert server.described == 1
        assert server.fields[1]["surface_points"].shape == (3, 3)
        assert [float(fields["time"]) for fields in server.fields] == [2.0, 3.0]
    server.close()


def test_another_server_with_the_policy_of_another_hand_is_refused(endpoint):
    server = CannedServer(endpoint)
    with PolicyClient(endpoint) as client:
        client.reset(REQUEST)
        client.act(STATE)
        server.function = PolicyFunction(get_hand("allegro"), TaskConfig(hand="allegro"))
        for ask in (lambda: client.act(STATE), client.metadata):
            with pytest.raises(
                RefusedError, match="The policy is for the hand 'allegro', not 'human'"
            ):
                ask()
    server.close()


@pytest.mark.parametrize(
    ("health", "ports"),
    [
        ({}, [7458]),
        ({"workers": 3, "worker": 1}, [7457, 7458, 7459]),
        ({"workers": 2}, [7458, 7459]),
        ({"workers": 3, "worker": 3}, [7458]),
        ({"workers": "3"}, [7458]),
    ],
)
def test_endpoints_of_workers(health, ports):
    endpoints = worker_endpoints("tcp/10.0.0.7:7458", health)
    assert endpoints == [f"tcp/10.0.0.7:{port}" for port in ports]


def test_another_server_on_the_next_port_is_not_used(endpoint):
    server = CannedServer(shifted(endpoint, 1))
    with pytest.raises(TransportError, match=f"No response from {endpoint}"):
        PolicyClient(endpoint, wait=0.5)
    assert server.described == 1
    server.close()


def test_queries_of_health_in_a_row_reach_a_server_with_certificates(tmp_path):
    """Such a server drops queries of the same connection within 10 ms."""
    certs = tmp_path / "certs"
    create_authority(certs, run="safe")
    issue(certs, "server")
    issue(certs, "client")
    endpoint = local_url()
    with urls.listen(endpoint, "server", certs=certs) as transport:
        transport.serve(Keys("policy").health, lambda key, request: Message({}, {"ready": True}))
        with PolicyClient(endpoint, certs=certs, wait=30.0) as client:
            for _ in range(10):
                assert client.health() == {"ready": True}


def test_a_missing_server_is_one_line(endpoint):
    with pytest.raises(TransportError, match="No response from"):
        PolicyClient(endpoint, wait=0.5)
