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
"""Line end within the text of a field."""
_CONTINUED_PARAMETER = re.compile(r"\n    (?=\S)")
"""Line end within the text of a parameter, whose further lines have an indentation of four."""


def of_command(
    command: Command,
    prog: str,
    defaults: Callable[[list[str]], Mapping[str, Any]] = lambda rest: {},
) -> Parser:
    """Returns the parser of a command; `defaults` computes values of its parameters that depend on
    the arguments.
    """

    def parse(rest: list[str]) -> Callable[[], Any]:
        cli = functools.partial(
            tyro.cli, prog=prog, args=rest, config=(tyro.conf.DisallowNone,), registry=_REGISTRY
        )
        values = defaults(rest)
        with _epilog(examples(command), rest):
            if not isinstance(command, type):
                return cli(functools.partial(_deferred(command), **values))
            if values:
                cli = functools.partial(cli, default=command(**values))
            fields = vars(cli(command))
            # `main` checks the values in the keywords of the call before it makes the call
            return functools.partial(_run, command, **fields)

    return parse


def of_group(commands: Mapping[str, Command], prog: str, description: str | None) -> Parser:
    """Returns the parser of a group of commands by name."""

    def parse(rest: list[str]) -> Callable[[], Any]:
        if rest and rest[0] in commands:
            return of_command(commands[rest[0]], f"{prog} {rest[0]}")(rest[1:])
        first_examples = []
        for command in commands.values():
            first_examples += examples(command)[:1]
        with _epilog(first_examples, rest):
            # Prints the help or an error: the first word is none of the commands
            return tyro.extras.subcommand_cli_from_dict(
                dict(commands), prog=prog, description=description, args=rest
            )

    return parse


def examples(command: Command) -> list[str]:
    """Returns the command lines in the section `Examples` of a command's docstring."""
    docstring = docstring_parser.parse(inspect.getdoc(command) or "")
    lines = []
    for example in docstring.examples:
        lines += (example.description or "").splitlines()
    return [line.strip() for line in lines if line.strip()]


@contextlib.contextmanager
def _epilog(lines: Sequence[str], arguments: Sequence[str]) -> Iterator[None]:
    """Prints examples after the help, once the parser has printed the help and exits."""
    try:
        yield
    except SystemExit as end:
        # The exit code is 0 after a completion script, too, which must have no examples
        is_help = "-h" in arguments or "--help" in arguments
        if not end.code and lines and is_help:
            print("Examples:")
            for line in lines:
                print(f"  {line}")
        raise


def _deferred(command: Command) -> Callable[..., Callable[[], Any]]:
    """Returns a function of the command's parameters that returns the call instead of making it.

    So `main` can check the arguments before it makes the call.
    """

    def bind(*args: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(_run, command, *args, **options)

    hints = {}
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        hints[name] = _described(name, hint)
        if dataclasses.is_dataclass(hint):
            # Its fields become options without the parameter's name as a prefix
            hints[name] = Annotated[hints[name], tyro.conf.arg(name="")]
    signature = inspect.signature(command)
    parameters = []
    for name, parameter in signature.parameters.items():
        parameters.append(parameter.replace(annotation=hints[name]))
    # tyro reads the options from these attributes
    bind.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    bind.__name__ = command.__name__
    bind.__annotations__ = {**hints, "return": Any}
    bind.__doc__ = _CONTINUED_PARAMETER.sub(" ", inspect.getdoc(command) or "")
    return bind


def _run(command: Command, *args: Any, **options: Any) -> Any:
    """Calls a function, or a command whose fields are its options."""
    if isinstance(command, type):
        bound = command(*args, **options)
        return bound()
    return command(*args, **options)


def _described(name: str, hint: Any) -> Any:
    """Returns a parameter's type, with the display of its values and default, and the range of
    seeds.
    """
    kind = hint
    marks: list[Any] = []
    if typing.get_origin(hint) is Annotated:
        kind, *marks = typing.get_args(hint)
        kind = _computed_type(marks) or kind
    if name == "seed" or name.endswith("_seed"):
        marks.append(_SEED)
    display = tyro.conf.arg(metavar=_metavar(kind), help_behavior_hint=_hint)
    return Annotated[(kind, *marks, display)]


def _computed_type(marks: Sequence[Any]) -> Any:
    """Type that a mark `tyro.conf.arg(constructor_factory=...)` computes, such as the engines'
    names; None without such a mark. tyro computes it when it parses, which is after `_metavar`
    needs it.
    """
    for mark in marks:
        factory = getattr(mark, "constructor_factory", None)
        if factory is not None:
            return factory()
    return None


def _metavar(kind: Any) -> str | None:
    """Display form of the values of a tuple of any length; None for other types, so that tyro
    chooses the form.
    """
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is tuple and arguments[-1] is Ellipsis:
        return f"{_value(arguments[0])} ..."
    return None


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
    text = default.strip("[']")  # a choice is shown as a list
    return "" if text in _QUIET else f"(default: {text})"


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
    meanings = _meanings(info.type)
    options = []
    for field in dataclasses.fields(info.type):
        option = tyro.constructors.StructFieldSpec(
            name=field.name,
            type=_described(field.name, hints[field.name]),
            default=_default(field, info.default),
            helptext=functools.partial(meanings.get, field.name),
        )
        options.append(option)
    return tyro.constructors.StructConstructorSpec(instantiate=info.type, fields=tuple(options))


def _default(field: dataclasses.Field[Any], instance: Any) -> Any:
    """Default of an option: the field's value in the default instance of its class if there is one,
    else the field's default. `tyro.MISSING` for a required option.
    """
    if dataclasses.is_dataclass(instance):
        return getattr(instance, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING


@functools.cache
def _meanings(kind: type) -> Mapping[str, str]:
    """Help of the fields of a class, each on one line: the string under it."""
    meanings: dict[str, str] = {}
    bases = kind.__mro__[:-1]
    for base in reversed(bases):
        for field in docstring_parser.parse_from_object(base).params:
            if field.description:
                meanings[field.arg_name] = _CONTINUED.sub(" ", field.description)
    return types.MappingProxyType(meanings)
