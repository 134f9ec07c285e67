"""`congrasp status` against a live learner's end."""

import copy
import dataclasses
import io
import json
import signal
import subprocess
import sys

import pytest
from rich.console import Console

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.run_directory import POLICY_FILE, create_run, listening
from congrasp.services.cli.view import View
from congrasp.services.ops.status import Status, ask, tables, warnings
from tests.rollouts import bundle, learner_hub, rollout
from tests.waits import eventually


@pytest.fixture
def endpoint():
    """A run with one actor, which has sent one rollout."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint]) as server:
        form = RolloutForm(4, 2, 7, 3, half=True)
        learner_hub(server, "r", form=form).hub.publish_weights(bundle(0, form=form), 0)
        with ZenohTransport(connect=[endpoint]) as actor:
            actor.declare_alive(Keys("r").alive("actor", "worker-7", "1f"))
            sent = rollout(0.5, form, actor="worker-7", incarnation="1f", sequence=0, run_id="e")
            assert (
                actor.query(Keys("r").rollout("worker-7"), sent, timeout=5.0).meta["outcome"]
                == "accepted"
            )
            yield endpoint


def test_status_lists_roles_and_counters(endpoint, capsys):
    assert Status(connect=endpoint, run="r", json=True)() == 0
    state = json.loads(capsys.readouterr().out)
    assert state["run"] == "r"
    assert state["version"] == 0
    assert state["counters"]["accepted"] == 1
    assert [(role["role"], role["id"]) for role in state["roles"]] == [
        ("actor", "worker-7"),
        ("learner", "0"),
    ]
    actor = state["roles"][0]
    assert actor["rollouts"] == 1
    assert actor["version"] == 0
    assert actor["lag"] == 0
    assert 0 < actor["steps_per_second"] == state["rates"]["steps_per_second"] <= 8
    assert Status(connect=endpoint, run="r")() == 0
    text = capsys.readouterr().out
    assert "worker-7" in text
    assert "accepted" in text
    assert "1 rollout(s) of at most 64 waiting" in text


def test_a_runs_folder_leads_to_its_learner(endpoint, tmp_path, capsys):
    create_run(tmp_path / "run", dataclasses.replace(RunConfig(), name="r"))
    with pytest.raises(CongraspError, match=r"No learner is running in .*congrasp plot"):
        Status(tmp_path / "run")()
    with listening(tmp_path / "run", endpoint):
        assert Status(tmp_path / "run", json=True)() == 0
        assert json.loads(capsys.readouterr().out)["roles"][0]["id"] == "worker-7"
        page = View().of_folder(tmp_path / "run")
        assert page == View(connect=endpoint, run="r", recordings=tmp_path / "run")
    (tmp_path / "run" / POLICY_FILE).touch()
    page = View().of_folder(tmp_path / "run")
    assert page == View(run="r", policy=tmp_path / "run" / POLICY_FILE, recordings=tmp_path / "run")


def test_a_run_folder_excludes_other_options(tmp_path):
    folder = tmp_path / "run"
    other = {"connect": "tcp/127.0.0.1:1"}
    for command, named in (
        *((Status, named) for named in (other, {"run": "r"})),
        *(
            (View, named)
            for named in (other, {"run": "r"}, {"policy": tmp_path}, {"recordings": tmp_path})
        ),
    ):
        with pytest.raises(
            CongraspError,
            match=r"run cannot be combined with --connect",
        ):
            command(folder, **named)()


def test_counters_that_do_not_add_up_are_named(endpoint):
    with ZenohTransport(connect=[endpoint]) as transport:
        state = ask(transport, "r")
    assert state["warnings"] == []
    lost = copy.deepcopy(state)
    lost["counters"]["accepted"] += 1
    (words,) = warnings(lost)
    assert (
        words
        == "The counters are inconsistent: accepted 2 is not consumed 0 + dropped 0 + queued 1."
    )
    lost["counters"]["queued"] += 1
    (words,) = warnings(lost)
    assert words == "2 rollouts are counted as queued, but the queue holds 1."


def test_watching_continues_until_interrupted(endpoint):
    command = [sys.executable, "-m", "congrasp", "status", "--connect", endpoint, "--run", "r"]
    with subprocess.Popen(
        [*command, "--watch", "--every", "0.1", "--json"], stdout=subprocess.PIPE, text=True
    ) as process:
        versions = [json.loads(process.stdout.readline())["version"] for _ in range(3)]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)
    assert versions == [0, 0, 0]
    assert process.returncode == 130


def test_a_run_that_is_not_there_is_an_error_in_words(endpoint):
    with pytest.raises(TransportError, match="other"):
        Status(connect=endpoint, run="other")()


def test_names_fit_into_80_columns(endpoint):
    """A long name continues in the next line of its cell."""
    state = ask_with_tokens(endpoint, 70)
    role = {**state["roles"][0], "id": "node-17.cluster-12345", "incarnation": "f45e4ae5"}
    rates = {"version": 1234567, "rollouts": 12345678, "steps_per_second": 72900.5}
    named = {**role, **rates, "rollouts_per_second": 24.355}
    console = Console(file=io.StringIO(), width=80)
    console.print(tables({**state, "roles": [named]}))
    text = console.file.getvalue()
    assert "…" not in text
    assert "f45e4ae5" in text
    cells = [line.split("│")[2].strip() for line in text.splitlines() if line.count("│") == 9]
    assert "".join(cells) == "node-17.cluster-12345"


def test_unlisted_processes_are_counted_and_names_escaped(endpoint):
    """600 liveliness tokens of one certificate, some with names that a terminal or a table would
    take for more.
    """
    state = ask_with_tokens(endpoint, 600)
    assert len(state["roles"]) == 66
    assert state["unlisted"] == 600 - 64
    assert any(role["id"] == "worker-7" for role in state["roles"])
    named = {**state["roles"][0], "id": "[red]\x1b[2J[/nonsense]" * 10, "refused": 3}
    console = Console(file=io.StringIO(), width=200)
    console.print(tables({**state, "roles": [named] * 150}))
    text = console.file.getvalue()
    assert "[red]" in text
    assert "\x1b" not in text
    assert "refused" in text
    assert len(text) < 50_000
    assert f"{50 + state['unlisted']} more live process(es)" in text


def ask_with_tokens(endpoint, count):
    """The status beside an actor that shows so many tokens."""
    with ZenohTransport(connect=[endpoint]) as evil, ZenohTransport(connect=[endpoint]) as observer:
        for i in range(count):
            evil.declare_alive(Keys("r").alive("actor", f"9.{i}", "1"))
        eventually(lambda: ask(observer, "r")["unlisted"] >= count - 64)
        return ask(observer, "r")
