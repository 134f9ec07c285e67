"""Metrics as Prometheus scrapes them, and what roles say in their logs."""

import contextlib
import datetime
import errno
import itertools
import json
import logging
import os
import socket
import subprocess
import sys
import threading
import urllib.request
from unittest import mock

import pytest
from prometheus_client.parser import text_string_to_metric_families

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.ports import free_port
from congrasp.services.cli.main import main
from congrasp.services.ops.logs import log, log_error, logging_as
from congrasp.services.ops.metrics import ActorMetrics, LearnerMetrics, ServerMetrics
from congrasp.services.ops.metrics_endpoint import MAX_CONNECTIONS, serve_metrics
from tests.waits import eventually, together

STATUS = {
    "version": 7,
    "finished": False,
    "warnings": [],
    "queue": {"length": 1, "limit": 64},
    "rates": {"rollouts_per_second": 0.5, "steps_per_second": 100.0},
    "counters": {
        "granted": 9,
        "redeemed": 8,
        "accepted": 8,
        "consumed": 7,
        "running": 1,
        "queued": 1,
        "capacity": 3,
    },
    "roles": [
        {
            "role": "actor",
            "id": "a",
            "incarnation": "1",
            "version": 6,
            "lag": 1,
            "rollouts": 8,
            "steps_per_second": 9,
        },
        {"role": "learner", "id": "0", "incarnation": "2"},
    ],
    "unlisted": 0,
}


