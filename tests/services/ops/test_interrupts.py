"""Ctrl-C in a command, also where a callback of a library swallows its exception."""

import signal
import subprocess
import sys
import threading
import types

import pytest

from congrasp.services.ops import interrupts
from congrasp.services.ops.interrupts import interrupts_reach
from congrasp.services.ops.lifetime import Stop

LOOP = """
import gc, signal, sys, time
from congrasp.services.cli import main
from congrasp.services.ops.interrupts import check_stopped

def collect(phase, info):
    if phase == "stop" and not collect.done:
        collect.done = True
        print("ready", flush=True)
        ends = time.monotonic() + 60
        while time.monotonic() < ends:
            time.sleep(0.01)
collect.done = False

def swallow():
    print("ready", flush=True)
    try:
        time.sleep(60)
    except BaseException:
        pass

def work():
    if KIND in ("callback", "loading"):
        gc.callbacks.append(collect)
        gc.collect()
    elif KIND == "handler":
        swallow()
    else:
        print("ready", flush=True)
    while True:
        if KIND == "handler":
            check_stopped()
        time.sleep(0.01)

def load(name):
    if KIND == "loading":
        work()
    return lambda rest: __import__("functools").partial(work)

# A command that tells its end itself, but only after it has started
main.load = load
main.main(["serve" if KIND == "loading" else "plot"])
"""


@pytest.mark.parametrize("kind", ["plain", "callback", "handler", "loading"])
@pytest.mark.parametrize(
    ("number", "code", "word"),
    [
        (signal.SIGINT, 130, "Ctrl-C"),
        (signal.SIGTERM, 143, "SIGTERM"),
        (signal.SIGHUP, 129, "SIGHUP"),
    ],
)
def test_command_ends_with_one_line(kind, number, code, word):
    # Whoever started the tests may ignore the signal, as nohup does.
    restore = f"import signal; signal.signal({number:d}, signal.SIG_DFL)"
    if number == signal.SIGINT:
        restore = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    arguments = [sys.executable, "-c", f"{restore}\nKIND = {kind!r}\n{LOOP}"]
    pipe = subprocess.PIPE
    with subprocess.Popen(arguments, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        _, error = process.communicate(timeout=30)
    assert process.returncode == code
    (line,) = error.splitlines()
    assert word in line


def test_no_interrupt_is_raised_after_the_command(monkeypatch):
    """The command ends while the swallowed interrupt is being raised: it waits for that."""
    raising = threading.Event()
    proceed = threading.Event()
    raised = threading.Event()

    def raise_slowly():
        raising.set()
        assert proceed.wait(30)
        raised.set()

    monkeypatch.setattr(interrupts, "raise_in_main_thread", raise_slowly)
    with interrupts_reach(Stop()):
        sys.unraisablehook(types.SimpleNamespace(exc_type=KeyboardInterrupt))
        assert raising.wait(30)
        threading.Timer(0.3, proceed.set).start()
    assert raised.is_set()


def test_nohup_lets_a_command_continue():
    ignore = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    arguments = [sys.executable, "-c", f"{ignore}\nKIND = 'plain'\n{LOOP}"]
    pipe = subprocess.PIPE
    with subprocess.Popen(arguments, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Ctrl-C" in error
