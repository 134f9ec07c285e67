"""Who gets in, and what those inside may do: real sessions over TLS, with good, bad and no
certificates.
"""

import contextlib
import dataclasses
import itertools
import pathlib
import subprocess
import sys
import time

import numpy as np
import pytest
import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from congrasp.actors.link import ActorLink
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.certificates import read
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.security import RIGHTS, Credentials
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message, encode
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.queue import RolloutQueue
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.certificates import create_authority, issue, revoke
from tests.rollouts import bundle, learner_hub, rollout
from tests.waits import eventually

KEYS = Keys("safe")
ME = "0.a"
OTHER = "1.b"
ACTOR = """
import sys
from congrasp.actors.link import ActorLink
from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls

try:
    transport = urls.connect(sys.argv[1], "actor", certs=sys.argv[2])
    with transport, ActorLink(transport, "safe", "0.z") as link:
        link.config(20)
        print("ready", flush=True)
        while True:
            link.acquire_ticket(1.0)
except CongraspError as error:
    sys.exit(f"congrasp: error: {error}")
"""
"""An actor that does nothing but ask for tickets, and ends as the command does."""


@pytest.fixture(scope="module")
def certs(tmp_path_factory):
    """An authority with a certificate of every role, a second actor's, and an expired one."""
    folder = tmp_path_factory.mktemp("certs")
    create_authority(folder, run="safe")
    for role in ("learner", "actor", "actor", "server", "client", "observer"):
        issue(folder, role)
    issue(folder, "actor", number=9, days=-1)
    return folder


@pytest.fixture(scope="module")
def evil(tmp_path_factory):
    """Another authority, which certifies everything."""
    folder = tmp_path_factory.mktemp("evil")
    create_authority(folder, run="safe")
    for role in ("learner", "actor"):
        issue(folder, role)
    return folder


@dataclasses.dataclass
class Run:
    """A learner and a policy server that ask for certificates."""

    certs: pathlib.Path
    endpoint: str
    policy: str
    hub: LearnerHub
    rollouts: RolloutQueue
    transport: ZenohTransport
    stack: contextlib.ExitStack

    def connect(self, name, endpoint=None, **options):
        """A session of whoever has the certificate of this name."""
        credentials = Credentials(self.certs / name, name.split(".")[0])
        options = {"flows": ("policy",)} | options if endpoint == self.policy else options
        endpoint = endpoint or self.endpoint
        return self.stack.enter_context(
            ZenohTransport(connect=[endpoint], credentials=credentials, **options)
        )


@contextlib.contextmanager
def listening(certs):
    """A run that waits for peers."""
    endpoint, policy = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    with contextlib.ExitStack() as stack:
        learner, server = (Credentials(certs / f"{role}.0", role) for role in ("learner", "server"))
        transport = stack.enter_context(
            ZenohTransport(listen=[endpoint], credentials=learner, revocation_seconds=0.1)
        )
        hub, rollouts = learner_hub(transport, "safe")
        hub.publish_weights(bundle(0), 0)
        serving = stack.enter_context(
            ZenohTransport(listen=[policy], credentials=server, flows=("policy",))
        )
        for key in (below(KEYS.act), KEYS.health):
            serving.serve(key, lambda key, request: Message(meta={"ready": True, "served": key}))
        yield Run(certs, endpoint, policy, hub, rollouts, transport, stack)


@pytest.fixture
def fresh(certs):
    """A run of a test's own."""
    with listening(certs) as listeners:
        yield listeners


@pytest.fixture(scope="module")
def shared(certs):
    with listening(certs) as listeners:
        yield listeners


@pytest.fixture
def run(shared):
    """The run of the module; sessions that a test opens with it end with the test."""
    with contextlib.ExitStack() as stack:
        yield dataclasses.replace(shared, stack=stack)


def heard(subscription, seconds=0.7):
    """Keys of all that arrives within a while."""
    messages = []
    deadline = time.monotonic() + seconds
    while (rest := deadline - time.monotonic()) > 0:
        if received := subscription.receive(rest):
            messages.append(received[0])
    return messages


def answers(transport, key, message=None):
    try:
        return transport.query(key, message or Message(), timeout=5)
    except TransportError as error:
        assert "No response" in str(error)
        return None


# --- what is allowed works ---


