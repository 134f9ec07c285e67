"""JAX, imported at the first use of one of its names. Modules that the command line imports for
names, options and defaults take `jax` and `jnp` from here.

The import takes most of a second. `congrasp COMMAND --help` needs constraints, reward terms,
sensors and the configuration of a run, but computes nothing with them.
"""

import importlib
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
else:

    class _Module:
        """A module that is imported when one of its names is first used."""

        def __init__(self, name: str):
            self._name = name

        def __getattr__(self, name: str) -> Any:
            return getattr(importlib.import_module(self._name), name)

    jax = _Module("jax")
    jnp = _Module("jax.numpy")

__all__ = ["jax", "jnp", "register_pytree"]

_lock = threading.Lock()
_pytrees: set[type] = set()


def register_pytree(kind: type) -> None:
    """Registers a dataclass as a pytree of JAX, unless it is registered already."""
    with _lock:
        if kind not in _pytrees:
            jax.tree_util.register_dataclass(kind)
            _pytrees.add(kind)
