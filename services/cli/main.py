"""`congrasp COMMAND …`: finds the command's module, runs it, and turns errors into one line and an
exit code.
"""

import contextlib
import difflib
import errno
import importlib
import inspect
import io
import os
import pathlib
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TextIO

import congrasp
from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.io.files import cache_folder, can_cache, check_output
from congrasp.common.runtime.environment import child_environment, own_environment
from congrasp.services.cli import suggestions
from congrasp.services.cli.not_a_number import check_numbers
from congrasp.services.cli.shell_specs import spec_of
from congrasp.services.cli.terminal import ensure_width
from congrasp.services.cli.variables import check_xla_flags, variable_error
from congrasp.services.ops.interrupts import ending, interrupts_reach
from congrasp.services.ops.lifetime import SIGNALS, follow_parent, on_signal
from congrasp.services.ops.logs import announced, log_error

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
_MODULES = {"audit": "ops.audit", "doctor": "ops.doctor", "status": "ops.status"}
"""Modules in `services` of commands that are not in `services.cli`."""

_READ = {
    ".obj",
    ".stl",
    ".ply",
    ".glb",
    ".npz",
    ".csv",
    ".bvh",
    ".mcap",
    ".safetensors",
    ".urdf",
    ".xml",
}
"""Suffixes of files that commands read."""
_WRITTEN = ("--out", "--json", "--png", "--video", "--pictures", "--references")
"""Options for files and folders that a command writes, or creates if they are absent."""
_OUTPUTS = ("out", "json", "png", "pictures", "video")
"""Parameters of commands with a file or a folder that they write."""
_QUIET_WARNINGS = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Categories that Python itself ignores."""
_NUMPY_WARNINGS = (
    "(divide by zero|invalid value|overflow|underflow) encountered",
    "Mean of empty slice",
    "All-NaN (slice|axis) encountered",
    "Degrees of freedom <= 0",
)
"""Warnings of NumPy that tell a user nothing: commands check their results themselves."""
USAGE_ERROR = 2
UNREAD = 128 + signal.SIGPIPE
"""Exit code if the reader of the output is gone, as with `congrasp … | head`."""
_TELL_THEIR_END = ("train", "learner", "actor", "serve", "record", "view")
"""Commands that print or log themselves that a signal stopped them, once they have started."""
SIGNALLED = (128 + signal.SIGINT, 128 + signal.SIGTERM)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LESS_MEMORY = (
    "Choose fewer --environments or a smaller --batch; on a GPU, XLA_PYTHON_CLIENT_MEM_FRACTION is "
    "JAX's share of it."
)
_NO_MEMORY = re.compile(
    r"(?:out[ _]of[ _]memory|failed to allocate (?:request for )?\d)[^[\n]*|RESOURCE_EXHAUSTED",
    re.IGNORECASE,
)
_PATH = (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError, FileExistsError)
_PATH_NUMBERS = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP)


def main(arguments: Sequence[str] | None = None) -> None:  # noqa: C901
    """Entry point of the `congrasp` script; ends the process with the command's exit code."""
    alone = arguments is None  # no other code uses this process
    for name in ("stdout", "stderr") if alone else ():
        if isinstance(
            stream := getattr(sys, name), io.TextIOWrapper
        ):  # characters it lacks become escapes
            stream.reconfigure(errors="backslashreplace")
        elif stream is None:  # the shell closed it
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    if alone:
        _own_interpreter()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    follow_parent()
    debug = "--debug" in arguments
    if debug:
        arguments.remove("--debug")
    try:
        code = run(arguments)
    except CongraspError as error:
        code = _fail(str(error), error.exit_code, debug)
    except BrokenPipeError:
        if _last_words(sys.stdout, "\n"):  # another pipe broke
            raise
        code = UNREAD
    except SystemExit as end:  # rich raises it for a broken pipe
        if not isinstance(end.__context__, BrokenPipeError):
            raise
        code = UNREAD
    except OSError as error:
        code = _fail(_said_of(error), USAGE_ERROR, debug)
    except (
        RuntimeError,
        ValueError,
        AssertionError,
    ) as error:  # of libraries whose types are imported late
        code = _fail(*_said_by(error), debug)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "congrasp":
            raise
        code = _fail(str(MissingPackageError("This", package)), USAGE_ERROR, debug)
    _last_words(sys.stdout)
    # Native code of a daemon thread that is late, such as one that closes Zenoh, aborts in the
    # interpreter's shutdown. That also waits for other threads, such as one that builds kernels for
    # minutes: after a failure, for nothing.
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    late = [thread for thread in others if thread.name != SIGNALS and (thread.daemon or code)]
    if code in SIGNALLED or (alone and late):
        _last_words(sys.stderr)
        os._exit(code)
    sys.exit(code)


