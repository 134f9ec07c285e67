#!/usr/bin/env python3
"""Reports packed statements that the other linters do not know.

* `a, b = x, y` for independent values: one statement a value. A swap or a rotation (a name is read
  on the right and bound on the left) needs the tuple and passes.
* A comprehension inside a comprehension, and a comprehension with more than one `for`.

    python3 .ci/plain_code.py
"""

import ast
import pathlib
import sys
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parent.parent
PACKAGES = ("common", "actors", "learner", "services")
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


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


def packed_statements(path: pathlib.Path) -> Iterator[tuple[int, str]]:
    """Yields line and description of each packed statement of a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if is_packed_assignment(node):
            yield node.lineno, "independent values in one assignment: write one statement a value"
        elif is_nested_comprehension(node):
            yield node.lineno, "nested comprehension: name the inner value or write a loop"


def main() -> int:
    """Prints the packed statements; returns 1 if there are any."""
    failed = False
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for line, description in packed_statements(path):
                failed = True
                print(f"{path.relative_to(ROOT)}:{line}: {description}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
