"""Functions in a child process under limits of memory and time.

They read strangers' files, or call native code.

Native code cannot be interrupted, and a few lines of a file can exceed a machine's resources.
`python -m congrasp.services.assets.confined FUNCTION FOLDER MEMORY SECONDS PACKAGE ...` is that
process. FUNCTION ("module:name") is called with FOLDER and the options from the standard input; its
result goes to FOLDER/answer.json.
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
from collections.abc import Callable, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.environment import child_environment
from congrasp.services.ops import causes

_ANSWER = "answer.json"
_STARTED = "started"
"""File that the child creates once its imports are done."""
_MODULE = "congrasp.services.assets.confined"
_PARENT_CHECK_S = 0.5
"""Time between two checks whether the parent is still there."""
_FROM_OUTSIDE = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
"""Signals by which others end a process."""


class OutOfResources(ChildProcessError):
    """The child reached its limit of processor time or memory, or was killed by the system."""


class EnvironmentFailure(ChildProcessError):
    """The child could not do its work here, whatever the function and its input: it did not start,
    a package cannot be imported, a file cannot be written, or another process ended it.
    """


def call_confined(
    function: Callable[..., Any],
    folder: pathlib.Path,
    options: dict[str, Any],
    *,
    memory: int,
    seconds: float,
    patience: float,
    packages: Sequence[str] = (),
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
      packages: packages that the function uses, imported before it is called.

    Raises:
      CongraspError: of the function.
      TimeoutError: it did not end within `patience`.
      OutOfResources: it reached its limit of processor time or memory, or the system killed it.
      EnvironmentFailure: it did not start, or failed for a reason that is not the function's.
      ChildProcessError: it ended without an answer; the message, a predicate, states the reason, as
        it does for the two errors above.
    """
    env = child_environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", JAX_PLATFORMS="cpu")
    called = f"{function.__module__}:{function.__name__}"
    limits = [str(memory), str(seconds)]
    command = [sys.executable, "-P", "-m", _MODULE, called, str(folder), *limits, *packages]
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
    except OSError as error:
        raise EnvironmentFailure(f"did not start ({error.strerror})") from None
    if child.returncode == -signal.SIGPROF:
        raise OutOfResources(f"took longer than {seconds:g} s of processor time")
    if child.returncode == -signal.SIGKILL:
        raise OutOfResources("was killed by the system, which may be out of memory")
    try:
        answer = json.loads((folder / _ANSWER).read_text())
    except (OSError, ValueError):
        raise _failure(folder, child.returncode, child.stderr.decode(errors="replace")) from None
    if "error" in answer:
        raise CongraspError(answer["error"])
    if "environment" in answer:
        raise EnvironmentFailure(f"failed ({answer['environment']})")
    return answer["result"]


def _failure(folder: pathlib.Path, code: int, output: str) -> ChildProcessError:
    """Returns the error of a child without an answer.

    Args:
      folder: folder of the call.
      code: exit code of the child.
      output: what it wrote to its standard error.
    """
    reason = causes.cause_in(output) or causes.last_line(output) or f"exit code {code}"
    if not (folder / _STARTED).exists():
        return EnvironmentFailure(f"did not start ({reason})")
    if code == 0:  # where the ends of children are ignored, their exit codes are lost
        return EnvironmentFailure("ended without an answer")
    if -code in _FROM_OUTSIDE:
        return EnvironmentFailure(f"was ended by {signal.Signals(-code).name}")
    if causes.is_shortage(output):
        return OutOfResources(f"failed ({reason})")
    return ChildProcessError(f"failed ({reason})")


def _child(called: str, folder: str, memory: str, seconds: str, *packages: str) -> None:
    """Calls the function; ends at a limit, or when the parent is gone."""
    module, _, name = called.partition(":")
    function = getattr(importlib.import_module(module), name)
    for package in packages:
        importlib.import_module(package)
    options = json.load(sys.stdin)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    signal.setitimer(signal.ITIMER_PROF, float(seconds))  # its signal ends the process
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pathlib.Path(folder, _STARTED).touch()
    try:
        answer = {"result": function(pathlib.Path(folder), **options)}
    except CongraspError as error:
        answer = {"error": str(error)}
    except (ImportError, OSError) as error:
        answer = {"environment": f"{type(error).__name__}: {error}"}
    pathlib.Path(folder, _ANSWER).write_text(json.dumps(answer))


def _end_with(parent: int) -> None:
    """Ends this process after its parent, whose id is given."""
    while os.getppid() == parent:
        time.sleep(_PARENT_CHECK_S)
    os._exit(1)


if __name__ == "__main__":
    _child(*sys.argv[1:])
