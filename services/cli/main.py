"""`congrasp COMMAND …`: finds the command's module, runs it, and turns errors into one line and an
exit code.
"""

import importlib
import inspect
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import congrasp
from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder, can_cache
from congrasp.common.runtime.platforms import BROKEN_PIPE_CODE
from congrasp.common.runtime.process_variables import clean_environment
from congrasp.services.cli import suggestions
from congrasp.services.cli.checks import check_inputs, check_outputs
from congrasp.services.cli.errors import failure_of
from congrasp.services.cli.not_a_number import check_numbers
from congrasp.services.cli.parse_errors import parse
from congrasp.services.cli.process import (
    SIGNALLED,
    end_process,
    prepare_streams,
    restore_signals,
    undo_interpreter_options,
    write_if_possible,
)
from congrasp.services.cli.terminal import ensure_width
from congrasp.services.cli.variables import check_xla_flags
from congrasp.services.cli.words import check_typography, expand_homes
from congrasp.services.ops.interrupts import interrupts_reach
from congrasp.services.ops.lifetime import follow_parent, on_signal, stopped_line
from congrasp.services.ops.logs import announce_progress, log_error

COMMANDS = {
    "train": "train a policy: a learner and its actors on this machine",
    "warmup": "compile the programs of a training in advance",
    "learner": "the learner alone; actors connect to it, from this machine or others",
    "actor": "one actor for a learner on this or another machine",
    "serve": "answer live queries with a run's newest policy or a policy file",
    "grasp": "a grasp motion for a custom object, under constraints",
    "dataset": "verified grasps of many objects, in shards, with a card",
    "evaluate": "measure a policy by the paper's protocol",
    "reproduce": "the paper's tables: train what is missing, evaluate, compare",
    "query": "query a policy server for one action, or measure its latency",
    "objects": "generate, import, list and show objects",
    "hands": "list, draw, check and import hands; from a URDF to its policy",
    "policies": "list policies, and download those of a release",
    "constraints": "make and show the constraint sets of objects",
    "record": "record a run to MCAP, from this machine or another",
    "plot": "draw a run's learning curves and reward terms",
    "report": "one HTML file about a policy: results, pictures, curves, model card",
    "export": "a policy as ONNX or StableHLO, a motion as GLB, USD, BVH, ROS 2 or LeRobot",
    "render": "draw the hand, or an episode of a run",
    "view": "the constraint studio and the state of a training, in the browser",
    "status": "processes, state and counters of a live run",
    "audit": "the outcome of every rollout of a run",
    "bench": "benchmarks, as ratios against a reference",
    "certs": "certificates for mutual TLS between the processes of a run",
    "completion": "completion of commands and options in bash, zsh and fish",
    "doctor": "what is wrong with this machine or installation",
}
"""Commands in the order of the help."""
_MODULES = {"doctor": "ops.doctor", "status": "ops.status"}
"""Modules in `services` of commands that are not in `services.cli`."""

_NUMPY_WARNINGS = (
    "(divide by zero|invalid value|overflow|underflow) encountered",
    "Mean of empty slice",
    "All-NaN (slice|axis) encountered",
    "Degrees of freedom <= 0",
)
"""Warnings of NumPy that tell a user nothing: commands check their results themselves."""
UNREAD = BROKEN_PIPE_CODE
"""Exit code if the reader of the output is gone, as with `congrasp … | head`."""
_REPORT_THEIR_END = ("train", "learner", "actor", "serve", "record", "view")
"""Commands that print or log themselves that a signal stopped them, once they have started."""
_LATE_SIGNAL_S = 1.0
"""Longest wait for the thread that records a signal."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `congrasp` script; ends the process with the command's exit code.

    Args:
      arguments: words of the command line; by default those of the process, which then runs nothing
        but the command.
    """
    owns_process = arguments is None
    if owns_process:
        prepare_streams()
        restore_signals()
        undo_interpreter_options()
    words = list(sys.argv[1:] if arguments is None else arguments)
    follow_parent()
    debug = "--debug" in words
    if debug:
        words.remove("--debug")
    code = _exit_code(words, debug)
    end_process(code, owns_process=owns_process)


