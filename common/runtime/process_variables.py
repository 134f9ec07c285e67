"""Environment variables of processes: commands and child processes run without variables that
change results or stop the program, and with the variables that they need.
"""

import os
import pathlib
import site
import sysconfig

import congrasp

_FOREIGN = (
    # Types and precision of numbers, which change results
    "JAX_ENABLE_X64",
    "JAX_DEFAULT_DTYPE_BITS",
    "JAX_EXPLICIT_X64_DTYPES",
    "JAX_NUMPY_DTYPE_PROMOTION",
    "JAX_NUMPY_RANK_PROMOTION",
    "JAX_DEFAULT_MATMUL_PRECISION",
    "JAX_SOFTMAX_CUSTOM_JVP",
    # Random numbers, which change results
    "JAX_DEFAULT_PRNG_IMPL",
    "JAX_ENABLE_CUSTOM_PRNG",
    "JAX_LEGACY_PRNG_KEY",
    "JAX_THREEFRY_PARTITIONABLE",
    "JAX_RANDOM_SEED_OFFSET",
    # Debugging, which makes programs slow, and raises errors for values that are masked later
    "JAX_DISABLE_JIT",
    "JAX_DEBUG_NANS",
    "JAX_DEBUG_INFS",
    "JAX_DEBUG_KEY_REUSE",
    "JAX_CHECK_TRACER_LEAKS",
    "JAX_NO_TRACING",
    # Choice of the device, and errors for transfers to it
    "JAX_DEFAULT_DEVICE",
    "JAX_TRANSFER_GUARD",
    "JAX_TRANSFER_GUARD_HOST_TO_DEVICE",
    "JAX_TRANSFER_GUARD_DEVICE_TO_DEVICE",
    "JAX_TRANSFER_GUARD_DEVICE_TO_HOST",
    # The interpreter: a prompt at the end of a command, no docstrings for its help, and errors in
    # place of warnings
    "PYTHONINSPECT",
    "PYTHONOPTIMIZE",
    "PYTHONWARNINGS",
)
"""Variables that are removed."""
_SET = {
    # MuJoCo would start processes for a renderer, which nothing here uses
    "MUJOCO_GL": "disable",
    # A backend inherited from Jupyter is missing elsewhere
    "MPLBACKEND": "Agg",
    # Modules of the current folder must not replace those of Python
    "PYTHONSAFEPATH": "1",
}
_ROOT = pathlib.Path(congrasp.__file__).resolve().parents[1]
"""Folder that contains the package: a checkout, or `site-packages`."""


def clean_environment() -> None:
    """Removes and sets variables of this process as a command needs them. It must run before
    other imports, since libraries read their variables when they are imported.
    """
    for name in _FOREIGN:
        os.environ.pop(name, None)
    os.environ.update(_SET)
    # For processes that are started without `child_environment`, such as those of multiprocessing
    os.environ["PYTHONPATH"] = _python_path()


def child_environment(**changes: str) -> dict[str, str]:
    """Returns the variables of a child process: those of this process, cleaned.

    Args:
      **changes: further variables.
    """
    rest = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    return {**rest, **_SET, "PYTHONPATH": _python_path(), **changes}


def _python_path() -> str:
    """Returns `PYTHONPATH`, with the folder of this package if congrasp runs from a checkout.

    A child process would otherwise find the package in the current folder alone. The folder of an
    installed package is never added: every child finds it without `PYTHONPATH`, whose entries come
    before the standard library, so that other packages there could replace standard modules.
    """
    python_path = os.environ.get("PYTHONPATH", "")
    if _is_installed() or str(_ROOT) in python_path.split(os.pathsep):
        return python_path
    return os.pathsep.join(filter(None, [python_path, str(_ROOT)]))


def _is_installed() -> bool:
    """Returns True if the package is in a folder where Python installs packages."""
    folders = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    folders.append(site.getusersitepackages())
    # Links are resolved, as in _ROOT: a virtual environment may be behind one
    return any(pathlib.Path(folder).resolve() == _ROOT for folder in folders)
