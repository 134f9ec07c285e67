"""Environment variables of child processes."""

import os
import pathlib
import site
import sysconfig

import pytest

import congrasp
from congrasp.common.runtime.process_variables import child_environment

ROOT = pathlib.Path(congrasp.__file__).resolve().parents[1]
needs_links = pytest.mark.skipif(os.name == "nt", reason="symbolic links need a privilege")


@pytest.fixture
def link(tmp_path, monkeypatch):
    """A symbolic link to the folder of congrasp, which is not in PYTHONPATH."""
    link = tmp_path / "link"
    link.symlink_to(ROOT, target_is_directory=True)
    monkeypatch.setenv("PYTHONPATH", "")
    return str(link)


def test_a_checkout_is_in_the_path_of_children(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "")
    assert child_environment()["PYTHONPATH"] == str(ROOT)


@needs_links
def test_linked_site_packages_are_not_added(link, monkeypatch):
    monkeypatch.setattr(sysconfig, "get_path", lambda name: link)
    assert child_environment()["PYTHONPATH"] == ""


@needs_links
def test_user_site_packages_are_not_added(link, monkeypatch):
    monkeypatch.setattr(site, "getusersitepackages", lambda: link)
    assert child_environment()["PYTHONPATH"] == ""