def _own_interpreter() -> None:
    """Undoes the interpreter's options that change what a command does: removed docstrings, which
    are the help, and filters that turn warnings into errors.
    """
    if sys.flags.optimize > 1:
        command = [sys.executable, "-m", "congrasp", *sys.argv[1:]]
        os.execve(sys.executable, command, child_environment())
    if sys.warnoptions:
        sys.warnoptions.clear()
        warnings.resetwarnings()
        for category in _QUIET_WARNINGS:
            warnings.simplefilter("ignore", category)


def _said_of(error: OSError) -> str:
    """Describes a full disk, or an unusable path, to the user; raises other errors, which are
    bugs.
    """
    if error.errno in _FULL:
        where = (
            f"{error.filename} could not be written"
            if error.filename
            else "A file could not be written"
        )
        return f"{where}: {error.strerror}. Free space and start again."
    if error.filename and (isinstance(error, _PATH) or error.errno in _PATH_NUMBERS):
        what = f"{error.filename} cannot be used: {error.strerror}."
        return str(CongraspError(what, "Check the path and its permissions."))
    if error.errno == errno.ENOENT and "temporary directory" in str(error):
        return "There is no folder for temporary files that can be written. Set TMPDIR to one."
    if error.errno == errno.ENOENT and not error.filename:
        return "The working folder does not exist any more. Change to another."
    if error.errno == errno.EIO:
        return "A file could not be read or written, because its disk failed. Try another path."
    raise error


def _said_by(error: Exception) -> tuple[str, int]:
    """Text and exit code of a library's error about memory or an environment variable; raises
    others, as bugs.
    """
    if found := [text[0].strip(". ") for text in _NO_MEMORY.finditer(str(error))]:
        # No bad input: a run restarts its processes, since another program may have held the
        # memory.
        return f"The device's memory does not suffice: {max(found, key=len)}. {_LESS_MEMORY}", 1
    unusable = variable_error(error)
    if unusable is not None:
        return str(unusable), USAGE_ERROR
    raise error


