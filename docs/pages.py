"""Reference pages generated from the code."""

import contextlib
import dataclasses
import inspect
import io
import json
import os
import pathlib
import re
import textwrap
import typing
from collections.abc import Iterator, Sequence

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx
from typing_extensions import Doc

from congrasp.common import errors
from congrasp.common.config import RunConfig
from congrasp.common.episode.arm import ARM_ARRAYS
from congrasp.common.episode.motion_file import MOTION_ARRAYS
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.policy.pretrained import pretrained_hands
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.methods import METHODS
from congrasp.common.wire import messages
from congrasp.common.wire.messages import MessageSpec
from congrasp.services.cli import main
from congrasp.services.train.students import CAMERAS, TRACKERS
from congrasp.services.viz.metric_titles import TITLES

_CASES = pathlib.Path(__file__).parents[1] / "tests" / "cases"
_WIDTH = 100
_DEFAULT = 60
"""Most characters of a default value."""


class Commands(Directive):
    """The help of every command and its subcommands."""

    def run(self) -> list[nodes.Node]:
        """Returns a section for each command."""
        return [
            _section(f"congrasp {' '.join(words)}", [_literal(_help(words))])
            for name in main.COMMANDS
            for words in _words(name)
        ]


class Configuration(Directive):
    """Every field of a run's configuration: option, default and meaning."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        rows = [
            (f"--{name}", _short(value), text) for name, value, text in _fields(RunConfig(), "")
        ]
        return [_table(("option", "default", "meaning"), rows)]


class Hands(Directive):
    """The hands of the package with a policy, and the order of their joints."""

    def run(self) -> list[nodes.Node]:
        """Returns a table of the hands and one of their joints."""
        hands = [get_hand(name) for name in pretrained_hands()]
        facts = [
            (
                hand.name,
                f"{len(hand.joints)}, of {len(hand.fingers)} fingers",
                str(len(hand.links)),
                f"{sum(link.mass for link in hand.links):.3f} kg",
                f"{min(_torques(hand)):.2g} to {max(_torques(hand)):.2g}",
                f"x {hand.object_scale:g}",
            )
            for hand in hands
        ]
        joints = [(hand.name, ", ".join(joint.name for joint in hand.joints)) for hand in hands]
        return [
            _table(("hand", "joints", "links", "mass", "torques, N m", "objects"), facts),
            _table(("hand", "joints in their order"), joints),
        ]


class Messages(Directive):
    """Entries of every kind of message on the wire."""

    def run(self) -> list[nodes.Node]:
        """Returns a section for each kind."""
        specs = [value for value in vars(messages).values() if isinstance(value, MessageSpec)]
        return [
            _section(spec.kind, [_table(("entry", "type", "shape"), list(_entries(spec)))])
            for spec in specs
        ]


class Constraints(Directive):
    """Goal arrays and errors of every constraint."""

    def run(self) -> list[nodes.Node]:
        """Returns a table of the goal arrays and one of the errors."""
        arrays = [
            (f"{constraint.name}_{name}", str(array.shape).replace("'", ""), array.meaning)
            for constraint in CONSTRAINTS
            for name, array in constraint.arrays.items()
        ]
        measured = [
            (spec.column or spec.name, spec.unit or "share", spec.window, spec.meaning)
            for constraint in CONSTRAINTS
            for spec in constraint.errors
        ]
        return [
            _table(("goal array", "shape", "meaning"), arrays),
            _table(("error", "unit", "window", "meaning"), measured),
        ]


class Errors(Directive):
    """Public errors: class, base, condition, exit code of the command line, code on the wire."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        rows = [
            (
                kind.__name__,
                kind.__bases__[0].__name__,
                _first_line(kind),
                str(kind.exit_code),
                kind.code,
            )
            for kind in vars(errors).values()
            if isinstance(kind, type) and issubclass(kind, CongraspError)
        ]
        return [_table(("class", "base", "condition", "exit code", "code"), rows)]


class Methods(Directive):
    """The method, baselines and ablations."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        return [
            _table(
                ("name", "description"),
                [(name, method.meaning) for name, method in METHODS.items()],
            )
        ]


class Metrics(Directive):
    """Metrics of learner and actors."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        return [
            _table(
                ("metric", "unit", "meaning"),
                [(name, *_meant(*entry)) for name, entry in TITLES.items()],
            )
        ]


class MotionArrays(Directive):
    """Arrays of a motion file."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        arrays = [*MOTION_ARRAYS.items(), *ARM_ARRAYS.items()]
        return [_table(("array", "shape, unit, frame"), arrays)]


class Sensing(Directive):
    """Sensors that are drawn in the training of students: ranges of a tracker and of a camera."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        rows = [
            (
                f"--task.sensing.{name}",
                _short(value),
                _short(getattr(CAMERAS, name.replace("-", "_"))),
                meaning,
            )
            for name, value, meaning in _fields(TRACKERS, "")
        ]
        return [_table(("option", "tracker", "camera", "meaning"), rows)]