def _exit_code(arguments: list[str], debug: bool) -> int:
    """Runs one command, and prints an error that ends it; raises errors that are bugs."""
    try:
        return run(arguments)
    except BrokenPipeError:
        # If the output can still be written, another pipe is broken, which is a bug.
        is_another_pipe = write_if_possible(sys.stdout, "\n")
        if is_another_pipe:
            raise
        return UNREAD
    except SystemExit as end:  # rich raises it for a broken pipe
        if not isinstance(end.__context__, BrokenPipeError):
            raise
        return UNREAD
    except Exception as error:
        failure = failure_of(error)
        if failure is None:
            raise
        if debug:
            traceback.print_exc()
        if not log_error(failure.text):
            write_if_possible(sys.stderr, f"congrasp: error: {failure.text}\n")
        return failure.exit_code


def run(arguments: list[str]) -> int:
    """Runs one command; returns its exit code, 128 and the number of the signal that stopped it."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    name, *words = arguments
    if name == "--version":
        print(congrasp.__version__)
        return 0
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        remedy = suggestions.command_remedy(arguments, list(COMMANDS))
        raise CongraspError(f"There is no {kind} '{name}'.", remedy)
    rest = expand_homes(words)
    check_typography(rest)
    check_inputs(rest)
    check_xla_flags()
    prepare_environment()
    interrupted = False
    code = 0
    with on_signal(interrupt=True) as stop:
        try:
            with interrupts_reach(stop):
                result = _call(name, rest)
                if isinstance(result, int):
                    code = result
        except KeyboardInterrupt:
            interrupted = True
            stop.wait(_LATE_SIGNAL_S)
        code = stop.exit_code or code
    if code in SIGNALLED and (interrupted or name not in _REPORT_THEIR_END):
        write_if_possible(sys.stderr, f"{stopped_line(code)}\n")
    return code


def _call(name: str, arguments: list[str]) -> Any:
    """Loads a command, parses and checks its arguments, and calls it."""
    with announce_progress(f"Loading 'congrasp {name}'"):
        call = parse(name, load(name), arguments)
    check_numbers(getattr(call, "keywords", {}))
    check_outputs(call)
    return call()


def module_of(name: str) -> Any:
    """Returns the module of a command."""
    return importlib.import_module(f"congrasp.services.{_MODULES.get(name, f'cli.{name}')}")


def load(name: str) -> Callable[[list[str]], Callable[[], Any]]:
    """Returns the command's module as a function from its arguments to the requested call."""
    from congrasp.services.cli import parser

    module = module_of(name)
    prog = f"congrasp {name}"
    if hasattr(module, "COMMANDS"):
        return parser.of_group(module.COMMANDS, prog, inspect.getdoc(module))
    if hasattr(module, "defaults"):
        return parser.of_command(module.COMMAND, prog, module.defaults)
    return parser.of_command(module.COMMAND, prog)


def usage() -> str:
    """Text of `congrasp --help`."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        "usage: congrasp COMMAND [options]\n\n"
        "Dexterous grasping under constraints: distributed training and a live policy.\n\n"
        f"{rows}\n\n"
        "Options of every command: --help, and --debug for the trace of an error.\n"
        "First steps: 'congrasp grasp mug:7', or a mesh of yours, 'congrasp view', "
        "'congrasp train'.\n"
    )


def prepare_environment() -> None:
    """Removes settings of other programs from the environment, and configures caches of compiled
    programs and compiler output, unless the user has.
    """
    clean_environment()
    ensure_width()
    for message in _NUMPY_WARNINGS:
        warnings.filterwarnings("ignore", message, RuntimeWarning)
    folder = cache_folder("jax")
    if not can_cache(folder.parent, "XDG_CACHE_HOME"):
        warnings.filterwarnings("ignore", "Error writing persistent compilation cache")
    if folder.is_dir() or can_cache(folder.parent, "XDG_CACHE_HOME"):
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # XLA's cache of GPU tuning would make the folder's path a part of every key: programs could not
    # move to another.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "none")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


if __name__ == "__main__":
    main()
