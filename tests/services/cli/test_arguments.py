"""Values of options before a command line is parsed."""

import pytest

from congrasp.services.cli.arguments import option_value


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ([], ""),
        (["--hand", "human"], "human"),
        (["--hand=human"], "human"),
        (["--hand"], ""),
        (["--hand=", "--preset"], ""),
        (["--hand", "human", "--hand=allegro"], "allegro"),
        (["--hand=human", "--hand", "allegro"], "allegro"),
        (["--handle", "human"], ""),
    ],
)
def test_value_of_an_option(arguments, value):
    assert option_value("--hand", arguments) == value
