"""Statements that the linter of the project refuses."""

import ast
import importlib.util

import pytest

from tests.conftest import ROOT


@pytest.fixture(scope="module")
def linter():
    spec = importlib.util.spec_from_file_location("plain_code", ROOT / ".ci" / "plain_code.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lines(check, code):
    """Lines of the findings of a check in a source text."""
    return [line for line, _ in check(ast.parse(code))]


@pytest.mark.parametrize("code", ["a, b = 1, 2", "self.a, b = x, f(y)", "a, b, c = x, y, z"])
def test_independent_values_in_one_assignment_are_refused(linter, code):
    assert lines(linter.packed_assignments, code) == [1]


@pytest.mark.parametrize("code", ["a, b = b, a", "a, b = b, a + b", "a, b = f()", "(a,) = x"])
def test_swaps_and_unpacked_results_pass(linter, code):
    assert lines(linter.packed_assignments, code) == []


@pytest.mark.parametrize(
    "code",
    ["[x for y in z for x in y]", "[[x for x in y] for y in z]", "{f(x for x in y) for y in z}"],
)
def test_nested_comprehensions_are_refused(linter, code):
    assert lines(linter.nested_comprehensions, code) == [1]


def test_a_plain_comprehension_passes(linter):
    assert lines(linter.nested_comprehensions, "[x for x in y if x]") == []


@pytest.mark.parametrize(
    "use",
    [
        "from congrasp.learner.process import _Learner",
        "from tests.task import _start",
        "module._LIMIT",
        "module.Engine()._state.rows",
        "made_elsewhere._rows[0]",
        "monkeypatch.setattr(module, '_LIMIT', 3)",
        "monkeypatch.setattr('congrasp.learner.process._LIMIT', 3)",
        "getattr(made_elsewhere, '_rows')",
        "mock.patch.object(module.Engine, '_step')",
        "getattr(made_elsewhere, f'_{name}')",
    ],
)
def test_private_names_of_the_project_are_refused(linter, use):
    assert lines(linter.private_uses, f"from congrasp.learner import module\n{use}") == [2]


@pytest.mark.parametrize(
    "use",
    [
        "module.LIMIT",
        "state._replace(time=0)",
        "state._asdict()",
        "state._fields",
        "os._exit(3)",
        "wp._src.context.Module.load",
        "monkeypatch.setattr(wp, '_registry', None)",
        "function._cache_size()",
        "module.__path__",
        "_helper()",
    ],
)
def test_public_and_foreign_names_pass(linter, use):
    imports = "import os, warp as wp; from congrasp.learner import module"
    assert lines(linter.private_uses, f"{imports}\n{use}") == []


def test_private_attributes_of_a_class_of_the_test_pass(linter):
    code = """
from congrasp.learner.process import Learner

class Fake(Learner):
    _most = 3

    def __init__(self):
        self._count = 0

    def _step(self):
        return super()._step() + self._count + self._most + self._hidden

fake._count
"""
    assert lines(linter.private_uses, code) == [11]
