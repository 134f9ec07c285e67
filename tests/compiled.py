"""Programs that JAX compiles: functions of a module as one program each (alone, every operation in
them would be compiled for itself), and their number.
"""

import functools
import types
from typing import Any

import jax


class Compiled:
    """The functions of a module, compiled when they are first called.

    Args:
      module: the module.
      given: first arguments of every function, which are constants of its program.
    """

    def __init__(self, module: types.ModuleType, *given: Any):
        self._module = module
        self._given = given

    def __getattr__(self, name: str) -> Any:
        program = jax.jit(functools.partial(getattr(self._module, name), *self._given))
        setattr(self, name, program)
        return program


def program_count(function: Any) -> int:
    """Number of programs that JAX has compiled for a jitted function; it has no public count."""
    return function._cache_size()
