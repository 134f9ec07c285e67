"""The doctor: what it looks at, and what it says about a machine that is not well."""

import collections
import errno
import importlib.metadata
import itertools
import os
import pathlib
import re
import socket
import subprocess
import types

import jax
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.transport.ports import check_loopback, free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.services.ops import doctor
from congrasp.services.ops.certificates import create_authority, issue
from congrasp.services.ops.doctor import doctor as command
from tests.rollouts import learner_hub

ALWAYS = (
    "python",
    "mujoco",
    "mujoco-mjx",
    "jax",
    "flax",
    "eclipse-zenoh",
    "gpu",
    "ports",
    "disk",
    "clock",
)


def findings(**options):
    return {finding.what: finding for finding in doctor.examine(**options)}


def test_this_machine_is_looked_at(capsys):
    assert set(ALWAYS) <= findings().keys()
    code = command()
    lines = capsys.readouterr().out.splitlines()
    if code == 0:
        assert lines.pop().startswith("Next: congrasp train --preset check")
    assert len(lines) >= len(ALWAYS) and all(line.startswith(("ok ", "BAD")) for line in lines)
    assert code == int(any(line.startswith("BAD") for line in lines))


def test_another_version_of_mujoco_is_named_with_the_one_that_is_needed(monkeypatch, capsys):
    real = importlib.metadata.version
    monkeypatch.setattr(
        importlib.metadata, "version", lambda name: "4.0.0" if name == "mujoco" else real(name)
    )
    found = findings()
    assert not found["mujoco"].fine and "4.0.0: ==3.17.0 is needed" in found["mujoco"].text
    assert "4.0.0 and 3.17.0 do not match" in found["mujoco, mujoco-mjx"].text
    assert command() == 1
    assert any(line.startswith("BAD  mujoco") for line in capsys.readouterr().out.splitlines())


def test_a_package_that_is_missing_comes_with_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    assert "pip install 'congrasp[train]'" in findings()["mujoco-mjx"].text


def test_a_loopback_interface_that_is_down_is_named(monkeypatch):
    def unreachable(self, address):
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket.socket, "connect", unreachable)
    found = findings()["ports"]
    assert not found.fine and "unreachable" in found.text and "ip link set lo up" in found.text
    with pytest.raises(CongraspError, match=r"unreachable.*ip link set lo up"):
        check_loopback()


def test_a_port_in_use_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "_PORT", free_port())
    assert "are free" in findings()["ports"].text
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", doctor._PORT))
        busy.listen()
        found = findings()["ports"]
    assert f"{doctor._PORT} is in use" in found.text and "--listen" in found.text


def _slow(patch):
    """A disk on which every look at the clock finds that a minute has passed."""
    ticks = itertools.count(step=60.0)
    patch.setattr(doctor, "time", types.SimpleNamespace(monotonic=lambda: next(ticks), **CLOCK))


CHECKS = {
    "python": doctor._python,
    "gpu": doctor._gpu,
    "jax": doctor._jax,
    "disk": lambda: doctor._disk(pathlib.Path()),
    "clock": doctor._clock,
}
CLOCK = {"time": lambda: 2e9, "sleep": lambda seconds: None, "strftime": lambda form: "now"}


@pytest.mark.parametrize(
    ("what", "words", "patch"),
    [
        (
            "disk",
            "0.1 GiB free: a run needs about 2 GiB",
            lambda m: m.setattr(
                doctor.shutil, "disk_usage", lambda path: collections.namedtuple("U", "free")(10**8)
            ),
        ),
        ("disk", "written at 0 MB/s: .*--run-dir", _slow),
        ("clock", "years behind; set it", lambda m: m.setattr(doctor.time, "time", lambda: 0.0)),
        (
            "clock",
            "jumped by",
            lambda m: m.setattr(doctor.time, "time", itertools.count(2_000_000_000, 5).__next__),
        ),
        (
            "python",
            "3.10.4: 3.11, 3.12",
            lambda m: m.setattr(doctor.platform, "python_version", lambda: "3.10.4"),
        ),
        ("jax", "NVIDIA GPU is not found", lambda m: m.setattr(doctor, "_NVIDIA", os.devnull)),
        ("gpu", "install the NVIDIA driver", lambda m: m.setattr(doctor, "_NVIDIA", os.devnull)),
        ("jax", "RuntimeError: no such device", lambda m: m.setattr(jax, "devices", _broken)),
    ],
)
def test_what_is_wrong_is_said(monkeypatch, what, words, patch):
    if what == "python":
        monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 4))
    with monkeypatch.context() as change:
        patch(change)
        (found,) = doctor._tried(CHECKS[what])
    assert found.what == what and not found.fine and re.search(words, found.text), found.text


def _broken():
    raise RuntimeError("no such device")


def test_an_old_driver_is_named_with_the_one_that_is_needed(monkeypatch):
    answer = "NVIDIA H100, 81559, 1024, 535.1\nNVIDIA H100, 81559, 0, 580.65\n"
    monkeypatch.setattr(doctor, "_NVIDIA", os.devnull)
    monkeypatch.setattr(
        subprocess, "run", lambda *a, **k: subprocess.CompletedProcess(a, 0, answer)
    )
    found = {finding.what: finding for finding in doctor._gpu()}
    assert not found["gpu 0"].fine and "driver 535.1: 580 or newer is needed" in found["gpu 0"].text
    assert (
        found["gpu 1"].fine and found["gpu 1"].text == "NVIDIA H100, 80 GiB (0 used), driver 580.65"
    )


def test_certificates_are_looked_at(tmp_path):
    (none,) = doctor._certificates(tmp_path)
    assert not none.fine and "congrasp certs init" in none.text
    create_authority(tmp_path)
    issue(tmp_path, "actor", days=100.0)
    issue(tmp_path, "observer", days=3.0)
    found = {finding.text.split(":")[0]: finding for finding in doctor._certificates(tmp_path)}
    actor, observer = found["quickstart.actor.0"], found["quickstart.observer.0"]
    assert actor.fine and not observer.fine and "issue --force" in observer.text


def test_a_learner_is_reached_and_its_clock_compared(monkeypatch):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint]) as server:
        hub = learner_hub(server, "r").hub
        assert [finding.fine for finding in doctor._learner(endpoint, "r")] == [True, True]
        real = hub.status
        monkeypatch.setattr(hub, "status", lambda: real() | {"time": real()["time"] + 7.0})
        _, clock = doctor._learner(endpoint, "r")
        assert not clock.fine and clock.text.startswith(("+7.0", "+6.9"))
        (other,) = doctor._learner(endpoint, "other")
        assert not other.fine and "No response for congrasp/other/status" in other.text
    (unreached,) = doctor._learner(endpoint, "r")
    assert not unreached.fine and "Start the learner" in unreached.text
