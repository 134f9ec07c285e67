"""JAX, imported at the first use of one of its names. Modules that the command line imports for
names, options and defaults take `jax` and `jnp` from here.

The import takes most of a second. `congrasp COMMAND --help` needs constraints, reward terms,
sensors and the configuration of a run, but computes nothing with them.
"""

import threading
from typing import TYPE_CHECKING

from congrasp.common.runtime.lazy_module import LazyModule

if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
else:
    jax = LazyModule("jax")
    jnp = LazyModule("jax.numpy")

__all__ = ["jax", "jnp", "register_pytree"]

_lock = threading.Lock()
_pytrees: set[type] = set()


def register_pytree(kind: type) -> None:
    """Registers a dataclass as a pytree of JAX, unless it is registered already."""
    with _lock:
        if kind not in _pytrees:
            jax.tree_util.register_dataclass(kind)
            _pytrees.add(kind)
