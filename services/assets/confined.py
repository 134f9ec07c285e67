"""Functions in a child process under limits of memory and time.

They read strangers' files, or call native code.

Native code cannot be interrupted, and a few lines of a file can exceed a machine's resources.
`python -m congrasp.services.assets.confined FUNCTION FOLDER MEMORY SECONDS PARENT PACKAGE ...` is
that process: FUNCTION ("module:name") is called with FOLDER and the options from the standard
input; its result goes to FOLDER/answer.json. It ends with the process whose id is PARENT.
"""

import importlib
import json
import os
import pathlib
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.confinement import Limits, run_confined
from congrasp.common.runtime.platforms import end_with, limit_this_process, signals_named
from congrasp.common.runtime.process_variables import child_environment
from congrasp.services.ops import causes

_ANSWER = "answer.json"
_WRITE_FAILED = 74
"""Exit code of a child that cannot write its answer."""
_STARTED = "started"
"""File that the child creates once its imports are done."""
_MODULE = "congrasp.services.assets.confined"
_FROM_OUTSIDE = signals_named("SIGHUP", "SIGINT", "SIGTERM")
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
    limits: Limits,
    *,
    packages: Sequence[str] = (),
    on_wait: Callable[[], None] = lambda: None,
) -> Any:
    """Calls a function of a module in a child process.

    Processor time is limited, so that the load of the machine affects the time, but not the result.
    The messages of the ChildProcessErrors are phrases without a subject, such as "took longer than
    30 s of processor time".

    Args:
      function: called as function(folder, **options); returns what JSON takes.
      folder: an empty folder, or one with arrays for the function; it may write others.
      options: further arguments, as JSON takes them.
      limits: limits of the child.
      packages: packages that the function uses, imported before its module: a missing one fails
        soonest.
      on_wait: called twice a second while the child runs; what it raises ends the child.

    Raises:
      CongraspError: of the function.
      TimeoutError: it did not end within the limit of wall-clock time.
      OutOfResources: it reached its limit of processor time or memory, or the system killed it.
      EnvironmentFailure: it did not start, or failed for a reason that is not the function's.
      ChildProcessError: it ended without an answer.
    """
    env = child_environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", JAX_PLATFORMS="cpu")
    called = f"{function.__module__}:{function.__name__}"
    memory = limits.memory
    seconds = limits.processor_s
    arguments = [called, str(folder), str(memory), str(seconds), str(os.getpid()), *packages]
    try:
        child = run_confined(
            [sys.executable, "-P", "-m", _MODULE, *arguments],
            limits,
            env,
            stream="stderr",
            data=json.dumps(options).encode(),
            on_wait=on_wait,
        )
    except TimeoutError:  # which is an OSError, too
        raise
    except OSError as error:
        raise EnvironmentFailure(f"did not start ({error.strerror})") from None
    if child.excess == "time":
        raise OutOfResources(f"took longer than {seconds:g} s of processor time")
    if child.excess == "memory":
        raise OutOfResources(f"took more than {memory / 1e9:g} GB of memory")
    if child.excess == "killed":
        raise OutOfResources("was killed by the system, which may be out of memory")
    try:
        answer = json.loads((folder / _ANSWER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise _failure(folder, child.code, child.output.decode(errors="replace")) from None
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
    if code == 0:  # `subprocess` reports 0 for every child while SIGCHLD is ignored
        return EnvironmentFailure("ended without an answer")
    if code == _WRITE_FAILED:
        return EnvironmentFailure(f"failed ({reason})")
    if -code in _FROM_OUTSIDE:
        return EnvironmentFailure(f"was ended by {signal.Signals(-code).name}")
    if causes.is_shortage(output):
        return OutOfResources(f"failed ({reason})")
    return ChildProcessError(f"failed ({reason})")


def _child(
    called: str, folder: str, memory: str, seconds: str, parent: str, *packages: str
) -> None:
    """Calls the function; ends at a limit, or when the parent is gone."""
    for package in packages:
        importlib.import_module(package)
    module, _, name = called.partition(":")
    function = getattr(importlib.import_module(module), name)
    options = json.load(sys.stdin)
    end_with(int(parent))
    limit_this_process(int(memory), float(seconds))
    pathlib.Path(folder, _STARTED).touch()
    try:
        answer = {"result": function(pathlib.Path(folder), **options)}
    except CongraspError as error:
        answer = {"error": str(error)}
    except (ImportError, OSError) as error:  # a fault of the input is a CongraspError
        answer = {"environment": f"{type(error).__name__}: {error}"}
    text = json.dumps(answer)
    try:
        pathlib.Path(folder, _ANSWER).write_text(text, encoding="utf-8")
    except OSError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(_WRITE_FAILED)


if __name__ == "__main__":
    _child(*sys.argv[1:])