def test_with_the_right_certificates_a_run_works_from_end_to_end(fresh):
    observer = fresh.connect("observer.0")
    server = fresh.connect("server.0")
    logs = observer.subscribe(KEYS.logs, depth=64)
    transport = fresh.connect("actor.0")
    with ActorLink(transport, "safe", ME, request_timeout=5.0) as link:
        assert link.config(10).schema == "s"
        assert link.weights(-1).meta["version"] == 0
        for _ in range(2):
            ticket = link.acquire_ticket(5)
            assert link.upload(rollout(), ticket).result(10) == "accepted"
        assert len(fresh.rollouts.next_batch(2, 5)) == 2
        fresh.hub.publish_weights(bundle(1), 1)
        # The announcement arrives by itself: without one, a link that holds the newest version asks
        # for nothing.
        eventually(lambda: (new := link.weights(0)) and new.meta["version"] == 1)
        key = KEYS.log("metrics", "actor", ME)
        transport.publish(key, Message(meta={"values": {}}))
        eventually(lambda: (received := logs.receive(5)) and received[0] == key)
        status = eventually(
            lambda: (now := observer.query(KEYS.status, Message(), timeout=5).meta) and now
        )
        assert ("actor", ME) in {(role["role"], role["id"]) for role in status["roles"]}
        assert status["counters"]["accepted"] == 2
        assert status["counters"]["rejected"] == 0
    assert (
        server.query(
            KEYS.weights_for("server", "0.s"), Message(meta={"newer_than": -1}), timeout=5
        ).meta["version"]
        == 1
    )
    with PolicyClient(fresh.policy, "safe", certs=fresh.certs / "client.0") as client:
        assert client.health()["ready"]
    assert answers(fresh.connect("client.0", fresh.policy), KEYS.act_for("0.c")).meta[
        "served"
    ] == KEYS.act_for("0.c")
    assert answers(fresh.connect("observer.0", fresh.policy), KEYS.health)


def test_an_actor_whose_certificate_came_later_works_at_once(run):
    certificate = issue(run.certs, "actor", number=77)
    link = ActorLink(run.connect(certificate.name), "safe", "77.x", request_timeout=5.0)
    with link:
        link.config(10)
        assert link.upload(rollout(), link.acquire_ticket(5)).result(10) == "accepted"


def test_an_actor_reconnects_to_a_restarted_learner(certs):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    credentials = Credentials(certs / "actor.0", "actor")
    learner = Credentials(certs / "learner.0", "learner")
    flows = ("control",)
    server = ZenohTransport(listen=[endpoint], credentials=learner, flows=flows)
    with ZenohTransport(connect=[endpoint], credentials=credentials, flows=flows) as actor:
        server.close()
        with ZenohTransport(listen=[endpoint], credentials=learner, flows=flows) as server:
            for keys in (KEYS.tickets, KEYS.status):
                server.serve(keys, lambda key, request: Message(meta={"here": True}))
            eventually(lambda: answers(actor, KEYS.ticket(ME)))
            assert answers(actor, KEYS.ticket(OTHER)) is None
            assert answers(actor, KEYS.status) is None


# --- what is not allowed ---

EVERYTHING = {
    "config": KEYS.config,
    "nobody's weights": KEYS.weights,
    "my weights": KEYS.weights_for("actor", ME),
    "another's weights": KEYS.weights_for("actor", OTHER),
    "a server's weights": KEYS.weights_for("server", "0.s"),
    "status": KEYS.status,
    "my ticket": KEYS.ticket(ME),
    "my rollout": KEYS.rollout(ME),
    "another's ticket": KEYS.ticket(OTHER),
    "another's rollout": KEYS.rollout(OTHER),
    "everyone's": "congrasp/safe/rollout/*",
    "another run's status": Keys("other").status,
    "whatever there is": "congrasp/**",
    "the learner's innards": "@/{learner}/**",
}


MAY = {
    "actor.0": {"config", "my weights", "my ticket", "my rollout"},
    "server.0": {"config", "a server's weights"},
    "observer.0": {"config", "status"},
    "client.0": set(),
    "learner.0": set(),
}
MAY_ASK_THE_POLICY = {
    "client.0": {KEYS.act_for("0.c"), KEYS.health},
    "observer.0": {KEYS.health},
    "actor.0": set(),
}


