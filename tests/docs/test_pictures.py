"""Pictures of the pages are drawn by the commands of the table, with the policies that ship."""

import dataclasses
import pathlib

import pytest

from congrasp.services.viz.version import RENDERER_VERSION
from tests.pictures import provenance
from tests.pictures.provenance import ROOT, Provenance
from tests.pictures.table import Picture, table

TABLE = table()
EXPECTED = Provenance("congrasp render hand", {"human": "0" * 64}, RENDERER_VERSION)


def origin(picture: Picture) -> Provenance:
    return provenance.current(picture.command, picture.policies, rendered=picture.rendered)


def test_table_has_every_picture() -> None:
    files = {str(picture.relative_to(ROOT)) for picture in provenance.pictures()}
    assert files == TABLE.keys()


def test_no_provenance_without_a_picture() -> None:
    assert not provenance.orphans()


@pytest.mark.parametrize("name", TABLE)
def test_provenance_is_current(name: str) -> None:
    """A picture that is out of date is drawn again: make pictures."""
    assert not list(provenance.faults(ROOT / name, origin(TABLE[name])))


def test_provenance_is_read_as_it_was_written(tmp_path: pathlib.Path) -> None:
    provenance.write(tmp_path / "hand.png", EXPECTED)
    assert provenance.read(tmp_path / "hand.png") == EXPECTED
    assert not list(provenance.faults(tmp_path / "hand.png", EXPECTED))


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"command": "congrasp render hand --hand allegro"}, "command"),
        ({"policies": {"human": "1" * 64}}, "policies"),
        ({"policies": {}}, "policies"),
        ({"renderer": RENDERER_VERSION - 1}, "renderer"),
    ],
)
def test_faults_of_another_origin(changes: dict, word: str, tmp_path: pathlib.Path) -> None:
    provenance.write(tmp_path / "hand.png", dataclasses.replace(EXPECTED, **changes))
    (fault,) = provenance.faults(tmp_path / "hand.png", EXPECTED)
    assert word in fault


def test_faults_without_a_provenance(tmp_path: pathlib.Path) -> None:
    (fault,) = provenance.faults(tmp_path / "hand.png", EXPECTED)
    assert "hand.png.json is absent" in fault


def test_orphans_are_files_without_a_picture(tmp_path: pathlib.Path) -> None:
    for folder in provenance.FOLDERS:
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "docs/images/hand.png").touch()
    (tmp_path / "docs/images/hand.png.json").touch()
    (tmp_path / "docs/gallery/mug.gif.json").touch()
    assert provenance.orphans(tmp_path) == [tmp_path / "docs/gallery/mug.gif.json"]
