"""Processes that work for this one, and exchange messages with it over their standard streams.

Such a process imports this library alone: it never runs the caller's `__main__`, which the start
methods of `multiprocessing` import. Both ends of the messages are this library.
"""

import contextlib
import importlib
import multiprocessing.connection
import multiprocessing.spawn
import os
import subprocess
import sys
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from typing import IO, Any

from congrasp.common.runtime import platforms
from congrasp.common.runtime.process_variables import child_environment

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
"""Environment of workers, whatever that of this process: each would otherwise start a thread for
every core, for products so small that the threads cost several times the work."""
_LENGTH_BYTES = 8
"""Size of the length before each message."""


class Messages:
    """Messages to and from the process at the other end of two streams."""

    def __init__(self, incoming: IO[bytes], outgoing: IO[bytes]):
        self._incoming = incoming
        self._outgoing = outgoing

    def send(self, message: Any) -> None:
        """Writes a message.

        Raises:
          OSError: the process at the other end is gone.
        """
        data = ForkingPickler.dumps(message)
        self._outgoing.write(len(data).to_bytes(_LENGTH_BYTES, "little"))
        self._outgoing.write(data)
        self._outgoing.flush()

    def receive(self) -> Any:
        """Reads a message.

        Raises:
          EOFError: the process at the other end is gone.
        """
        return decode(self.receive_bytes())

    def receive_bytes(self) -> bytes:
        """Reads a message for `decode`.

        Raises:
          EOFError: the process at the other end is gone.
        """
        length = int.from_bytes(self._read(_LENGTH_BYTES), "little")
        return self._read(length)

    def close(self) -> None:
        """Closes both streams; the rest of a message is lost."""
        for stream in (self._outgoing, self._incoming):
            with contextlib.suppress(OSError):
                stream.close()

    def _read(self, count: int) -> bytes:
        """Reads bytes; raises an EOFError if there are fewer."""
        data = self._incoming.read(count)
        if len(data) < count:
            raise EOFError
        return data


def decode(data: bytes) -> Any:
    """Returns the message of its bytes; raises any error if this process lacks its classes."""
    return ForkingPickler.loads(data)


class WorkerProcess:
    """A process that serves this one. It ends when this one does."""

    def __init__(self, serve: Callable[[Messages], None], **variables: str):
        """Starts the process.

        Args:
          serve: top-level function of a module of this library; it runs in the process, which ends
            with it. It must return when its messages end.
          variables: further variables of its environment. JAX has the CPU alone by default.

        Raises:
          OSError: the process cannot start.
        """
        paths = [str(path) for path in sys.path]
        code = (
            f"import sys; sys.path[:] = {paths}; from {__name__} import run; "
            f"run({serve.__module__!r}, {serve.__name__!r})"
        )
        variables = {"JAX_PLATFORMS": "cpu", "PYTHONWARNINGS": "ignore", **variables}
        environment = child_environment(**_ONE_THREAD, **variables)
        self._process = subprocess.Popen(
            [multiprocessing.spawn.get_executable(), "-P", "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            **platforms.separate_session(),  # Ctrl-C on a terminal reaches only the caller
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._messages = Messages(self._process.stdout, self._process.stdin)
        self.send = self._messages.send
        self.receive = self._messages.receive

    def stop(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._messages.close()
        self._process.wait()


def run(module: str, function: str) -> None:
    """Runs a function of a module on the messages of the process at the other end of the standard
    streams. What it prints goes to the standard error.
    """
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as answers:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        getattr(importlib.import_module(module), function)(Messages(sys.stdin.buffer, answers))