def test_each_role_may_query_only_its_keys(run):
    learner = str(run.transport.session(KEYS.config).info.zid())

    def answered(transport, key):
        replies = transport.session(key).get(
            key.replace("{learner}", learner), FifoChannel(8), timeout=3.0
        )
        return bool(list(replies))  # an empty question is answered with an error in words

    for who, may in MAY.items():
        transport = run.connect(who)
        assert {name for name, key in EVERYTHING.items() if answered(transport, key)} == may, who
    for who, may in MAY_ASK_THE_POLICY.items():
        session = run.connect(who, run.policy)
        policy_keys = (KEYS.act_for("0.c"), KEYS.act_for("1.c"), KEYS.act, KEYS.health)
        assert {key for key in policy_keys if answers(session, key)} == may, who


@pytest.mark.parametrize("who", ["actor.0", "client.0", "observer.0", "server.0"])
def test_only_the_learner_publishes_and_serves_its_keys(run, who):
    """Forged weights, announcements, logs and answers reach neither the learner nor those connected
    to it.
    """
    thief = run.connect(who)
    victim = run.connect("actor.1")
    observer = run.connect("observer.0")
    announcements = victim.subscribe(KEYS.announcement, depth=64)
    logs = observer.subscribe(KEYS.logs, depth=64)
    here = (
        run.transport.subscribe("congrasp/safe/**", depth=64),
        run.transport.subscribe(KEYS.logs, depth=64),
    )
    queries = []
    for key in (
        KEYS.weights,
        KEYS.status,
        KEYS.config,
        KEYS.ticket(OTHER),
        KEYS.rollout(OTHER),
        KEYS.act,
    ):
        thief.serve(key, lambda key, request: queries.append(key) or Message(meta={"forged": True}))
    time.sleep(0.3)
    for key in (
        KEYS.announcement,
        KEYS.log("metrics", "learner", "0"),
        KEYS.log("event", "actor", OTHER),
    ):
        thief.publish(key, Message(meta={"forged": True}))
    assert (
        heard(announcements) == heard(logs, 0.1) == heard(here[0], 0.1) == heard(here[1], 0.1) == []
    )
    assert "forged" not in observer.query(KEYS.status, Message(), timeout=5).meta
    assert (
        "forged"
        not in victim.query(
            KEYS.weights_for("actor", OTHER), Message(meta={"newer_than": -1}), timeout=5
        ).meta
    )
    assert answers(run.transport, KEYS.act) is None
    assert queries == []


def test_actors_cannot_use_keys_of_one_another(fresh):
    actor = fresh.connect("actor.0")
    victim = fresh.connect("actor.1")
    observer = fresh.connect("observer.0")
    everything = [
        actor.subscribe(key, depth=64)
        for key in ("congrasp/**", KEYS.logs, "congrasp/safe/alive/**")
    ]
    seen = []
    actor.watch_alive(KEYS.everyone, lambda key, alive: seen.append(key))
    victim.declare_alive(KEYS.alive("actor", OTHER, "01"))
    for name, session in (
        (OTHER, victim),
        ("1.c", victim),
        (ME, observer),
        (ME, victim),
        ("learner", victim),
    ):
        session.publish(KEYS.log("event", "actor", name), Message())
    for role, name in (("actor", OTHER), ("learner", "0"), ("actor", "a"), ("actor", ME)):
        actor.declare_alive(KEYS.alive(role, name, "66"))
    roles = eventually(lambda: (roles := fresh.hub.status()["roles"]) and len(roles) >= 3 and roles)
    assert {(role["role"], role["id"], role["incarnation"]) for role in roles} == {
        ("learner", "0", fresh.rollouts.session_id),
        ("actor", OTHER, "01"),
        ("actor", ME, "66"),
    }
    assert [heard(one, 0.3) for one in everything] == [[], [], []]
    # Only its own tokens come back to it.
    assert {key.split("/")[-1] for key in seen} <= {"66"}
    # Its key is its own, but the message says another's name.
    forged = rollout(actor=OTHER, incarnation="01", sequence=0, run_id="e", ticket="t")
    reply = actor.query(KEYS.rollout(ME), forged, timeout=5).meta
    assert reply["outcome"] == "refused"
    assert "the key of another actor" in reply["why"]
    assert fresh.hub.status()["counters"]["accepted"] == 0


