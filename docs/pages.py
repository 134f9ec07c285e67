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

from congrasp.common.config import RunConfig
from congrasp.common.wire import messages
from congrasp.common.wire.messages import MessageSpec
from congrasp.services.cli import main

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
        rows = [(f"--{name}", _short(value), text) for name, value, text in _fields(RunConfig(), "")]
        return [_table(("option", "default", "meaning"), rows)]


class Messages(Directive):
    """Entries of every kind of message on the wire."""

    def run(self) -> list[nodes.Node]:
        """Returns a section for each kind."""
        specs = [value for value in vars(messages).values() if isinstance(value, MessageSpec)]
        return [_section(spec.kind, [_table(("entry", "type", "shape"), list(_entries(spec)))]) for spec in specs]


class Cases(Directive):
    """Files that do not load, from the descriptions that the tests run."""

    def run(self) -> list[nodes.Node]:
        """Returns a table."""
        cases = [json.loads(file.read_text()) for file in sorted(_CASES.glob("*/case.json"))]
        rows = [(case["command"], case["sign"], case["remedy"]) for case in cases if "sign" in case]
        return [_table(("for example", "sign", "remedy"), rows)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directives with Sphinx."""
    for directive in (Cases, Commands, Configuration, Messages):
        app.add_directive(directive.__name__.lower(), directive)
    return {"parallel_read_safe": True}


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
        value, name = getattr(config, field.name), f"{prefix}{field.name}".replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{prefix}{field.name}.")
        else:
            yield name, value, " ".join(meanings[field.name].split())


def _meanings(kind: type) -> dict[str, str]:
    """Returns the meaning of each field of a dataclass: its docstring, or `Doc` where constraints declare it."""
    written = "".join(inspect.getsource(base) for base in kind.__mro__ if base.__module__ == kind.__module__)
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
        body += _row([nodes.literal(text=row[0]), *map(_inline, row[1:])])
    group += nodes.thead("", _row([nodes.Text(cell) for cell in head]))
    group += body
    return nodes.table("", group)


def _inline(text: str) -> nodes.inline:
    """A text whose parts in backticks are literal."""
    parts = enumerate(text.split("`"))
    return nodes.inline("", "", *(nodes.literal(text=part) if i % 2 else nodes.Text(part) for i, part in parts))


def _row(cells: list[nodes.Node]) -> nodes.row:
    row = nodes.row()
    for cell in cells:
        row += nodes.entry("", nodes.paragraph("", "", cell))
    return row
