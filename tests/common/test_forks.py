"""Forks of processes in which Zenoh or JAX runs: calls fail at once, and spawned processes work."""

import subprocess
import sys

import pytest

from tests.children import python

LISTENER = """
from congrasp.common.transport import urls
transport = urls.listen("tcp/127.0.0.1:{port}", "server")
print("up", flush=True)
input()
"""
PROGRAM = """
import multiprocessing, os, sys, time, warnings
warnings.simplefilter("ignore")  # of JAX, at a fork
import congrasp
from congrasp.common.errors import CongraspError

URL = "tcp/127.0.0.1:{port}"

def connect():
    from congrasp.common.transport import urls
    return urls.connect(URL, "client", wait=20.0)

def answer(call):
    try:
        call()
    except CongraspError as error:
        return f"{{type(error).__name__}}: {{error}}"
    return "works"

def attempt(pipe, call):
    pipe.send(answer(call))

def in_child(method, call):
    context = multiprocessing.get_context(method)
    reader, writer = context.Pipe(False)
    child = context.Process(target=attempt, args=(writer, call), daemon=True)
    child.start()
    print(reader.recv() if reader.poll(60.0) else "silent")
    child.join(20.0)
    print("ended" if child.exitcode == 0 else f"exit code {{child.exitcode}}")
    child.kill()

def in_fork(call):
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        print(answer(call), flush=True)
        sys.exit(0)
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            print("ended" if status == 0 else f"status {{status}}")
            return
        time.sleep(0.05)
    os.kill(child, 9)
    print("silent")

if __name__ == "__main__":
{body}
"""
PORT = 17631


@pytest.fixture(scope="module")
def listener():
    command = [sys.executable, "-c", LISTENER.format(port=PORT)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"up\n"
        yield
        process.kill()


def lines_of(tmp_path, body: str) -> list[str]:
    """Runs a program with this body; returns its lines."""
    program = tmp_path / "program.py"
    indented = "".join(f"    {line}\n" for line in body.strip().splitlines())
    program.write_text(PROGRAM.format(port=PORT, body=indented))
    done = python(program)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


OPEN = "transport = connect()\n"
CLOSED = "connect().close()\n"
CALLER = "import jax\njax.numpy.ones(3).block_until_ready()\n"
LOAD = "lambda: congrasp.load_policy({policy!r})"
LOADED = "policy = congrasp.load_policy({policy!r})\n"


@pytest.mark.parametrize(
    "before",
    [
        pytest.param(OPEN + "call = lambda: transport.declare_alive('a/b')", id="open transport"),
        pytest.param(OPEN + "call = connect", id="new transport, one open"),
        pytest.param(CLOSED + "call = connect", id="new transport, one closed"),
        pytest.param(CALLER + f"call = {LOAD}", id="new policy, jax of the caller"),
        pytest.param(LOADED + "call = policy.metadata", id="open policy"),
        pytest.param(LOADED + "call = lambda: policy.act({{}})", id="act of an open policy"),
    ],
)
def test_a_fork_is_refused(before, listener, tmp_path, short_policy):
    """By a module of the standard library, and by the system's call from the same process."""
    forks = ["in_child('fork', call)"]
    # JAX crashes at the end of a forked interpreter that has compiled programs
    if "policy = " not in before:
        forks.append("in_fork(call)")
    body = "\n".join([before.format(policy=str(short_policy)), *forks])
    lines = lines_of(tmp_path, body)
    assert len(lines) == 2 * len(forks)
    for answer in lines[::2]:
        assert answer.startswith("ForkError: ")
        assert "spawn" in answer
    assert lines[1::2] == ["ended"] * len(forks)


def test_a_fork_after_the_import_alone_works(listener, tmp_path):
    body = "congrasp.PolicyClient\nin_child('fork', connect)\nin_fork(connect)"
    assert lines_of(tmp_path, body) == ["works", "ended"] * 2


def test_a_spawned_process_works(listener, tmp_path):
    assert lines_of(tmp_path, f"{OPEN}in_child('spawn', connect)") == ["works", "ended"]


def test_a_memory_transport_is_refused_in_a_fork(tmp_path):
    body = """
from congrasp.common.transport import urls
from congrasp.common.wire.codec import Message
server = urls.listen("memory/a", "server")
client = urls.connect("memory/a", "client")
in_fork(lambda: client.declare_alive("a/b"))
in_fork(lambda: client.publish("a/b", Message()))
in_fork(lambda: urls.connect("memory/a", "client").declare_alive("a/b"))
"""
    lines = lines_of(tmp_path, body)
    assert len(lines) == 6
    for line in lines[::2]:
        assert line.startswith("ForkError: ")


def test_a_fork_may_listen_at_an_inherited_name(tmp_path):
    body = """
from congrasp.common.transport import urls
server = urls.listen("memory/a", "server")
in_fork(lambda: urls.listen("memory/a", "server").declare_alive("a/b"))
"""
    assert lines_of(tmp_path, body) == ["works", "ended"]
