"""Folders of the user by the variables of the XDG specification."""

import pathlib

import pytest

from congrasp.common.io.files import user_folder

FOLDERS = {
    "": "/home/ada/.cache",
    "/data/cache": "/data/cache",
    "~/c": "/home/ada/c",
    "cache": "/home/ada/.cache",
    "./cache": "/home/ada/.cache",
}
"""Folders by the value of the variable."""


@pytest.mark.parametrize("value", FOLDERS)
def test_user_folder_is_absolute(value, monkeypatch):
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert user_folder("XDG_CACHE_HOME", ".cache") == pathlib.Path(FOLDERS[value])
