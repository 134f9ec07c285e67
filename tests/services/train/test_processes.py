"""Processes of a training; scripts stand in for them."""

import pathlib
import sys
import threading

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.ops import lifetime
from congrasp.services.ops.lifetime import command
from congrasp.services.train import accelerators, processes
from congrasp.services.train.processes import MAX_RESTARTS, Child

WAITS = "import time; time.sleep(60)"
LOST = "print('Rank 1 ended.'); raise SystemExit(4)"
FULL = "import time; print('No memory.', flush=True); time.sleep(0.5); raise SystemExit(9)"
DIES = "raise SystemExit(9)"


def test_options_become_arguments():
    options = {
        "run_dir": "a",
        "resume": True,
        "certs": None,
        "insecure": False,
        "port": 0,
        "metric_writers": (),
    }
    assert command("learner", **options) == [
        "learner",
        "--run-dir",
        "a",
        "--resume",
        "--port",
        "0",
        "--metric-writers",
    ]


class Script(Child):
    """A child whose lives are Python programs, one after the other."""

    @property
    def program(self) -> list[str]:
        return [sys.executable, "-c", self.arguments[min(self.restarts, len(self.arguments) - 1)]]


@pytest.fixture
def supervise(tmp_path: pathlib.Path):
    children: list[Script] = []
    notes: list[str] = []

    def run(*lives: list[str]) -> list[str]:
        children.extend(
            Script(f"rank-{i}", programs, tmp_path / f"{i}.log") for i, programs in enumerate(lives)
        )
        for child in children:
            child.start()
        with MemoryTransport(MemoryHub()) as transport:
            processes.supervise(
                children, [], transport, "run", threading.Event(), lambda status: None, notes.append
            )
        return notes

    yield run
    processes.end_all(children)
    assert all(child.process.poll() is not None for child in children)


def test_all_ranks_restart_if_one_dies(supervise, tmp_path):
    writes = f"import pathlib; pathlib.Path({str(tmp_path)!r}, 'again').touch(); {WAITS}"
    waits_for_it = (
        f"import pathlib, time\nwhile not pathlib.Path({str(tmp_path)!r}, 'again').exists(): "
        f"time.sleep(0.05)"
    )
    notes = supervise([WAITS, waits_for_it], ["print('No memory.'); raise SystemExit(9)", writes])
    assert notes == ["The rank-1 died (exit code 9): No memory. Restarting all ranks."]


def test_the_failed_rank_is_named(supervise):
    notes = supervise([LOST, "pass"], [FULL, "pass"])
    assert notes == ["The rank-1 died (exit code 9): No memory. Restarting all ranks."]


def test_the_rank_that_failed_too_often_ends_the_run(supervise, monkeypatch):
    monkeypatch.setattr(processes, "MAX_RESTARTS", 0)
    with pytest.raises(
        CongraspError, match=r"The rank-1 died \(exit code 9\): No memory\. Its log is .*1\.log"
    ):
        supervise([LOST], [FULL])


def test_a_killed_rank_is_named_with_its_signal(supervise):
    """Two ranks that fail at the same time are both named, since their ends have no order."""
    killed = "import os; print('info: Update 3.', flush=True); os.kill(os.getpid(), 9)"
    silent = "import os, time; time.sleep(0.5); os._exit(1)"
    first, second = supervise([killed, silent, "pass"], [FULL, LOST, "pass"])
    assert first == (
        "The rank-0 was killed by SIGKILL. The rank-1 died (exit code 9): No memory. "
        "Restarting all ranks."
    )
    assert second == "The rank-0 died (exit code 1): its log is empty. Restarting all ranks."


def test_bad_input_of_any_rank_ends_the_run_with_its_last_words(supervise):
    complains = "import sys; print('congrasp: error: The port is in use.'); sys.exit(2)"
    follows = "import sys, time; time.sleep(0.2); print('Rank 1 ended.'); sys.exit(4)"
    with pytest.raises(
        CongraspError, match=r"The rank-1 died \(exit code 2\): The port is in use\. Its log is"
    ):
        supervise([follows], [complains])


@pytest.fixture
def storm(tmp_path, monkeypatch):
    """Supervises a learner and an actor, one of which dies; progress is published or not."""
    monkeypatch.setattr(lifetime, "MAX_PAUSE_S", 1.0)
    children: list[Script] = []

    def run(role: str, deaths: int, *, progress: bool) -> list[str]:
        lives = [DIES] * deaths
        last = WAITS if role == "actor" else "pass"
        learner = Script("learner", [WAITS], tmp_path / "learner.log")
        actor = Script("actor", [WAITS], tmp_path / "actor.log")
        dying = learner if role == "learner" else actor
        dying.arguments = [*lives, last]
        children.extend([learner, actor])
        for child in children:
            child.start()
        hub = MemoryHub()
        stop = threading.Event()
        notes: list[str] = []
        with MemoryTransport(hub) as transport, MemoryTransport(hub) as updates:

            def note(text: str) -> None:
                notes.append(text)
                if progress:
                    key = Keys("run").log("metrics", "learner", "0")
                    updates.publish(key, Message(meta={"update": len(notes)}))
                if role == "actor" and len(notes) == deaths:
                    stop.set()

            processes.supervise(
                [learner], [actor], transport, "run", stop, lambda status: None, note
            )
        return notes

    yield run
    processes.end_all(children)


@pytest.mark.parametrize("role", ["actor", "learner"])
def test_twenty_deaths_with_progress_between_do_not_end_a_run(storm, role):
    assert len(storm(role, 20, progress=True)) == 20


@pytest.mark.parametrize("role", ["actor", "learner"])
def test_deaths_without_progress_end_a_run(storm, role):
    with pytest.raises(CongraspError, match=rf"{role} died .*{MAX_RESTARTS + 1} times"):
        storm(role, 20, progress=False)


@pytest.mark.parametrize(("visible", "names"), [("", ["0", "1"]), ("4,GPU-7", ["4", "GPU-7"])])
def test_each_rank_sees_one_of_the_visible_gpus(monkeypatch, visible, names):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert [accelerators.gpu_of_rank(rank) for rank in range(2)] == names