def test_a_client_receives_no_logs(run):
    logs = run.connect("client.0").subscribe(KEYS.logs, depth=64)
    also = run.connect("client.0", run.policy, flows=("policy",)).subscribe(
        "congrasp/*/policy/**", depth=64
    )
    run.connect("actor.0").publish(KEYS.log("metrics", "actor", ME), Message())
    run.transport.publish(KEYS.log("metrics", "learner", "0"), Message())
    assert heard(logs) == heard(also, 0.1) == []


def _raw_session(endpoint, folder, mode):
    """A session of somebody who does not use our code."""
    config = zenoh.Config.from_json5(
        f"""{{mode: "{mode}", listen: {{endpoints: []}}, scouting: {{multicast: {{enabled: false}}}},
             connect: {{endpoints: ["{endpoint.replace("tcp/", "tls/")}"], timeout_ms: 5000}},
             transport: {{link: {{tls: {{root_ca_certificate: "{folder}/ca.crt", enable_mtls: true,
             connect_certificate: "{folder}/tls.crt", connect_private_key: "{folder}/tls.key"}}}}}}}}"""
    )
    return zenoh.open(config)


@pytest.mark.parametrize("mode", [pytest.param("peer", marks=pytest.mark.slow), "router"])
def test_another_mode_of_connecting_gives_no_more(run, mode):
    """Zenoh's peers and routers exchange more than its clients; the same rules hold for them."""
    with _raw_session(run.endpoint, run.certs / "actor.0", mode) as session:
        stolen = [session.declare_queryable(key, FifoChannel(8)) for key in (KEYS.status, KEYS.act)]
        logs = session.declare_subscriber("congrasp/**", RingChannel(64))
        time.sleep(0.5)
        run.transport.publish(KEYS.log("metrics", "learner", "0"), Message())
        observer = run.connect("observer.0")
        assert "counters" in observer.query(KEYS.status, Message(), timeout=5).meta
        assert answers(run.transport, KEYS.act) is None
        assert logs.try_recv() is None
        assert all(one.try_recv() is None for one in stolen)
        for key in (KEYS.status, KEYS.ticket(OTHER), "congrasp/**"):
            assert not [
                reply for reply in session.get(key, FifoChannel(8), timeout=1.0) if reply.ok
            ]


def test_every_right_is_a_key_of_a_run():
    """A right for a key that does not exist any more would be an open door without a room."""
    real = {
        KEYS.config,
        KEYS.status,
        KEYS.announcement,
        KEYS.health,
        KEYS.logs,
        KEYS.act_for("name"),
        KEYS.weights_for("actor", "name"),
        KEYS.weights_for("server", "name"),
        KEYS.ticket("{name}".strip("{}")),
        KEYS.rollout("name"),
        KEYS.alive("actor", "name", "x"),
        KEYS.alive("server", "x", "x"),
        KEYS.alive("recorder", "x", "x"),
        KEYS.log("x", "actor", "name"),
    }
    real = {key.removeprefix("congrasp/safe/").replace("/x", "/*") for key in real}
    keys_of_rights = set()
    for listener in RIGHTS.values():
        for rights in listener.values():
            for keys in dataclasses.asdict(rights).values():
                keys_of_rights |= {key.replace("{name}", "name") for key in keys}
    assert keys_of_rights == real


# --- who does not get in ---


def _refused(endpoint, credentials, words):
    """Connecting is refused in one line, long before the patience of who connects is spent."""
    began = time.monotonic()
    with pytest.raises(CongraspError, match=words) as caught:
        ZenohTransport(connect=[endpoint], credentials=credentials, wait=50.0)
    assert time.monotonic() - began < 40
    assert "\n" not in str(caught.value)


def test_wrong_credentials_do_not_get_in(run, evil, tmp_path):
    _refused(run.endpoint, Credentials(evil / "actor.0", "actor"), "not trusted: .*authority")
    mixed = tmp_path / "mixed"  # knows the right authority, but is certified by another
    mixed.mkdir()
    for name, source in (
        ("ca.crt", run.certs),
        ("tls.crt", evil / "actor.0"),
        ("tls.key", evil / "actor.0"),
    ):
        (mixed / name).write_bytes((source / name).read_bytes())
    _refused(run.endpoint, Credentials(mixed, "actor"), "refuses the certificate .*: not accepted")
    _refused(
        run.endpoint,
        Credentials(run.certs / "actor.9", "actor"),
        "refuses the certificate .*: expired",
    )
    _refused(run.endpoint, None, "requires certificates.*Pass --certs")
    _refused(run.endpoint, Credentials(tmp_path, "actor"), "cannot be used")


