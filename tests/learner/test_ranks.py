"""Ranks that agree, in threads; ranks that train and die, in processes."""

import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import numpy as np
import pytest

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.ports import free_port
from congrasp.learner.distributed import ranks as ranks_module
from congrasp.learner.distributed.ranks import Ranks, accept_links, first_ending, open_link
from congrasp.learner.distributed.relay import relay
from congrasp.learner.run_directory import create_run
from tests.conftest import ROOT
from tests.learner.rank_process import CONFIG
from tests.waits import eventually, together


class Party:
    """Three ranks in this process; `said[r]` is what rank r ended with."""

    def __init__(self, port: int, count: int = 3):
        self.said: dict[int, str] = {}
        self.links: dict[int, dict] = {}
        deadline = time.monotonic() + 20.0

        def meet(rank: int) -> None:
            if rank == 0:
                self.links[0] = accept_links(count, "127.0.0.1", port, deadline)
            else:
                self.links[rank] = {0: open_link(rank, count, "127.0.0.1", port, deadline)}

        self.everywhere(meet, count)
        self.ranks = [
            Ranks(r, count, self.links[r], lambda text, r=r: self.said.update({r: text}))
            for r in range(count)
        ]

    @staticmethod
    def everywhere(call: Callable[[int], object], count: int = 3) -> None:
        together(call, range(count))

    def end(self, rank: int) -> None:
        """Its process is no more: nothing in it runs on, and the kernel ends its connections."""
        self.ranks[rank].leave()
        for link in self.links[rank].values():
            link.close()

    def all_said(self, ranks: set[int]) -> bool:
        return eventually(lambda: ranks <= self.said.keys())


@pytest.fixture
def party(monkeypatch):
    monkeypatch.setattr(ranks_module, "RELAY_SECONDS", 0.2)
    party = Party(free_port())
    yield party
    for rank in range(3):
        party.end(rank)


def test_all_ranks_receive_entries_in_order_and_rank_0s_arrays(party):
    decisions = {}

    def exchange(rank: int) -> None:
        for turn in range(20):
            arrays = {"x": np.arange(3) + turn} if rank == 0 else None
            decisions[rank, turn] = party.ranks[rank].exchange({"rank": rank, "turn": turn}, arrays)

    party.everywhere(exchange)
    for (_, turn), decision in decisions.items():
        assert decision.meta["entries"] == [{"rank": rank, "turn": turn} for rank in range(3)]
        np.testing.assert_array_equal(decision.arrays["x"], np.arange(3) + turn)


def test_an_urgent_entry_ends_the_round_for_all(party):
    first, second, third = party.ranks
    second.post({"end": ""})
    assert second.poll(0.2) is None
    third.post({"end": "a signal"}, urgent=True)
    for rank in (second, third):
        assert first_ending(rank.poll(10.0).meta["entries"]) == (2, "a signal")
    assert first.poll(10.0).meta["entries"][0] is None
    # And the next round is whole again
    party.everywhere(lambda rank: party.ranks[rank].exchange({}))


def test_a_failed_rank_ends_the_others_with_its_reason(party):
    party.ranks[1].fail(CongraspError("The disk is full."))
    party.end(1)
    assert party.all_said({0, 2})
    for rank in (0, 2):
        assert party.said[rank].startswith("Rank 1 ended: The disk is full. ")
        assert "\n" not in party.said[rank]
    assert 1 not in party.said


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_the_others(party, victim):
    party.end(victim)
    others = {0, 1, 2} - {victim}
    assert party.all_said(others)
    assert all(f"Rank {victim} ended" in party.said[rank] for rank in others)


def test_a_silent_rank_ends_the_others(monkeypatch):
    monkeypatch.setattr(ranks_module, "SILENCE_SECONDS", 0.5)
    party = Party(free_port())  # whose hearts beat every two seconds only
    assert party.all_said({0, 1, 2})
    assert any("silent" in text for text in party.said.values())


def test_ranks_that_leave_cleanly_report_no_loss(party, monkeypatch):
    monkeypatch.setattr(jax.distributed, "shutdown", lambda: None)
    party.everywhere(lambda rank: party.ranks[rank].close())
    for rank in (1, 0, 2):
        party.end(rank)
    time.sleep(0.5)
    assert not party.said


def test_the_end_of_the_coordinator_is_not_passed_on_to_jax():
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(("127.0.0.1", relay(*server.getsockname())), 60.0)
        far, _ = server.accept()
        near.sendall(b"question")
        assert far.recv(8) == b"question"
        far.sendall(b"answer")
        assert near.recv(6) == b"answer"
    far.close()
    near.settimeout(1.0)
    with pytest.raises(TimeoutError):
        near.recv(1)
    near.sendall(b"a heartbeat")
    with pytest.raises(TimeoutError):
        near.recv(1)
    near.close()


def test_a_process_alone_agrees_with_itself():
    alone = Ranks.join(0, 1, "")
    alone.post({"end": ""})
    assert first_ending(alone.poll(0.0).meta["entries"]) is None
    assert alone.exchange({"x": 1}).meta["entries"] == [{"x": 1}]
    alone.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((2, 2, "127.0.0.1:7000"), "no rank 2 of 2"),
        ((0, 2, "127.0.0.1"), "not a valid address"),
        ((0, 2, "127.0.0.1:99999"), "not a valid address"),
    ],
)
def test_ranks_and_addresses_that_make_no_sense(arguments, complaint):
    with pytest.raises(CongraspError, match=complaint):
        Ranks.join(*arguments)


