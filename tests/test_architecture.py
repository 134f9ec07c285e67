"""The source: layers, sizes of modules, the one module that unpickles, and plain engineering
English in its texts.
"""

import ast
import functools
import itertools
import pathlib
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FOLDERS = ("common", "actors", "learner", "services")
KNOWN = {
    "common": set(),
    "actors": {"common"},
    "learner": {"common"},
    "services": {"common", "actors", "learner"},
}


def imported(body: Sequence[ast.stmt]) -> Iterator[str]:
    """Names of modules and of what is taken from them, as far as importing a module imports
    them.
    """
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test):
            yield from itertools.chain(imported(node.body), imported(node.orelse))
        elif isinstance(node, ast.Try):
            yield from imported(node.body)


@functools.cache
def trees(*folders: str) -> dict[pathlib.Path, ast.Module]:
    """Syntax trees of all modules in some folders."""
    paths = itertools.chain.from_iterable((ROOT / folder).rglob("*.py") for folder in folders)
    return {path: ast.parse(path.read_text()) for path in paths}


@functools.cache
def graph(everything: bool) -> dict[str, set[str]]:
    """Modules by those that they import: at once, or `everything` that is anywhere in them."""
    paths = {
        path: ".".join(("congrasp", *path.relative_to(ROOT).with_suffix("").parts))
        for path in trees(*FOLDERS)
    }
    names = {name.removesuffix(".__init__") for name in paths.values()}
    edges = {}
    for path, name in paths.items():
        tree = trees(*FOLDERS)[path]
        body = (
            [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
            if everything
            else tree.body
        )
        targets = (t if t in names else t.rpartition(".")[0] for t in imported(body))
        edges[name.removesuffix(".__init__")] = {target for target in targets if target in names}
    return edges


def test_every_import_of_ours_exists():
    """Those in functions, too, which nothing finds before they run; mypy takes what it does not
    find for granted.
    """
    names = graph(everything=False).keys() | {"congrasp"}
    for path, tree in {**trees(*FOLDERS), **trees("tests", "examples")}.items():
        body = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
        ours = [target for target in imported(body) if target.partition(".")[0] == "congrasp"]
        assert not [t for t in ours if t not in names and t.rpartition(".")[0] not in names], path


def test_no_folder_imports_backwards():
    for module, targets in graph(everything=True).items():
        folder = module.split(".")[1]
        assert {target.split(".")[1] for target in targets} <= KNOWN[folder] | {folder}, module


def test_one_module_imports_mujoco():
    """The others take it from there, without its log file."""
    modules = set()
    for path, tree in trees(*FOLDERS).items():
        body = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
        if "mujoco" in imported(body):
            modules.add(str(path.relative_to(ROOT)))
    assert modules == {"common/runtime/physics_library.py"}


def test_no_two_services_import_each_other():
    services = "congrasp.services."
    edges = set()
    for module, targets in graph(everything=False).items():
        if not module.startswith(services):
            continue
        used = [target for target in targets if target.startswith(services)]
        edges |= {(module.split(".")[2], target.split(".")[2]) for target in used}
    assert not [(a, b) for a, b in edges if a < b and (b, a) in edges]


def test_no_module_needs_itself():
    """Not even for types, or in functions.

    Kahn's algorithm takes away modules of which nothing is left that they import: a cycle would
    remain.
    """
    left = graph(everything=True)
    while free := [module for module, targets in left.items() if not targets & left.keys()]:
        left = {module: targets for module, targets in left.items() if module not in free}
    assert not left


def test_constraints_are_used_by_their_hooks():
    """No module outside their folder imports one of them, but for the heading, which every episode
    has.
    """
    folder = "congrasp.common.task.constraints"
    shared = {
        folder,
        *(f"{folder}.{name}" for name in ("base", "heading", "markers", "priority", "specs")),
    }
    used = set()
    for module, targets in graph(everything=True).items():
        if not module.startswith(folder):
            used |= targets
    assert {target for target in used if target.startswith(folder)} <= shared


RUNS_DATA = re.compile(
    r"^\s*(from|import)\s+(pickle|cPickle|dill|cloudpickle|joblib|marshal|shelve|torch)\b|allow_pickle=True|\beval\(",
    re.MULTILINE,
)


def test_one_module_alone_unpickles():
    """The child process with an allow-list."""
    modules = [
        str(path.relative_to(ROOT))
        for path in trees(*FOLDERS)
        if RUNS_DATA.search(path.read_text())
    ]
    assert modules == ["common/io/unpickle.py"]


OPENINGS = re.compile(r"(What|Whether|How|Who|Whoever|That|Where|When|Which|If|So)\b")
BANNED = re.compile(
    r"\b(anew|nobody|somebody|mend|mends|mended|goes on|go on|put off|puts off|out of all reason|without a word|"
    r"turned away|let in|what becomes of|told about|whoever|is told|as it likes|broken surrounding)\b",
    re.IGNORECASE,
)


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of every string of several words: docstrings, messages and help."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, " ".join(node.value.split())


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of the docstrings of a module, its classes and functions, and of the strings
    under fields.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in node.body:
                if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                    yield statement.lineno, str(statement.value.value).strip()


def test_the_rules_report_banned_words():
    tree = ast.parse(
        '"""Whether it is mended."""\nx = 1\n"""What x is."""\nraise ValueError("nobody came")\n'
    )
    assert [line for line, text in docstrings(tree) if OPENINGS.match(text)] == [1, 3]
    assert [line for line, text in texts(tree) if BANNED.search(text)] == [1, 4]


@pytest.mark.parametrize(("read", "wrong"), [(docstrings, OPENINGS.match), (texts, BANNED.search)])
def test_docstrings_open_plainly_and_no_banned_word_is_used(read, wrong):
    modules = trees(*FOLDERS).items()
    faults = []
    for path, tree in modules:
        for line, text in read(tree):
            if wrong(text):
                faults.append(f"{path}:{line}: {text[:100]}")
    assert not faults, "\n".join(faults)


def test_benchmarks_need_no_pytest():
    script = (
        "import sys; sys.modules['pytest'] = None; import importlib, tests.benchmarks.__main__ as "
        "benchmarks; "
    )
    script += "[importlib.import_module(f'tests.benchmarks.{name}') for name in benchmarks.NAMES]"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_modules_of_make_check_exist():
    """xdist runs nothing, and says no reason, if one is missing."""
    listed = re.search(r"^FAST :=((?:.*\\\n)*.*)", (ROOT / "Makefile").read_text(), re.M)
    names = set(re.findall(r"\btest_\w+", listed[1]))
    assert len(names) > 10
    assert names <= {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
