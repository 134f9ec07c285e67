#!/usr/bin/env python3
"""Reports statements that the other linters do not know.

In the packages and in the tests:

* `a, b = x, y` for independent values: one statement a value. A swap or a rotation (a name is read
  on the right and bound on the left) needs the tuple and passes.
* A comprehension inside a comprehension, and a comprehension with more than one `for`.

In the tests:

* A private name of the project: a test uses public functions, attributes and constants, and a part
  that deserves its own test is public. Private names of other libraries pass, and so do those that
  a class of the test defines, and the methods of named tuples.

    python3 .ci/plain_code.py
"""

import ast
import pathlib
import sys
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parent.parent
PACKAGES = ("common", "actors", "learner", "services")
TESTS = "tests"
PROJECT = {"congrasp", TESTS, *PACKAGES}
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
NAMED_TUPLE = {"_replace", "_asdict", "_fields", "_make", "_field_defaults"}
"""Public methods and attributes of a `typing.NamedTuple`."""
OF_JAX = {"_cache_size"}
"""Number of programs of a function that JAX compiled, which has no public name."""
BY_NAME = {"getattr", "setattr", "delattr", "hasattr", "patch", "object"}
"""Functions that take the name of an attribute; also methods of `pytest.MonkeyPatch` and `mock`."""

Finding = tuple[int, str]
"""Line and description."""


def names(node: ast.AST) -> set[str]:
    """Source texts of the names, attributes and elements in an expression."""
    kinds = (ast.Name, ast.Attribute, ast.Subscript)
    return {ast.unparse(child) for child in ast.walk(node) if isinstance(child, kinds)}


def is_packed_assignment(node: ast.AST) -> bool:
    """True for a tuple assigned to a tuple, none of whose values depends on a bound name."""
    if not isinstance(node, ast.Assign):
        return False
    target = node.targets[0]
    if not isinstance(target, ast.Tuple) or not isinstance(node.value, ast.Tuple):
        return False
    bound = {ast.unparse(element) for element in target.elts}
    return not bound & names(node.value)


def is_nested_comprehension(node: ast.AST) -> bool:
    """True for a comprehension with several `for`, or that contains another comprehension."""
    if not isinstance(node, COMPREHENSIONS):
        return False
    if len(node.generators) > 1:
        return True
    return any(isinstance(child, COMPREHENSIONS) for child in ast.walk(node) if child is not node)


def packed_assignments(tree: ast.Module) -> Iterator[Finding]:
    """Yields tuples of independent values."""
    for node in ast.walk(tree):
        if is_packed_assignment(node):
            yield node.lineno, "independent values in one assignment: write one statement a value"


def nested_comprehensions(tree: ast.Module) -> Iterator[Finding]:
    """Yields nested comprehensions."""
    for node in ast.walk(tree):
        if is_nested_comprehension(node):
            yield node.lineno, "nested comprehension: name the inner value or write a loop"


def is_private(name: str) -> bool:
    """True for a name with one leading underscore that is not public all the same."""
    if not name.startswith("_") or name.startswith("__"):
        return False
    return name not in NAMED_TUPLE | OF_JAX


class Imports:
    """Names that a file imports from the project, and from other packages."""

    def __init__(self, tree: ast.Module):
        """Reads the imports of a file, also those inside of functions."""
        self.project: set[str] = set()
        self.foreign: set[str] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    bound = alias.asname or alias.name.partition(".")[0]
                    self._add(alias.name, bound)
            elif isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    self._add(node.module or TESTS, alias.asname or alias.name)

    def _add(self, module: str, name: str) -> None:
        names = self.project if module.partition(".")[0] in PROJECT else self.foreign
        names.add(name)


def defined_in_classes(tree: ast.Module) -> set[str]:
    """Names of the methods and attributes that the classes of a file define."""
    defined = set()
    for class_ in ast.walk(tree):
        if not isinstance(class_, ast.ClassDef):
            continue
        for node in ast.walk(class_):
            if isinstance(node, ast.FunctionDef):
                defined.add(node.name)
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                if root(node) == "self":
                    defined.add(node.attr)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                defined.add(node.id)
    return defined


def root(node: ast.AST) -> str:
    """Name at which an expression of attributes, elements and calls begins; "" if it is none."""
    while not isinstance(node, ast.Name):
        if isinstance(node, ast.Attribute | ast.Subscript):
            node = node.value
        elif isinstance(node, ast.Call):
            node = node.func
        else:
            return ""
    return node.id


def names_in_call(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yields names of attributes that a call gets as text, with the call's first argument."""
    if not isinstance(node, ast.Call) or not node.args:
        return
    function = node.func.attr if isinstance(node.func, ast.Attribute) else root(node.func)
    if function not in BY_NAME:
        return
    for argument in node.args[:2]:
        if isinstance(argument, ast.JoinedStr) and argument.values:
            argument = argument.values[0]  # its text before the first replacement
        if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
            yield argument.value.rpartition(".")[2], node.args[0]


def private_uses(tree: ast.Module) -> Iterator[Finding]:
    """Yields uses of private names of the project."""
    imports = Imports(tree)
    defined = defined_in_classes(tree)
    remedy = "test the public behaviour, or make this part public"
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or TESTS).partition(".")[0] in PROJECT:
            for alias in node.names:
                if is_private(alias.name):
                    yield node.lineno, f"private name {alias.name}: {remedy}"
        elif isinstance(node, ast.Attribute) and is_private(node.attr):
            start = root(node.value)
            is_of_test = node.attr in defined and start not in imports.project
            if start not in imports.foreign and not is_of_test:
                yield node.lineno, f"private name {ast.unparse(node)}: {remedy}"
        for name, owner in names_in_call(node):
            if is_private(name) and root(owner) not in imports.foreign:
                yield node.lineno, f"private name {name}: {remedy}"


CHECKS = {
    **dict.fromkeys(PACKAGES, (packed_assignments, nested_comprehensions)),
    TESTS: (packed_assignments, nested_comprehensions, private_uses),
}
"""Checks of the files in each folder."""


def main() -> int:
    """Prints the findings; returns 1 if there are any."""
    failed = False
    for folder, checks in CHECKS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(path.read_text())
            findings: list[Finding] = []
            for check in checks:
                findings += check(tree)
            for line, description in sorted(findings):
                failed = True
                print(f"{path.relative_to(ROOT)}:{line}: {description}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
