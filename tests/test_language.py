"""Docstrings, messages and help read like plain engineering English."""

import ast
import functools
import pathlib
import re
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parents[1]
FOLDERS = ("common", "actors", "learner", "services")
OPENINGS = re.compile(r"(What|Whether|How|Who|Whoever|That|Where|When|Which|If|So)\b")
BANNED = re.compile(
    r"\b(anew|nobody|somebody|mend|mends|mended|goes on|go on|put off|puts off|out of all reason|without a word|"
    r"turned away|let in|what becomes of|told about|whoever|is told|as it likes|broken surrounding)\b",
    re.IGNORECASE,
)


@functools.cache
def modules() -> dict[str, ast.Module]:
    """Syntax trees of all modules by their paths."""
    paths = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in paths}


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of every string of several words: docstrings, messages and help."""
    for found in ast.walk(tree):
        if isinstance(found, ast.Constant) and isinstance(found.value, str) and " " in found.value:
            yield found.lineno, " ".join(found.value.split())


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of the docstrings of a module, its classes and functions, and of the strings under fields."""
    for found in ast.walk(tree):
        if isinstance(found, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in found.body:
                if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                    yield statement.lineno, str(statement.value.value).strip()


def test_the_rules_find_what_they_ban():
    tree = ast.parse('"""Whether it is mended."""\nx = 1\n"""What x is."""\nraise ValueError("nobody came")\n')
    assert [line for line, text in docstrings(tree) if OPENINGS.match(text)] == [1, 3]
    assert [line for line, text in texts(tree) if BANNED.search(text)] == [1, 4]


def test_no_docstring_opens_with_a_question_word():
    found = [
        f"{path}:{line}: {text.splitlines()[0]}"
        for path, tree in modules().items()
        for line, text in docstrings(tree)
        if OPENINGS.match(text)
    ]
    assert not found, "\n".join(found)


def test_no_banned_word_is_used():
    found = [
        f"{path}:{line}: {text[:100]}"
        for path, tree in modules().items()
        for line, text in texts(tree)
        if BANNED.search(text)
    ]
    assert not found, "\n".join(found)
