"""Decorators of the public functions that compute: they run under the library's own settings."""

import functools
import importlib
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from congrasp.common.runtime.forks import note_started, require_not_inherited
from congrasp.common.runtime.settings import library_settings
from congrasp.common.runtime.tolerance import tolerated_warnings

P = ParamSpec("P")
R = TypeVar("R")


def entry(function: Callable[P, R]) -> Callable[P, R]:
    """Runs a function that computes with JAX under `library_settings`, except in a fork of a
    process that had started JAX, where it raises a ForkError.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        require_not_inherited("JAX")
        importlib.import_module("jax")  # settings of a module that is not imported cannot change
        note_started("JAX")
        with library_settings():
            return function(*args, **kwargs)

    return call


def compiling_entry(function: Callable[P, R]) -> Callable[P, R]:
    """`entry` for a function that imports or compiles, in which no warning is an error."""
    inside = entry(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with tolerated_warnings():
            return inside(*args, **kwargs)

    return call