def scrape(port: int) -> dict[tuple[str, ...], float]:
    """Samples by their name and the values of their labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as reply:
        families = text_string_to_metric_families(reply.read().decode())
        samples = itertools.chain.from_iterable(family.samples for family in families)
        return {(sample.name, *sample.labels.values()): sample.value for sample in samples}


def test_a_learner_shows_its_status_and_its_last_update():
    metrics = LearnerMetrics(lambda: STATUS)
    port = free_port()
    metrics.update({"episode/success": 0.5, "update_seconds": 0.25})
    with serve_metrics(port, "127.0.0.1", metrics):
        scraped = scrape(port)
    assert scraped["congrasp_learner_version",] == 7
    assert scraped["congrasp_learner_ready",] == 1
    assert scraped["congrasp_learner_rollouts_total", "consumed"] == 7
    assert scraped["congrasp_learner_tickets_total", "granted"] == 9
    assert (
        scraped["congrasp_learner_tickets_running",] + scraped["congrasp_learner_tickets_capacity",]
        == 4
    )
    assert scraped["congrasp_learner_actor_lag", "a", "1"] == 1
    assert scraped["congrasp_learner_roles", "actor"] == 1
    assert scraped["congrasp_learner_update", "episode/success"] == 0.5
    assert scraped["process_resident_memory_bytes",] > 0


def test_a_learner_that_starts_is_not_ready():
    def ask():
        raise TransportError("No response.")

    port = free_port()
    with serve_metrics(port, "127.0.0.1", LearnerMetrics(ask)):
        assert scrape(port)["congrasp_learner_ready",] == 0


def test_an_actor_shows_its_last_rollout():
    metrics = ActorMetrics()
    port = free_port()
    metrics.rollout({"version": 3.0, "rollouts": 12.0, "steps_per_second": 99.0})
    with serve_metrics(port, "127.0.0.1", metrics):
        scraped = scrape(port)
    assert scraped["congrasp_actor_rollouts_total",] == 12
    assert scraped["congrasp_actor_version",] == 3
    assert scraped["congrasp_actor_steps_per_second",] == 99


def test_silent_connections_do_not_end_scrapes():
    """They take no threads, and another address is still answered."""
    port = free_port()
    address = ("127.0.0.1", port)
    with contextlib.ExitStack() as stack:
        stack.enter_context(serve_metrics(port, "127.0.0.1", ActorMetrics()))
        threads = threading.active_count()
        for _ in range(2 * MAX_CONNECTIONS):
            silent = stack.enter_context(socket.create_connection(address, 10.0))
            silent.sendall(b"GET /metrics HTTP/1.1\r\nX: ")
        assert threading.active_count() == threads
        other = socket.create_connection(address, 10.0, source_address=("127.0.0.2", 0))
        stack.enter_context(other)
        other.sendall(b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert other.recv(1 << 12).startswith(b"HTTP/1.1 200 ")


def test_a_server_counts_answers_and_batches_from_many_threads():
    metrics = ServerMetrics()
    port = free_port()
    metrics.health = lambda: {"ready": True, "version": 5, "queue": 2}

    def answer(number):
        for _ in range(100):
            metrics.answer("answered", 0.004)
            metrics.answer("overloaded", 0.0)
            metrics.batch(3)

    with serve_metrics(port, "127.0.0.1", metrics):
        together(answer, range(4))
        scraped = scrape(port)
    assert (
        scraped["congrasp_policy_queries_total", "answered"]
        == 400
        == scraped["congrasp_policy_batch_bucket", "4.0"]
    )
    assert scraped["congrasp_policy_queries_total", "overloaded"] == 400
    assert scraped["congrasp_policy_seconds_bucket", "0.003"] == 0
    assert (
        scraped["congrasp_policy_seconds_bucket", "0.005"]
        == scraped["congrasp_policy_seconds_count",]
        == 400
    )
    assert scraped["congrasp_policy_version",] == 5


@contextlib.contextmanager
def role(*arguments):
    """A role that runs while the block does; what it has said is in the list afterwards. It must
    end when told to.
    """
    command = [sys.executable, "-m", "congrasp", *arguments, "--log-format", "json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        lines: list[dict] = []
        try:
            yield lines
            process.terminate()
            rest, wrong = process.communicate(timeout=20)
            lines += [json.loads(line) for line in rest.splitlines()]
            assert process.returncode == 143, wrong
        finally:
            process.kill()


def scraped_until(port, condition):
    def look():
        with contextlib.suppress(OSError):
            return metrics if condition(metrics := scrape(port)) else None

    return eventually(look, 0.1)


@pytest.mark.timeout(240)
def test_a_learner_and_an_actor_are_scraped(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ports = (free_port(), free_port())
    small = (
        "--network.hidden",
        "32",
        "--environments",
        "4",
        "--objects.count",
        "1",
        "--objects.families",
        "box",
    )
    learner = ("learner", "--run-dir", str(tmp_path / "run"), "--listen", endpoint, *small)
    actor = (
        "actor",
        "--connect",
        endpoint,
        "--run",
        "quickstart",
        "--id",
        "worker",
        "--physics",
        "native",
    )
    with (
        role(*learner, "--metrics-port", str(ports[0])),
        role(*actor, "--metrics-port", str(ports[1])) as actor_output,
    ):
        expected = {("congrasp_learner_roles", "actor"): 1, ("congrasp_learner_ready",): 1}
        metrics = scraped_until(ports[0], lambda metrics: expected.items() <= metrics.items())
        assert metrics["congrasp_learner_counters_balanced",] == 1
        # One rollout an update, for the next version and the one after it.
        assert (
            metrics["congrasp_learner_tickets_capacity",]
            + metrics["congrasp_learner_tickets_running",]
            == 2
        )
        assert ("congrasp_actor_rollouts_total",) in scrape(ports[1])
    assert all(
        line.keys() == {"time", "level", "role", "id", "run", "text", "fields"}
        for line in actor_output
    )
    assert datetime.datetime.fromisoformat(actor_output[0]["time"]).tzinfo is datetime.UTC
    # On a busy machine notices come first that it still waits.
    first = next(line for line in actor_output if not line["text"].startswith("Waiting for"))
    assert first["text"] == f"Connected to the learner at {endpoint}."
    assert first["role"] == "actor"
    assert first["id"] == "worker"


def test_an_error_is_the_last_line_of_a_log_in_json(capfd):
    with mock.patch.dict(os.environ), pytest.raises(SystemExit) as end:
        main(["actor", "--connect", "nonsense", "--log-format", "json"])
    printed = capfd.readouterr()
    line = json.loads(printed.out)
    assert end.value.code == 2
    assert line["level"] == "error"
    assert printed.err == ""
    assert line["text"].startswith("'nonsense' is not an endpoint.")
    with pytest.raises(SystemExit):
        main(["grasp", "nowhere.obj"])
    # No log of before
    assert capfd.readouterr().err.startswith("congrasp: error: There is no file nowhere.obj.")


def test_a_json_log_continues_after_an_error(capfd):
    @contextlib.contextmanager
    def outer():
        try:
            yield
        finally:
            logging.getLogger("library").warning("closing")

    with pytest.raises(CongraspError), outer(), logging_as("json", role="learner", id="0", run="r"):
        raise CongraspError("It is refused.")
    assert log_error("It is refused.")
    assert not log_error("It is refused.")
    logging.getLogger("library").warning("after the log")
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert [(line["level"], line["text"]) for line in lines] == [
        ("warning", "closing"),
        ("error", "It is refused."),
    ]


def test_a_full_disk_under_a_log_costs_lines_and_not_the_process(monkeypatch):
    class Full:
        def write(self, text):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    with logging_as("text", role="learner", id="0", run="r"):
        log("warning", "lost", {"figure": 1.0})


def test_a_port_in_use_is_an_error_in_words():
    port = free_port()
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", port))
        busy.listen()
        with (
            pytest.raises(CongraspError, match=rf"127.0.0.1:{port}: .*--metrics-port"),
            serve_metrics(port, "127.0.0.1"),
        ):
            pass