def run(arguments: list[str]) -> int:
    """Runs one command; returns its exit code, 130 after Ctrl-C and 143 after SIGTERM."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    name, *rest = arguments
    if name == "--version":
        print(congrasp.__version__)
        return 0
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        remedy = suggestions.command_remedy(arguments, list(COMMANDS))
        raise CongraspError(f"There is no {kind} '{name}'.", remedy)
    _check_files(rest)
    check_xla_flags()
    _prepare_environment()
    interrupted = False
    with on_signal(interrupt=True) as stop:
        try:
            with interrupts_reach(stop):
                with announced(f"Loading 'congrasp {name}'"):
                    call = _parsed(name, load(name), rest)
                check_numbers(getattr(call, "keywords", {}))
                _check_outputs(call)
                result = call()
        except KeyboardInterrupt:
            interrupted = True
            result = None
            stop.wait(1.0)  # the thread that records the signal may be slightly late
        code = stop.exit_code or (result if isinstance(result, int) else 0)
    if code in SIGNALLED and (interrupted or name not in _TELL_THEIR_END):
        _last_words(sys.stderr, f"{ending(code)}\n")
    return code


def _check_files(arguments: Sequence[str]) -> None:
    """Raises a CongraspError for a missing input file, before the slow imports."""
    option = ""
    for argument in arguments:
        if argument.startswith("-"):
            option = argument
            continue
        if not argument and (not option or option in _WRITTEN):  # as of a variable that is not set
            raise CongraspError(f"{option or 'An argument'} is empty.", "Name a file or a folder.")
        path = pathlib.Path(re.sub(r":\w+$", "", argument))
        if path.suffix.lower() not in _READ or option in _WRITTEN or _is_there(path):
            continue
        named = f"{option}: there" if option else "There"
        siblings = (
            [one.name for one in path.parent.iterdir() if one.exists()]
            if path.parent.is_dir()
            else []
        )
        near = difflib.get_close_matches(path.name, siblings, 1)
        remedy = f"Did you mean {path.parent / near[0]}?" if near else "Check the path."
        raise CongraspError(f"{named} is no file {path}.", remedy)


def _check_outputs(call: Any) -> None:
    """Raises a CongraspError for an output that cannot be written, or a picture of another format,
    before the work.

    An output is a folder if its default has no suffix. A command that computes the default of --out
    checks it itself.
    """
    for name, path in call.keywords.items():
        if name in _OUTPUTS and isinstance(path, pathlib.Path):
            default = inspect.signature(call.args[0]).parameters[name].default
            if default or name != "out":
                check_output(
                    f"--{name}",
                    path,
                    is_folder=not default.suffix if default else name == "pictures",
                )
            is_png = name == "png" or (default and default.suffix == ".png")
            if is_png and path.suffix.lower() not in ("", ".png"):
                raise CongraspError(
                    f"--{name} is {path}, but the picture is a PNG.", "End its name in .png."
                )


def _is_there(path: pathlib.Path) -> bool:
    """Returns True if a path exists; raises an OSError for one that cannot be used."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def module_of(name: str) -> Any:
    """Returns the module of a command."""
    return importlib.import_module(f"congrasp.services.{_MODULES.get(name, f'cli.{name}')}")


def load(name: str) -> Callable[[list[str]], Callable[[], Any]]:
    """Returns the command's module as a function from its arguments to the requested call."""
    from congrasp.services.cli import parser

    module, prog = module_of(name), f"congrasp {name}"
    if hasattr(module, "COMMANDS"):
        return parser.of_group(module.COMMANDS, prog, inspect.getdoc(module))
    return parser.of_command(module.COMMAND, prog, getattr(module, "defaults", lambda rest: {}))


def _parsed(
    name: str, parse: Callable[[list[str]], Callable[[], Any]], arguments: list[str]
) -> Callable[[], Any]:
    """Parses a command line; errors are one line instead of the parser's box."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return parse(arguments)
    except SystemExit as end:
        if not end.code:
            raise
        inside = [line.strip("│ ") for line in said.getvalue().splitlines() if line.startswith("│")]
        rules = [i for i, line in enumerate(inside) if line.startswith("─")] or [len(inside)]
        rest = inside[rules[0] :]
        options = [line.split()[0].rstrip(",") for line in rest if line.startswith("--")]
        similar = options if "Perhaps you meant:" in rest else []
        what = " ".join(inside[: rules[0]]).rstrip(".")
        mistyped = suggestions.unrecognized(what)
        if mistyped and not similar:
            similar = suggestions.similar_words(mistyped, arguments, spec_of(parse))
        hint = f"Perhaps you meant {' or '.join(similar)}. " if similar else ""
        what = suggestions.plain_error(what)
        raise CongraspError(f"{what}.", f"{hint}See 'congrasp {name} --help'.") from None


def usage() -> str:
    """Text of `congrasp --help`."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        "usage: congrasp COMMAND [options]\n\n"
        "Dexterous grasping under constraints: distributed training and a live policy.\n\n"
        f"{rows}\n\n"
        "Options of every command: --help, and --debug for the trace of an error.\n"
        "First steps: 'congrasp grasp examples/mug.obj', or a mesh of yours, 'congrasp view', "
        "'congrasp train'.\n"
    )


def _prepare_environment() -> None:
    """Removes settings of other programs from the environment, and configures caches of compiled
    programs and compiler output, unless the user has.
    """
    own_environment()
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


def _fail(text: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    if log_error(text):
        return code
    _last_words(sys.stderr, f"congrasp: error: {text}\n")
    return code


def _last_words(stream: TextIO, text: str = "") -> bool:
    """Writes and flushes if possible; a log on a full disk must not change the exit code."""
    try:
        stream.write(text)
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return False
    return True


if __name__ == "__main__":
    main()
