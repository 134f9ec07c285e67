"""Functions in a child process under limits of memory and time.

They read strangers' files, or call native code.

Native code cannot be interrupted, and a few lines of a file can exceed a machine's resources.
`python -m congrasp.services.assets.confined FUNCTION FOLDER MEMORY SECONDS PARENT` is that process:
FUNCTION ("module:name") is called with FOLDER and the options from the standard input; what it
returns goes to FOLDER/answer.json. It ends with the process whose id is PARENT.
"""

import importlib
import json
import os
import pathlib
import sys
from collections.abc import Callable
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.confinement import Limits, run_confined
from congrasp.common.runtime.environment import child_environment
from congrasp.common.runtime.platforms import end_with, limit_this_process

_ANSWER = "answer.json"
_MODULE = "congrasp.services.assets.confined"


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
    arguments = [called, str(folder), str(memory), str(seconds), str(os.getpid())]
    limits = Limits(memory=memory, processor_s=seconds, patience_s=patience)
    child = run_confined(
        [sys.executable, "-P", "-m", _MODULE, *arguments],
        limits,
        env,
        "stderr",
        json.dumps(options).encode(),
    )
    if child.excess == "time":
        raise OutOfResources(f"took longer than {seconds:g} s of processor time")
    if child.excess == "memory":
        raise OutOfResources(f"took more than {memory / 1e9:g} GB of memory")
    if child.excess == "killed":
        raise OutOfResources("was killed by the system, which may be out of memory")
    try:
        answer = json.loads((folder / _ANSWER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        reason = f"exit code {child.code}"
        lines = child.output.decode(errors="replace").strip().splitlines()
        if lines:
            reason = lines[-1]
        raise ChildProcessError(f"failed ({reason})") from None
    if "error" in answer:
        raise CongraspError(answer["error"])
    return answer["result"]


def _child(called: str, folder: str, memory: str, seconds: str, parent: str) -> None:
    """Calls the function; ends at a limit, or when the parent is gone."""
    module, _, name = called.partition(":")
    function = getattr(importlib.import_module(module), name)
    options = json.load(sys.stdin)
    end_with(int(parent))
    limit_this_process(int(memory), float(seconds))
    try:
        answer = {"result": function(pathlib.Path(folder), **options)}
    except CongraspError as error:
        answer = {"error": str(error)}
    pathlib.Path(folder, _ANSWER).write_text(json.dumps(answer), encoding="utf-8")


if __name__ == "__main__":
    _child(*sys.argv[1:])
