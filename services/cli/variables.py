"""Variables of the environment at which a library fails, named in one line with their values."""

import os
import re
import subprocess
import sys
from collections.abc import Mapping

from congrasp.common.errors import CongraspError

_VARIABLE_NAME = re.compile(r"\b[A-Z]+_[A-Z\d_]+")
_JAX_PREFIX = "JAX_"
"""Prefix of the variables that JAX reads; its errors quote the value, but not always the name."""
_PLATFORMS = "JAX_PLATFORMS"
_XLA_FLAGS = "XLA_FLAGS"
_CHECKED_FLAGS = "CONGRASP_CHECKED_XLA_FLAGS"
"""Variable with the flags that a process has checked for its children."""
_XLA_CHECK = "from jaxlib import xla_client; xla_client.make_cpu_client()"
_XLA_CHECK_TIMEOUT_S = 30.0
"""Deadline of the check of XLA's flags, which takes a third of a second on an idle machine."""


def check_xla_flags() -> None:
    """Raises a CongraspError for flags of XLA at which it would end the process.

    XLA reads them at its first use, and exits without an exception. A separate process tries them.
    """
    flags = os.environ.get(_XLA_FLAGS)
    if not flags or os.environ.get(_CHECKED_FLAGS) == flags:
        return
    try:
        process = subprocess.run(
            [sys.executable, "-P", "-c", _XLA_CHECK],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=_XLA_CHECK_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):  # the machine is busy, not the flags wrong
        return
    lines = process.stderr.decode(errors="replace").splitlines()
    reasons = [line for line in lines if _XLA_FLAGS in line]
    if process.returncode and reasons:
        _, _, reason = reasons[-1].partition("] ")  # after XLA's level, time and place
        raise _unusable(_XLA_FLAGS, reason)
    os.environ[_CHECKED_FLAGS] = flags


def variable_error(error: Exception) -> CongraspError | None:
    """Returns an error that names the variable at which a library failed; None if a variable is not
    the cause.

    Args:
      error: the library's error; its text names the variable or, in JAX, quotes the value.
    """
    text = str(error).strip()
    names = [name for name in _VARIABLE_NAME.findall(text.upper()) if name in os.environ]
    names += _quoted_variables(text, os.environ)
    if not text and isinstance(error, AssertionError) and _without_platform(error):
        names.append(_PLATFORMS)
    if not names:
        return None
    first_line = text.splitlines()[0] if text else ""
    return _unusable(names[0], first_line)


def _quoted_variables(text: str, variables: Mapping[str, str]) -> list[str]:
    """Names of JAX's variables whose value a text quotes."""
    names = []
    for name, value in variables.items():
        if name.startswith(_JAX_PREFIX) and value and f"'{value}'" in text:
            names.append(name)
    return names


def _without_platform(error: AssertionError) -> bool:
    """True for the failed assertion of JAX without any of the requested platforms."""
    is_of_jax = "JAX" in str(getattr(error, "__notes__", ""))
    platforms = os.environ.get(_PLATFORMS, "cpu")
    return is_of_jax and "cpu" not in platforms


def _unusable(name: str, reason: str) -> CongraspError:
    """Returns the error about a variable, with the library's reason if it gives one."""
    in_brackets = f" ({reason})" if reason else ""
    return CongraspError(
        f"{name} is '{os.environ[name]}', which does not work here{in_brackets}.",
        "Correct or unset it.",
    )
