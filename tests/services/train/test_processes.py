"""Processes of a training, and trainings of a reproduction; scripts stand in for them."""

import dataclasses
import pathlib
import sys
import threading

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.cli import main, parse_errors
from congrasp.services.evaluate.lineup import PolicyKey
from congrasp.services.ops import lifetime
from congrasp.services.ops.lifetime import command
from congrasp.services.train import background, processes
from congrasp.services.train.presets import get_preset
from congrasp.services.train.processes import MAX_RESTARTS, Child
from congrasp.services.train.reproduction import PolicyRequest, train_all, training_options

WAITS = "import time; time.sleep(60)"


def test_options_become_arguments():
    given = {
        "run_dir": "a",
        "resume": True,
        "certs": None,
        "insecure": False,
        "port": 0,
        "metric_writers": (),
    }
    assert command("learner", **given) == [
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
            processes._supervise(
                children, [], transport, "run", threading.Event(), lambda status: None, notes.append
            )
        return notes

    yield run
    processes.end_all(children)
    assert all(child.process.poll() is not None for child in children)


def test_one_that_dies_takes_the_others_with_it_and_all_come_back(supervise, tmp_path):
    writes = f"import pathlib; pathlib.Path({str(tmp_path)!r}, 'again').touch(); {WAITS}"
    waits_for_it = (
        f"import pathlib, time\nwhile not pathlib.Path({str(tmp_path)!r}, 'again').exists(): "
        f"time.sleep(0.05)"
    )
    notes = supervise([WAITS, waits_for_it], ["print('No memory.'); raise SystemExit(9)", writes])
    assert notes == ["The rank-1 died (exit code 9): No memory. Restarting all ranks."]


LOST = "print('Rank 1 ended.'); raise SystemExit(4)"
FULL = "import time; print('No memory.', flush=True); time.sleep(0.5); raise SystemExit(9)"


def test_the_rank_that_failed_is_named_and_not_those_that_lost_it(supervise):
    notes = supervise([LOST, "pass"], [FULL, "pass"])
    assert notes == ["The rank-1 died (exit code 9): No memory. Restarting all ranks."]


def test_the_rank_that_failed_too_often_ends_the_run(supervise, monkeypatch):
    monkeypatch.setattr(processes, "MAX_RESTARTS", 0)
    with pytest.raises(
        CongraspError, match=r"The rank-1 died \(exit code 9\): No memory\. Its log is .*1\.log"
    ):
        supervise([LOST], [FULL])


def test_a_killed_rank_is_named_with_its_signal_and_each_life_with_its_own_words(supervise):
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


DIES = "raise SystemExit(9)"


@pytest.fixture
def storm(tmp_path, monkeypatch):
    """Supervises a learner and an actor, one of which dies; progress is published or not."""
    monkeypatch.setattr(processes, "_MAX_PAUSE_S", 1.0)
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

            processes._supervise(
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
    assert [processes._gpu(rank) for rank in range(2)] == names


# --- trainings of a reproduction ---


OURS, GRAPSXL, PHASES = (PolicyKey("human", method) for method in ("ours", "graspxl", "two-phase"))
FINISHES = (
    "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / "
    "'policy.safetensors').touch()"
)
FAILS = "print('compiling'); print('congrasp: error: The disk is full.'); raise SystemExit(2)"
HANGS = "import time; print('update 3', flush=True); time.sleep(60)"


@pytest.fixture
def scripts(monkeypatch):
    """What runs for each policy, by name; and all children that were started."""
    chosen, started = {}, []

    class Training(Child):
        @property
        def program(self):
            started.append(self)
            folder = self.arguments[self.arguments.index("--run-dir") + 1]
            return [sys.executable, "-c", chosen[self.name], folder]

    monkeypatch.setattr(background, "Child", Training)
    monkeypatch.setattr(lifetime, "_CHILD_POLL_S", 0.05)
    yield chosen, started
    assert all(child.process.poll() is not None for child in started)


def request(out, patience, *options):
    """A request whose trainings are in `out`."""
    return PolicyRequest(("human",), (), {}, False, out / "policies", options, patience)


def silent(label, total):
    return lambda done: None


def test_one_that_fails_or_hangs_is_named_and_does_not_stop_the_rest(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FAILS, GRAPSXL.name: HANGS, PHASES.name: FINISHES}
    wanted = request(tmp_path, 3.0)
    failures = train_all(wanted, [OURS, GRAPSXL, PHASES], silent)
    assert set(failures) == {OURS, GRAPSXL}
    assert (
        "human-ours failed: The disk is full." in failures[OURS]
        and "human-ours.log" in failures[OURS]
    )
    assert "human-graspxl was stopped" in failures[GRAPSXL]
    runs = wanted.runs
    assert (
        background.finished_policy(runs / OURS.name) is None
        and background.training_seconds(runs / OURS.name) is None
    )
    assert (
        background.finished_policy(runs / PHASES.name) == runs / PHASES.name / "policy.safetensors"
    )
    assert background.training_seconds(runs / PHASES.name) > 0.0
    assert not any("--resume" in child.arguments for child in started)


def test_a_stopped_training_goes_on_and_one_without_a_checkpoint_begins_anew(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FINISHES.replace("p.mkdir(); ", ""), GRAPSXL.name: FINISHES}
    wanted = request(tmp_path, 20.0, "--updates", "9")
    (wanted.runs / OURS.name / "checkpoints").mkdir(parents=True)
    (wanted.runs / OURS.name / "checkpoints" / "checkpoint_00000003.safetensors").touch()
    (wanted.runs / GRAPSXL.name).mkdir()
    (wanted.runs / GRAPSXL.name / "config.json").touch()
    assert train_all(wanted, [OURS, GRAPSXL], silent) == {}
    ours, graspxl = (child.arguments for child in started)
    assert "--resume" in ours and ours[-2:] == ["--updates", "9"] and "--preset" not in ours
    run = str(wanted.runs / GRAPSXL.name)
    assert (
        graspxl[graspxl.index("--run-dir") + 1] == run
        and graspxl[graspxl.index("--evaluation") + 1] == "0"
    )
    assert "--resume" not in graspxl and not (wanted.runs / GRAPSXL.name / "config.json").exists()


@pytest.mark.parametrize(
    "policy", [OURS, GRAPSXL, PolicyKey("allegro", "ours")], ids=lambda policy: policy.name
)
def test_its_command_lines_are_those_of_train(policy):
    arguments = [*training_options(policy), "--environments", "4096"]
    train = parse_errors.parse("train", main.load("train"), arguments)
    config = train.keywords["config"]
    assert (config.task.hand, config.environments) == (policy.hand, 4096)
    assert train.keywords["method"] == (None if policy.method == "ours" else policy.method)
    assert dataclasses.replace(config, environments=32_768) == get_preset("full", policy.hand)
