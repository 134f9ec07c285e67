"""Functions in a child process under limits of memory and time.

They read strangers' files, or call native code.

Native code cannot be interrupted, and a few lines of a file can exceed a machine's resources.
`python -m congrasp.services.assets.confined FUNCTION FOLDER MEMORY SECONDS` is that process:
FUNCTION ("module:name") is called with FOLDER and the options from the standard input; what it
returns goes to FOLDER/answer.json.
"""

import importlib
import json
import os
import pathlib
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.environment import child_environment

_ANSWER = "answer.json"
_MODULE = "congrasp.services.assets.confined"
_PARENT_CHECK_S = 0.5
"""Time between two checks whether the parent is still there."""


class OutOfResources(ChildProcessError):
    """The child reached its limit of processor time, or was killed by the system."""


def call_confined(
    function: Callable[..., Any],
    folder: pathlib.Path,
    options: dict[str, Any],
    *,
    memory: int,
    seconds: float,
    patience: float,
) -> Any:
    """Calls a function of a module in a child process.

    Processor time is limited, so that the load of the machine affects the time, but not the result.

    Args:
      function: called as function(folder, **options); returns what JSON takes.
      folder: an empty folder, or one with arrays for the function; it may write others.
      options: further arguments, as JSON takes them.
      memory: limit of the address space, bytes.
      seconds: limit of the processor time, s.
      patience: limit of the wall-clock time, s.

    Raises:
      CongraspError: of the function.
      TimeoutError: it did not end within `patience`.
      OutOfResources: it reached its limit of processor time, or the system killed it, as it does
        without memory.
      ChildProcessError: it ended without an answer; the message states the reason.
    """
    env = child_environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", JAX_PLATFORMS="cpu")
    called = f"{function.__module__}:{function.__name__}"
    command = [sys.executable, "-P", "-m", _MODULE, called, str(folder), str(memory), str(seconds)]
    try:
        child = subprocess.run(
            command,
            input=json.dumps(options).encode(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=patience,
            env=env,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError from None
    if child.returncode == -signal.SIGPROF:
        raise OutOfResources(f"took longer than {seconds:g} s of processor time")
    if child.returncode == -signal.SIGKILL:
        raise OutOfResources("was killed by the system, which may be out of memory")
    try:
        answer = json.loads((folder / _ANSWER).read_text())
    except (OSError, ValueError):
        reason = f"exit code {child.returncode}"
        lines = child.stderr.decode(errors="replace").strip().splitlines()
        if lines:
            reason = lines[-1]
        raise ChildProcessError(f"failed ({reason})") from None
    if "error" in answer:
        raise CongraspError(answer["error"])
    return answer["result"]


def _child(called: str, folder: str, memory: str, seconds: str) -> None:
    """Calls the function; ends at a limit, or when the parent is gone."""
    module, _, name = called.partition(":")
    function = getattr(importlib.import_module(module), name)
    options = json.load(sys.stdin)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    signal.setitimer(signal.ITIMER_PROF, float(seconds))  # its signal ends the process
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        answer = {"result": function(pathlib.Path(folder), **options)}
    except CongraspError as error:
        answer = {"error": str(error)}
    pathlib.Path(folder, _ANSWER).write_text(json.dumps(answer))


def _end_with(parent: int) -> None:
    """Ends this process after its parent, whose id is given."""
    while os.getppid() == parent:
        time.sleep(_PARENT_CHECK_S)
    os._exit(1)


if __name__ == "__main__":
    _child(*sys.argv[1:])
