"""Variables of the environment that change how a process computes; commands and the library's
child processes do without them.
"""

import os
import pathlib
import sysconfig

import congrasp

_FOREIGN = (
    "JAX_ENABLE_X64",
    "JAX_DEFAULT_DTYPE_BITS",
    "JAX_EXPLICIT_X64_DTYPES",
    "JAX_NUMPY_DTYPE_PROMOTION",
    "JAX_NUMPY_RANK_PROMOTION",
    "JAX_DEFAULT_MATMUL_PRECISION",
    "JAX_DEFAULT_PRNG_IMPL",
    "JAX_DEFAULT_DEVICE",
    "JAX_ENABLE_CUSTOM_PRNG",
    "JAX_LEGACY_PRNG_KEY",
    "JAX_THREEFRY_PARTITIONABLE",
    "JAX_RANDOM_SEED_OFFSET",
    "JAX_SOFTMAX_CUSTOM_JVP",
    "JAX_DISABLE_JIT",
    "JAX_DEBUG_NANS",
    "JAX_DEBUG_INFS",
    "JAX_DEBUG_KEY_REUSE",
    "JAX_CHECK_TRACER_LEAKS",
    "JAX_NO_TRACING",
    "JAX_TRANSFER_GUARD",
    "JAX_TRANSFER_GUARD_HOST_TO_DEVICE",
    "JAX_TRANSFER_GUARD_DEVICE_TO_DEVICE",
    "JAX_TRANSFER_GUARD_DEVICE_TO_HOST",
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


def own_environment() -> None:
    """Makes the environment of this process that of a command; call it before other imports."""
    for name in _FOREIGN:
        os.environ.pop(name, None)
    os.environ.update(_SET)
    os.environ["PYTHONPATH"] = _python_path()


def child_environment(**changes: str) -> dict[str, str]:
    """Environment of a child process: that of this one, without foreign settings.

    Args:
      **changes: further variables.
    """
    rest = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    return {**rest, **_SET, "PYTHONPATH": _python_path(), **changes}


def _python_path() -> str:
    """`PYTHONPATH` with the folder of this package, which a child would otherwise find in the
    current folder alone.

    An installed package is found without it; its folder must not come before Python's own modules.
    """
    paths = os.environ.get("PYTHONPATH", "")
    installed = {pathlib.Path(sysconfig.get_path(name)) for name in ("purelib", "platlib")}
    if _ROOT in installed or str(_ROOT) in paths.split(os.pathsep):
        return paths
    return os.pathsep.join(filter(None, [paths, str(_ROOT)]))