@pytest.mark.parametrize(
    ("folder", "who"), [("certs", "actor.0"), ("evil", "learner.0"), ("certs", "actor.9")]
)
def test_no_other_certificate_passes_for_the_learner(folder, who, request, certs):
    """A listener that another authority certified, or whose certificate is not for listening, gets
    no connection.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    credentials = Credentials(request.getfixturevalue(folder) / who, "learner")
    with ZenohTransport(listen=[endpoint], credentials=credentials):
        _refused(endpoint, Credentials(certs / "actor.1", "actor"), "not trusted")


def test_a_certificate_serves_the_run_that_it_names(run, certs):
    """Another run's certificates of the same authority open the connection, and nothing behind
    it.
    """
    credentials = {
        "actor": (KEYS.config, KEYS.ticket("20.a"), KEYS.rollout("20.a"), Keys("other").config),
        "observer": (KEYS.config, KEYS.status, Keys("other").status),
    }
    for role, keys in credentials.items():
        folder = issue(certs, role, run="other", number=20, force=True)
        with pytest.raises(CongraspError, match=r"safe.learner.0', which may not listen for other"):
            run.connect(folder.name)
        with _raw_session(run.endpoint, folder, "client") as session:
            for key in keys:
                time.sleep(0.02)
                assert not list(
                    session.get(key, FifoChannel(8), payload=encode(Message()), timeout=3.0)
                ), key
    assert answers(run.connect("observer.0"), KEYS.status)


def test_a_policy_server_is_not_taken_for_the_learner(certs):
    """Its certificate is one for listening, and of the same authority: those who want the learner
    see whose it is.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint], credentials=Credentials(certs / "server.0", "server")):
        for role in ("actor", "observer", "server"):
            _refused(
                endpoint,
                Credentials(certs / f"{role}.0", role),
                "server.0', which may not listen for safe",
            )
    issue(certs, "learner", run="other", number=20, force=True)
    with ZenohTransport(
        listen=[endpoint], credentials=Credentials(certs / "learner.20", "learner")
    ):
        _refused(
            endpoint,
            Credentials(certs / "actor.0", "actor"),
            "other.learner.20', which may not listen for safe",
        )


