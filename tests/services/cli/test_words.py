"""Words of a command line that no shell or a word processor has prepared."""

import pathlib

import pytest

from congrasp.common.errors import CongraspError
from congrasp.services.cli.words import check_typography, expand_homes

HOMES = {
    "~": "/home/ada",
    "~/mug.obj": "/home/ada/mug.obj",
    "--out=~/grasps": "--out=/home/ada/grasps",
    "--objects.folder=~/o": "--objects.folder=/home/ada/o",
    "./~": "./~",
    "mug~": "mug~",
    "~nobody-of-this-name/x": "~nobody-of-this-name/x",
    "--out": "--out",
    "a=~/b": "a=~/b",
}
TYPESET = {
    "\u2014attempts": "Type --attempts",
    "\u2013\u2013out=x": "Type --out",
    "-\u2011out": "Type --out",
    "\u2212-seed": "Type --seed",
    "\u201c120": "quotation mark",
    "25\u201d": "quotation mark",
}
PLAIN = ("--out", "mug:7", "-1", "Tasse \u00e4.obj", "a\u2013b.obj", "\u2212", "5\u2033")


@pytest.mark.parametrize("word", HOMES)
def test_homes_are_expanded(word, monkeypatch):
    monkeypatch.setenv("HOME", "/home/ada")
    assert expand_homes([word]) == [HOMES[word]]


@pytest.mark.parametrize("word", TYPESET)
def test_typeset_words_are_refused(word):
    with pytest.raises(CongraspError, match=TYPESET[word]):
        check_typography(["mug:7", word])


@pytest.mark.parametrize("word", PLAIN)
def test_other_words_are_taken(word):
    check_typography([word])


def test_files_may_have_any_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for word in TYPESET:
        pathlib.Path(word).touch()
    check_typography(list(TYPESET))
