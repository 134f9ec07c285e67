"""Builds parsers from commands: parameters or fields become options, and docstrings help."""

import contextlib
import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any

import docstring_parser
import tyro

Command = Callable[..., Any]
"""A function, or a frozen dataclass with `__call__`, whose fields' docstrings are the help."""
Parser = Callable[[list[str]], Callable[[], Any]]
"""From the arguments to the requested call."""
_QUIET = ("", "None", "False")
"""Defaults that are not shown, because the help describes them."""
_LARGEST_SEED = 10**15
_CONTINUED = re.compile(r"\s*\n\s*")


def of_command(
    command: Command,
    prog: str,
    defaults: Callable[[list[str]], Mapping[str, Any]] = lambda rest: {},
) -> Parser:
    """Returns the parser of a command; `defaults` computes values of its parameters that depend on
    the arguments.
    """

    def parse(rest: list[str]) -> Callable[[], Any]:
        bound = functools.partial(_deferred(command), **defaults(rest))
        with _epilog(examples(command), rest):
            return tyro.cli(
                bound, prog=prog, args=rest, config=(tyro.conf.DisallowNone,), registry=_REGISTRY
            )

    return parse


def of_group(commands: Mapping[str, Command], prog: str, description: str | None) -> Parser:
    """Returns the parser of a group of commands by name."""

    def parse(rest: list[str]) -> Callable[[], Any]:
        if rest and rest[0] in commands:
            return of_command(commands[rest[0]], f"{prog} {rest[0]}")(rest[1:])
        deferred = {name: _deferred(command) for name, command in commands.items()}
        first = [line for command in commands.values() for line in examples(command)[:1]]
        with _epilog(first, rest):
            return tyro.extras.subcommand_cli_from_dict(
                deferred, prog=prog, description=description, args=rest
            )

    return parse


def examples(command: Command) -> list[str]:
    """Returns the command lines in the section `Examples` of a command's docstring."""
    found = docstring_parser.parse(inspect.getdoc(command) or "").examples
    return [
        line.strip()
        for example in found
        for line in (example.description or "").splitlines()
        if line.strip()
    ]


@contextlib.contextmanager
def _epilog(lines: Sequence[str], arguments: Sequence[str]) -> Iterator[None]:
    """Prints examples after the help, which a parser prints when it exits without an error; with
    other arguments it prints scripts of shells.
    """
    try:
        yield
    except SystemExit as end:
        asks_for_help = not {"-h", "--help"}.isdisjoint(arguments)
        if not end.code and lines and asks_for_help:
            print("\n".join(("Examples:", *(f"  {line}" for line in lines))))
        raise


def _deferred(command: Command) -> Callable[..., Callable[[], Any]]:
    """Returns the command with its arguments bound, to be called once they are valid."""

    def bind(*args: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(_run, command, *args, **options)

    hints = {
        name: _described(
            name, hint, *([tyro.conf.arg(name="")] if dataclasses.is_dataclass(hint) else [])
        )
        for name, hint in typing.get_type_hints(command, include_extras=True).items()
    }
    signature = inspect.signature(command)
    taken = [value.replace(annotation=hints[name]) for name, value in signature.parameters.items()]
    vars(bind)["__signature__"] = signature.replace(parameters=taken)
    bind.__name__, bind.__annotations__ = command.__name__, {**hints, "return": Any}
    # A parameter's text on one line
    text = re.sub(r"\n    (?=\S)", " ", inspect.getdoc(command) or "")
    fields = (
        [f"  {name}: {help}" for name, help in _meanings(command).items()]
        if isinstance(command, type)
        else []
    )
    bind.__doc__ = "\n".join([text, "", "Args:", *fields] if fields else [text])
    return bind


def _run(command: Command, *args: Any, **options: Any) -> Any:
    """Calls a function, or a command whose fields are its options."""
    return command(*args, **options)() if isinstance(command, type) else command(*args, **options)


def _described(name: str, hint: Any, *more: Any) -> Any:
    """Returns a parameter's type, with the display of its values and default, and the range of
    seeds.
    """
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    marks += [_SEED] if name == "seed" or name.endswith("_seed") else []
    for mark in (
        marks
    ):  # a type that is known only when a command line is parsed, such as the engines' names
        kind = made() if (made := getattr(mark, "constructor_factory", None)) else kind
    metavar = None
    if typing.get_origin(kind) is tuple and typing.get_args(kind)[-1] is Ellipsis:
        metavar = f"{_value(typing.get_args(kind)[0])} ..."
    return Annotated[
        (kind, *marks, *more, tyro.conf.arg(metavar=metavar, help_behavior_hint=_hint))
    ]


def _seed(words: list[str]) -> int:
    """Parses a seed that every random generator accepts, with room for the following ones."""
    if not words[0].isdecimal() or int(words[0]) > _LARGEST_SEED:
        raise ValueError(f"a seed is a whole number from 0 to {_LARGEST_SEED:.0e}")
    return int(words[0])


_SEED = tyro.constructors.PrimitiveConstructorSpec(
    nargs=1,
    metavar="INT",
    instance_from_str=_seed,
    is_instance=lambda x: isinstance(x, int),
    str_from_instance=lambda x: [str(x)],
)


def _value(kind: Any) -> str:
    """Display form of one value of a tuple."""
    if typing.get_origin(kind) is typing.Literal:
        return "{" + ",".join(map(str, typing.get_args(kind))) + "}"
    return "PATH" if kind.__name__ == "Path" else kind.__name__.upper()


def _hint(default: str) -> str:
    """Suffix of an option's help."""
    shown = default.strip("[']")  # a choice is shown as a list
    return "" if shown in _QUIET else f"(default: {shown})"


_REGISTRY = tyro.constructors.ConstructorRegistry()


@_REGISTRY.struct_rule
def _dataclass(
    info: tyro.constructors.StructTypeInfo,
) -> tyro.constructors.StructConstructorSpec | None:
    """Options of a dataclass: tyro's own rule, with each field's text on one line and described as
    parameters are.
    """
    if not dataclasses.is_dataclass(info.type):
        return None
    hints = typing.get_type_hints(info.type, include_extras=True)
    source = info.default if dataclasses.is_dataclass(info.default) else info.type
    return tyro.constructors.StructConstructorSpec(
        instantiate=info.type,
        fields=tuple(
            tyro.constructors.StructFieldSpec(
                field.name,
                _option(field, hints[field.name]),
                getattr(source, field.name, tyro.MISSING),
                functools.partial(_meanings(info.type).get, field.name),
            )
            for field in dataclasses.fields(info.type)
        ),
    )


def _option(field: "dataclasses.Field[Any]", hint: Any) -> Any:
    """Type of a field for the parser; a field that commands compute is no option."""
    if field.metadata.get("option", True):
        return _described(field.name, hint)
    return Annotated[hint, tyro.conf.Fixed, tyro.conf.Suppress]


@functools.cache
def _meanings(kind: type) -> Mapping[str, str]:
    """Help of the fields of a class, each on one line: the string under it."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        params = docstring_parser.parse_from_object(base).params
        found |= {
            one.arg_name: _CONTINUED.sub(" ", one.description) for one in params if one.description
        }
    return types.MappingProxyType(found)
