"""Parsers of commands: defaults of options."""

import dataclasses

import pytest

from congrasp.services.cli.parser import of_command


@dataclasses.dataclass(frozen=True)
class Paint:
    """Paints walls."""

    room: str
    """Room to paint."""
    colours: tuple[str, ...] = dataclasses.field(default_factory=lambda: ("red", "blue"))
    """Colours of the walls."""

    def __call__(self) -> tuple[str, tuple[str, ...]]:
        return self.room, self.colours


def test_option_with_a_default_factory_is_optional():
    parse = of_command(Paint, "paint")
    assert parse(["--room", "hall"])() == ("hall", ("red", "blue"))
    assert parse(["--room", "hall", "--colours", "green"])() == ("hall", ("green",))


def test_option_without_default_is_required(capsys):
    with pytest.raises(SystemExit) as end:
        of_command(Paint, "paint")([])
    assert end.value.code == 2
    assert "--room" in capsys.readouterr().err


def test_computed_defaults_replace_those_of_the_fields():
    parse = of_command(Paint, "paint", lambda rest: {"room": "hall", "colours": ("green",)})
    assert parse([])() == ("hall", ("green",))
