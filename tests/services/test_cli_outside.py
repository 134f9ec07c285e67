"""A command from outside: its file and its row are all that there is to add."""

import textwrap

import pytest

from congrasp.common.errors import CongraspError
from congrasp.services import cli
from congrasp.services.cli import main

FILE = '''
"""`congrasp weigh`: the mass of a box."""


def weigh(edge: float, density: float = 1000.0) -> int:
    """Print the mass of a box.

    Args:
      edge: Edge of the box in m.
      density: In kg/m^3.
    """
    from congrasp.common.errors import CongraspError

    if edge <= 0.0:
        raise CongraspError(f"--edge {edge:g} must be positive.")
    print(f"{density * edge**3:g} kg")
    return 0


def defaults(arguments: list[str]) -> dict[str, float]:
    """Wood floats."""
    return {"density": 600.0} if "--edge=0.5" in arguments else {}


COMMAND = weigh
'''


@pytest.fixture(autouse=True)
def weigh(monkeypatch, tmp_path):
    (tmp_path / "weigh.py").write_text(textwrap.dedent(FILE))
    monkeypatch.setattr(cli, "__path__", [*cli.__path__, str(tmp_path)])
    monkeypatch.setitem(main.COMMANDS, "weigh", "the mass of a box")
    monkeypatch.setattr(main, "prepare_environment", lambda: None)


def test_it_runs_and_its_options_follow_from_its_signature(capsys):
    assert main.run(["weigh", "--edge", "0.1"]) == 0
    assert main.run(["weigh", "--edge=0.5"]) == 0
    assert capsys.readouterr().out.split("\n") == ["1 kg", "75 kg", ""]
    with pytest.raises(CongraspError, match="--edge -1 must be positive"):
        main.run(["weigh", "--edge", "-1"])
    with pytest.raises(CongraspError, match="See 'congrasp weigh --help'"):
        main.run(["weigh", "--edge", "1", "--edges", "2"])


def test_it_is_in_the_help(capsys):
    assert "weigh        the mass of a box" in main.usage()
    with pytest.raises(SystemExit):
        main.run(["weigh", "--help"])
    text = capsys.readouterr().out
    assert "Print the mass of a box." in text
    assert "In kg/m^3." in text
