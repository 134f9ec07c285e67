"""One module knows the systems, and text files have one encoding on all of them."""

import ast
import pathlib
from collections.abc import Iterator

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDERS = ("common", "actors", "learner", "services", "congrasp", "examples")
PLATFORMS = ROOT / "common" / "runtime" / "platforms.py"
SYSTEM = {"os.name", "sys.platform", "platform.system", "os.fork", "os.getuid", "os.rename"}
SYSTEM |= {"os.killpg", "os.setsid", "signal.SIGKILL", "signal.SIGHUP"}
MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "pty", "select", "msvcrt", "winreg"}
OPTIONS = {"preexec_fn", "pass_fds", "start_new_session", "creationflags"}
TEXT_METHODS = {"read_text", "write_text"}
SOURCES: list[pathlib.Path] = []
for folder in FOLDERS:
    SOURCES += sorted((ROOT / folder).rglob("*.py"))
SOURCES = [path for path in SOURCES if path != PLATFORMS and not path.is_symlink()]


def nodes(path: pathlib.Path) -> Iterator[ast.AST]:
    return ast.walk(ast.parse(path.read_text(encoding="utf-8")))


def names_of_systems(path: pathlib.Path) -> Iterator[str]:
    """Modules, functions and options that some systems lack, and questions for the system."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            yield node.module
        elif isinstance(node, ast.Attribute) and ast.unparse(node) in SYSTEM:
            yield ast.unparse(node)
        elif isinstance(node, ast.Attribute) and node.attr == "rename":
            yield "rename, which does not replace a file on Windows"
        elif isinstance(node, ast.keyword) and node.arg in OPTIONS:
            yield node.arg


def calls_without_encoding(path: pathlib.Path) -> Iterator[str]:
    """Calls that read or write text in the encoding of the system."""
    for node in nodes(path):
        if not isinstance(node, ast.Call) or any(word.arg == "encoding" for word in node.keywords):
            continue
        call = ast.unparse(node)
        if isinstance(node.func, ast.Attribute) and node.func.attr in TEXT_METHODS:
            yield call
        if isinstance(node.func, ast.Name) and node.func.id == "open" and "b'" not in call:
            yield call


@pytest.mark.parametrize("search", [names_of_systems, calls_without_encoding])
def test_no_module_depends_on_the_system(search):
    calls = []
    for path in SOURCES:
        calls += [f"{path.relative_to(ROOT)}: {text}" for text in search(path)]
    assert not calls