def test_a_learner_that_is_replaced_by_another_role_gets_nothing(certs):
    """Zenoh connects again by itself, without asking us: the rules of who connects hold for whom it
    finds then.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    learner = ZenohTransport(
        listen=[endpoint], credentials=Credentials(certs / "learner.0", "learner")
    )
    learner.serve(KEYS.config, lambda key, request: Message())
    with ZenohTransport(
        connect=[endpoint], credentials=Credentials(certs / "actor.0", "actor")
    ) as actor:
        assert answers(actor, KEYS.config)
        learner.close()
        queries = []
        with ZenohTransport(
            listen=[endpoint], credentials=Credentials(certs / "server.0", "server")
        ) as thief:
            for key in (KEYS.config, KEYS.ticket(ME)):
                thief.serve(key, lambda key, request: queries.append(key) or Message())
            eventually(lambda: list(thief.session(KEYS.config).info.links()))
            time.sleep(0.3)
            assert answers(actor, KEYS.config) is None
            assert answers(actor, KEYS.ticket(ME)) is None
            assert queries == []


def test_a_revoked_peer_is_disconnected_alone(fresh):
    thief = fresh.connect("actor.1")
    actor = fresh.connect("actor.0")
    observer = fresh.connect("observer.0")
    logs = observer.subscribe(KEYS.logs, depth=64)
    thief.declare_alive(KEYS.alive("actor", OTHER, "66"))
    actor.declare_alive(KEYS.alive("actor", ME, "01"))

    def out():
        """Never answered in a while: one request alone could be one too soon after another."""
        return not any(time.sleep(0.05) or answers(thief, KEYS.config) for _ in range(10))

    assert not out()
    eventually(lambda: len(fresh.hub.status()["roles"]) == 3)
    with ActorLink(actor, "safe", ME, request_timeout=5.0) as link:
        link.config(10)
        revoke(fresh.certs, "actor", 1)
        try:
            eventually(out)
            eventually(lambda: OTHER not in {role["id"] for role in fresh.hub.status()["roles"]})
            eventually(lambda: ME in {role["id"] for role in fresh.hub.status()["roles"]})
            ticket = eventually(lambda: link.acquire_ticket(5))
            assert link.upload(rollout(), ticket).result(20) == "accepted"
            thief.publish(KEYS.log("event", "actor", OTHER), Message())
            eventually(
                lambda: (
                    actor.publish(KEYS.log("event", "actor", ME), Message()) or logs.receive(0.3)
                )
            )
            assert answers(thief, KEYS.ticket(OTHER)) is None
            assert out()
            with pytest.raises(
                TransportError, match=r"may have .* revoked the certificate safe\.actor\.1\."
            ):
                thief.query(KEYS.config, Message(), timeout=5)
        finally:
            for path in fresh.certs.rglob("revoked"):
                path.unlink()
    eventually(lambda: answers(thief, KEYS.config))  # and let in again once the list is empty


def _started(*command):
    """A process, once it has printed its first line."""
    process = subprocess.Popen(
        [sys.executable, *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline(), process.stderr.read()
    return process


@pytest.fixture
def forgiven(certs):
    """Nobody is revoked any more once everything else is closed."""
    yield
    for path in certs.rglob("revoked"):
        path.unlink()


@pytest.mark.slow
def test_processes_connected_to_a_revoked_one_end_in_one_line(forgiven, fresh, certs):
    status = [
        "-m",
        "congrasp",
        "status",
        "--watch",
        "--json",
        "--run",
        "safe",
        "--connect",
        fresh.endpoint,
    ]
    processes = (
        _started("-c", ACTOR, fresh.endpoint, certs / "actor.0"),
        _started(*status, "--certs", certs),
    )
    try:
        with PolicyClient(fresh.policy, "safe", certs=certs / "client.0") as client:
            revoke(certs, "learner", 0)
            for process in processes:
                _, errors = process.communicate(timeout=40)
                assert process.returncode
                assert (
                    "congrasp: error: The listener's certificate safe.learner.0 is revoked"
                    in errors
                )
                assert "Traceback" not in errors
            assert client.health()["ready"]  # the policy server is another
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_client_of_a_revoked_server_gets_an_error(forgiven, fresh, certs):
    client = fresh.connect("client.0", fresh.policy, revocation_seconds=0.1)
    key = KEYS.act_for("0.c")
    assert answers(client, key)
    revoke(certs, "server", 0)

    eventually(lambda: client.closed)
    for _ in range(2):
        with pytest.raises(
            CongraspError, match=r"The listener\'s certificate safe\.server\.0 is revoked"
        ):
            client.query(key, Message(), timeout=5)


def test_a_certificate_for_another_host_is_not_trusted(certs):
    """The learner's certificate names the loopback addresses alone; 127.0.0.2 is another host."""
    port = free_port()
    with ZenohTransport(
        listen=[f"tls/127.0.0.2:{port}"], credentials=Credentials(certs / "learner.0", "learner")
    ):
        _refused(
            f"tls/127.0.0.2:{port}", Credentials(certs / "actor.0", "actor"), "not trusted.*--host"
        )


def test_a_connection_ends_when_its_certificate_expires(run):
    certificate = issue(run.certs, "actor", number=50, days=4 / 86400)
    left = 86400 * read(certificate / "tls.crt").days
    session = run.connect(certificate.name, flows=("control",))
    assert answers(session, KEYS.config)
    time.sleep(left + 0.5)
    eventually(lambda: not answers(session, KEYS.config))
    _refused(run.endpoint, Credentials(certificate, "actor"), "expired")


def test_too_long_and_too_frequent_messages_are_dropped(fresh):
    observer = fresh.connect("observer.0")
    actor = fresh.connect("actor.0")
    long = Message({"x": np.zeros(100_000, np.uint8)})
    assert answers(actor, KEYS.config, long) is None
    assert answers(actor, KEYS.ticket(ME), long) is None
    session = observer.session(KEYS.status)
    question = encode(Message())
    channels = [
        session.get(KEYS.status, FifoChannel(2), payload=question, timeout=5.0) for _ in range(300)
    ]
    replies = itertools.chain.from_iterable(channels)
    answered = sum(reply.ok is not None for reply in replies)
    assert 1 <= answered < 300
    time.sleep(0.1)
    assert answers(observer, KEYS.status)
