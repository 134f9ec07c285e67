"""The doctor: what it looks at, and what it says about a machine that is not well."""

import collections
import importlib.metadata
import socket

import pytest

from services import doctor
from services.cli.doctor import doctor as command


def findings():
    return {finding.what: finding for finding in doctor.examine()}


def test_this_machine_is_fine(capsys):
    assert {"python", "mujoco", "mujoco-mjx", "devices", "ports", "disk", "clock"} == findings().keys()
    code = command()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7
    assert code == int(any(line.startswith("BAD") for line in lines))
    assert all(line.startswith(("ok ", "BAD")) for line in lines)


def test_another_version_of_mujoco_is_named_with_the_one_that_is_needed(monkeypatch, capsys):
    real = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.0.0" if name == "mujoco" else real(name))
    found = findings()["mujoco"]
    assert not found.fine and "4.0.0" in found.text and "3.17.0" in found.text
    assert command() == 1
    assert any(line.startswith("BAD  mujoco") for line in capsys.readouterr().out.splitlines())


def test_a_package_that_is_missing_comes_with_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    assert "pip install 'congrasp[train]'" in findings()["mujoco-mjx"].text


def test_a_port_in_use_is_named(monkeypatch, free_port):
    monkeypatch.setattr(doctor, "_PORT", free_port())
    assert "are free" in findings()["ports"].text
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", doctor._PORT))
        busy.listen()
        found = findings()["ports"]
    assert f"{doctor._PORT} is in use" in found.text and "--listen" in found.text


@pytest.mark.parametrize(
    ("what", "patch"),
    [
        (
            "disk",
            lambda m: m.setattr(doctor.shutil, "disk_usage", lambda path: collections.namedtuple("U", "free")(10**8)),
        ),
        ("clock", lambda m: m.setattr(doctor.time, "time", lambda: 0.0)),
        ("python", lambda m: m.setattr(doctor.sys, "version_info", (3, 10, 4))),
        ("devices", lambda m: m.setattr(doctor.os.path, "exists", lambda path: path == "/dev/nvidia0")),
    ],
)
def test_what_is_wrong_is_said(monkeypatch, what, patch):
    with monkeypatch.context() as change:
        patch(change)
        found = findings()[what]
    assert not found.fine and ":" in found.text