class Cases(Directive):
    """Files that do not load, from the descriptions that the tests run."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        cases = [json.loads(file.read_text()) for file in sorted(_CASES.glob("*/case.json"))]
        rows = [(case["command"], case["sign"], case["remedy"]) for case in cases if "sign" in case]
        return [_table(("for example", "sign", "remedy"), rows)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directives with Sphinx."""
    for directive in (
        Cases,
        Commands,
        Configuration,
        Constraints,
        Errors,
        Hands,
        Messages,
        Methods,
        Metrics,
        MotionArrays,
        Sensing,
    ):
        app.add_directive(re.sub(r"\B([A-Z])", r"-\1", directive.__name__).lower(), directive)
    app.connect("autodoc-process-docstring", _keep, priority=400)
    app.connect("autodoc-process-docstring", _restore, priority=600)
    return {"parallel_read_safe": True}


_VALUES = ("attribute", "data", "property")
_written: dict[str, list[str]] = {}
"""Docstrings of values by name, before napoleon takes what precedes a colon for a type."""


def _keep(
    app: Sphinx, what: str, name: str, described: object, options: object, lines: list[str]
) -> None:
    if what in _VALUES:
        _written[name] = lines[:]


def _restore(
    app: Sphinx, what: str, name: str, described: object, options: object, lines: list[str]
) -> None:
    if what in _VALUES:
        lines[:] = _written.pop(name)


def _words(command: str) -> Iterator[list[str]]:
    yield [command]
    for below in re.findall(r"^│   • (\S+)", _help([command]), re.M):
        yield [command, below]


def _help(words: list[str]) -> str:
    printed = io.StringIO()
    os.environ["COLUMNS"] = str(_WIDTH)
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main.load(words[0])([*words[1:], "--help"])
    lines = printed.getvalue().rstrip().splitlines()
    return "\n".join(textwrap.fill(line, _WIDTH) if len(line) > _WIDTH else line for line in lines)


def _fields(config: typing.Any, prefix: str) -> Iterator[tuple[str, typing.Any, str]]:
    """Yields name, default and meaning of every field; nested dataclasses follow a dot."""
    meanings = _meanings(type(config))
    for field in dataclasses.fields(config):
        if not field.metadata.get("option", True):
            continue
        value, name = getattr(config, field.name), f"{prefix}{field.name}".replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{prefix}{field.name}.")
        else:
            yield name, value, " ".join(meanings[field.name].split())


def _meanings(kind: type) -> dict[str, str]:
    """Returns the meaning of each field of a dataclass: its docstring, or `Doc` where constraints
    declare it.
    """
    ours = (
        base
        for base in kind.__mro__
        if base.__module__.startswith("congrasp.") and base.__name__ != "Declared"
    )
    written = "".join(map(inspect.getsource, ours))
    hints = typing.get_type_hints(kind, include_extras=True)
    declared = {
        name: mark.documentation
        for name, hint in hints.items()
        for mark in getattr(hint, "__metadata__", ())
        if isinstance(mark, Doc)
    }
    return {
        **declared,
        **dict(re.findall(r'^    (\w+): [^\n]*\n    """(.+?)"""', written, re.M | re.S)),
    }


def _entries(spec: MessageSpec) -> Iterator[tuple[str, str, str]]:
    for name, array in spec.arrays.items():
        shape = "any" if array.shape is None else f"({', '.join(map(str, array.shape))})"
        yield name, " or ".join(array.dtypes), shape + (", may be absent" if array.optional else "")
    for name, kind in spec.meta.items():
        kinds = kind if isinstance(kind, tuple) else (kind,)
        yield name, " or ".join(one.__name__ for one in kinds), "metadata"


def _torques(hand: Hand) -> list[float]:
    return [motor.torque_limit for motor in hand.motors]


def _first_line(documented: type) -> str:
    return (documented.__doc__ or "").partition("\n")[0]


def _meant(title: str, unit: str, meaning: str = "") -> tuple[str, str]:
    return unit, f"{title}. {meaning}".strip()


def _short(value: typing.Any) -> str:
    text = "" if value == "" else str(value)
    return text if len(text) <= _DEFAULT else text[:_DEFAULT] + "…"


def _section(title: str, content: Sequence[nodes.Node]) -> nodes.section:
    section = nodes.section(ids=[nodes.make_id(title)])
    section += nodes.title(text=title)
    section.extend(content)
    return section


def _literal(text: str) -> nodes.literal_block:
    block = nodes.literal_block(text, text)
    block["language"] = "text"
    return block


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> nodes.table:
    group = nodes.tgroup(cols=len(head))
    group.extend(nodes.colspec(colwidth=1) for _ in head)
    body = nodes.tbody()
    for row in rows:
        body += _row([[nodes.literal(text=row[0])], *map(_inline, row[1:])])
    group += nodes.thead("", _row([[nodes.Text(cell)] for cell in head]))
    group += body
    return nodes.table("", group)


def _row(cells: list[list[nodes.Node]]) -> nodes.row:
    row = nodes.row()
    for cell in cells:
        row += nodes.entry("", nodes.paragraph("", "", *cell))
    return row


def _inline(text: str) -> list[nodes.Node]:
    """Returns text with code in backquotes, and options, as literals."""
    parts = re.split(r"`([^`]+)`|(--[a-z][\w.-]*\w)", text)
    return [
        nodes.Text(part) if i % 3 == 0 else nodes.literal(text=part)
        for i, part in enumerate(parts)
        if part is not None
    ]
