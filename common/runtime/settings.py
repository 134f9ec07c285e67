"""Settings of JAX and NumPy under which the library computes, whatever those of the caller.

A caller's script may switch JAX to 64 bits, forbid promotions, or let NumPy raise errors. All of
these are global, and would change or break computations that were tested under the defaults.
"""

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

_JAX: dict[str, Any] = {
    "enable_x64": False,
    "numpy_dtype_promotion": "standard",
    "numpy_rank_promotion": "allow",
    "default_matmul_precision": None,
    "default_prng_impl": "threefry2x32",
    "threefry_partitionable": True,
    "legacy_prng_key": "allow",
    "enable_custom_prng": False,
    "softmax_custom_jvp": False,
    "disable_jit": False,
    "debug_nans": False,
    "debug_infs": False,
    "debug_key_reuse": False,
    "check_tracer_leaks": False,
    "no_tracing": False,
    "transfer_guard": "allow",
}
"""JAX's defaults, by the names of the context managers in `jax`."""


@contextlib.contextmanager
def library_settings() -> Iterator[None]:
    """Context of the library's own settings, of this thread alone; the caller's return at its end.

    Programs compiled inside are found again by every later call inside. Threads that are started
    inside begin with the caller's settings. Where JAX is not loaded, as by a client, there is
    nothing of it to set.
    """
    with contextlib.ExitStack() as settings:
        settings.enter_context(np.errstate(all="ignore"))
        for context in _jax_contexts():
            settings.enter_context(context())
        yield


def _jax_contexts() -> Iterator[Callable[[], contextlib.AbstractContextManager[Any]]]:
    """Yields functions that return the contexts of JAX's settings; none where it is not loaded."""
    jax = sys.modules.get("jax")
    if not hasattr(jax, "transfer_guard"):  # absent, or being imported by another thread
        return
    for name, value in _JAX.items():
        manager = getattr(jax, name, None)
        if manager is not None:  # later versions may have dropped it
            yield functools.partial(manager, value)
