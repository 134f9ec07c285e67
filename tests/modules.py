"""Copies of modules, for tests of what a module remembers."""

import importlib.util
import types


def fresh_copy(module: types.ModuleType) -> types.ModuleType:
    """Returns a copy of a module as a new process would have it, with nothing remembered."""
    spec = importlib.util.find_spec(module.__name__)
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy
