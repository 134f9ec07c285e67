"""Runs what a hostile file may make of a reader where it can hurt nobody: a process with little
memory and time.
"""

import multiprocessing
import resource
import traceback
from collections.abc import Callable
from typing import Any

MEMORY = 768 << 20
"""Bytes that the process may take beside what this one has."""
SECONDS = 15.0


def limited(
    function: Callable[..., Any], *arguments: Any, memory: int = MEMORY, seconds: float = SECONDS
) -> str:
    """What `function(*arguments)` returns as text, or the error that it raises with its type in
    front.

    An AssertionError where it takes longer, or its process dies.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_run, args=(theirs, memory, function, arguments), daemon=True)
    child.start()
    theirs.close()
    try:
        assert ours.poll(seconds), f"it took longer than {seconds} s"
        try:
            return ours.recv()
        except EOFError:
            child.join(5)
            raise AssertionError(f"its process died with exit code {child.exitcode}") from None
    finally:
        child.kill()
        child.join(5)


def _run(pipe: Any, memory: int, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + memory, taken + memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        result = str(function(*arguments))
    except MemoryError as error:
        result = f"MemoryError: {error}"
    except BaseException as error:
        kind = type(error).__name__
        result = (
            f"{kind}: {error}" if kind == "CongraspError" else f"{kind}: {traceback.format_exc()}"
        )
    pipe.send(result)