def test_joining_ends_at_the_deadline(monkeypatch):
    monkeypatch.setattr(ranks_module, "JOIN_SECONDS", 0.5)
    with pytest.raises(TransportError, match=r"Ranks \[1\] of 2 did not join"):
        Ranks.join(0, 2, f"127.0.0.1:{free_port()}")
    with pytest.raises(TransportError, match="Rank 0 does not answer"):
        Ranks.join(1, 2, f"127.0.0.1:{free_port()}")


class Job:
    """Real processes of `tests.learner.rank_process`."""

    def __init__(self, run_dir: pathlib.Path, port: int):
        self.run_dir = run_dir
        self._port = port
        self.processes: list[subprocess.Popen[str]] = []

    def start(self, goal: int, mode: str, count: int = 2, *doom: str) -> None:
        self._port += 2
        command = [sys.executable, "-m", "tests.learner.rank_process"]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(self.run_dir / "compiled"))
        environment |= {
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "true",
        }
        self.processes = [
            subprocess.Popen(
                [
                    *command,
                    str(rank),
                    str(count),
                    str(self._port),
                    str(self.run_dir),
                    str(goal),
                    mode,
                    *doom,
                ],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for rank in range(count)
        ]

    def reach(self, update: int) -> None:
        """Reads what rank 0 says until it has done this update."""
        for line in self.processes[0].stdout:
            if line.startswith("update ") and int(line.split()[1]) >= update:
                return
        pytest.fail(f"rank 0 ended early: {self.processes[0].stderr.read()}")

    def finish(self) -> list[str]:
        """What the ranks print to their end, which must be a good one."""
        output = [process.communicate(timeout=300.0) for process in self.processes]
        assert [process.returncode for process in self.processes] == [0] * len(output), output
        return [text for text, _ in output]

    def kill(self, victim: int) -> str:
        """Kills a rank; returns the last words of the other."""
        self.processes[victim].send_signal(signal.SIGKILL)
        return self.last_words(victim)

    def last_words(self, victim: int) -> str:
        """What the other rank says when this one was killed: one line."""
        assert self.processes[victim].wait(timeout=120.0) == -signal.SIGKILL
        other = self.processes[1 - victim]
        _, words = other.communicate(timeout=60.0)
        assert other.returncode == TransportError.exit_code, words
        assert re.findall(r"congrasp: error: .*", words) == [words.strip().splitlines()[-1]]
        return words


@pytest.fixture
def job(tmp_path):
    create_run(tmp_path, CONFIG)
    job = Job(tmp_path, free_port())
    yield job
    for process in job.processes:
        process.kill()
        process.wait(10.0)


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_two_processes_train_die_and_resume_as_one_or_two(job):
    job.start(10**6, "fresh")
    job.reach(5)
    words = job.kill(1)
    assert "Rank 1 ended. Rank 0 cannot continue alone: start all ranks with --resume." in words

    job.start(10**6, "resume")
    job.reach(6)
    words = job.kill(0)
    assert "Rank 0 ended. Rank 1 cannot continue alone: start all ranks with --resume." in words

    saved = int((job.run_dir / "checkpoints" / "latest").resolve().stem.removeprefix("checkpoint_"))
    assert saved >= 5  # the first update after a resume has a checkpoint of its own
    job.start(saved + 3, "resume")
    first, second = job.finish()
    steps = 2 * CONFIG.rollouts_per_update * CONFIG.rollout_steps * CONFIG.environments

    def bundle(text):
        (line,) = [line for line in text.splitlines() if "bundle" in line]
        return line.split()[1:]

    of_rank_0 = bundle(first)
    # Weights, normalisers and versions, bit for bit, though the rollouts were not the same
    assert of_rank_0 == bundle(second)
    assert int(of_rank_0[1]) == steps * (saved + 3)

    job.start(saved + 5, "resume", count=1)
    (alone,) = job.finish()
    assert "The checkpoint has 2 rank(s), this run has 1" in alone
    assert int(alone.split()[-1]) == steps * (saved + 3) + steps // 2 * 2


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_a_rank_dying_in_any_phase_ends_the_other(job):
    saved = 0
    mode = "fresh"
    for doom in ("1:join", "1:wait", "0:update", "1:publish", "0:checkpoint", "1:leave"):
        victim = int(doom[0])
        job.start(saved + 2 if doom == "1:leave" else 10**6, mode, 2, doom)
        assert f"Rank {victim} ended. Rank {1 - victim} cannot continue alone" in job.last_words(
            victim
        ), doom
        checkpoints = sorted((job.run_dir / "checkpoints").glob("checkpoint_*.safetensors"))
        assert bool(checkpoints) == (doom != "1:join")
        saved, mode = (
            (int(checkpoints[-1].stem.removeprefix("checkpoint_")), "resume")
            if checkpoints
            else (0, "fresh")
        )
    job.start(saved + 2, "resume", 3)
    (bundle,) = {text.split("bundle")[1] for text in job.finish()}
    steps = CONFIG.rollouts_per_update * CONFIG.rollout_steps * CONFIG.environments
    assert int(bundle.split()[1]) == steps * (2 * saved + 3 * 2)
