"""Variables of the environment at which a library fails, named in one line with their values."""

import os
import re
import subprocess
import sys
from collections.abc import Mapping

from congrasp.common.errors import CongraspError

_NAME = re.compile(r"\b[A-Z]+_[A-Z\d_]+")
_JAX = "JAX_"
"""Begin of the variables that JAX reads; its errors quote a value, and not always its name."""
_PLATFORMS = "JAX_PLATFORMS"
_XLA_FLAGS = "XLA_FLAGS"
_CHECKED = "CONGRASP_CHECKED_XLA_FLAGS"
"""Variable with the flags that a process has checked for its children."""
_XLA_CHECK = "from jaxlib import xla_client; xla_client.make_cpu_client()"
_XLA_PATIENCE = 30.0
"""Longest time for the check of XLA's flags, s; it takes a third of one on an idle machine."""


def check_xla_flags() -> None:
    """Raises a CongraspError for flags of XLA at which it would end the process.

    XLA reads them at its first use, and exits without an exception. A separate process tries them.
    """
    flags = os.environ.get(_XLA_FLAGS)
    if not flags or os.environ.get(_CHECKED) == flags:
        return
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _XLA_CHECK],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=_XLA_PATIENCE,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):  # the machine is busy, not the flags wrong
        return
    lines = done.stderr.decode(errors="replace").splitlines()
    named = [line for line in lines if _XLA_FLAGS in line]
    if done.returncode and named:
        raise CongraspError(*_unusable(_XLA_FLAGS, named[-1].partition("] ")[2]))
    os.environ[_CHECKED] = flags


def variable_error(error: Exception) -> CongraspError | None:
    """Returns an error that names the variable at which a library failed; None if it was none.

    Args:
      error: of the library; its text names the variable or, in JAX, quotes the value.
    """
    text = str(error).strip()
    named = [name for name in _NAME.findall(text.upper()) if name in os.environ]
    named += _quoted(text, os.environ)
    if not text and isinstance(error, AssertionError) and _without_platform(error):
        named.append(_PLATFORMS)
    if not named:
        return None
    first_line = text.splitlines()[0] if text else ""
    return CongraspError(*_unusable(named[0], first_line))


def _quoted(text: str, variables: Mapping[str, str]) -> list[str]:
    """Variables of JAX whose value a text quotes."""
    return [
        name
        for name, value in variables.items()
        if name.startswith(_JAX) and value and f"'{value}'" in text
    ]


def _without_platform(error: AssertionError) -> bool:
    """True for the failed assertion of JAX without any of the requested platforms."""
    is_of_jax = "JAX" in str(getattr(error, "__notes__", ""))
    platforms = os.environ.get(_PLATFORMS, "cpu")
    return is_of_jax and "cpu" not in platforms


def _unusable(name: str, said: str) -> tuple[str, str]:
    """Error about a variable, and its remedy."""
    reason = f" ({said})" if said else ""
    what = f"{name} is '{os.environ[name]}', which does not work here{reason}."
    return what, "Correct or unset it."
