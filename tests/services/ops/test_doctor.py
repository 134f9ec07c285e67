"""The doctor: what it looks at, and what it says about a machine that is not well."""

import collections
import errno
import functools
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


def test_doctor_prints_a_line_for_each_check(capsys):
    assert set(ALWAYS) <= findings().keys()
    code = command()
    lines = capsys.readouterr().out.splitlines()
    if code == 0:
        assert lines.pop().startswith("Next: congrasp train --preset check")
    assert len(lines) >= len(ALWAYS)
    assert all(line.startswith(("ok ", "BAD")) for line in lines)
    assert code == int(any(line.startswith("BAD") for line in lines))


def test_another_mujoco_version_names_the_required_one(monkeypatch, capsys):
    real = importlib.metadata.version
    monkeypatch.setattr(
        importlib.metadata, "version", lambda name: "4.0.0" if name == "mujoco" else real(name)
    )
    by_check = findings()
    assert not by_check["mujoco"].fine
    assert "4.0.0: ==3.17.0 is needed" in by_check["mujoco"].text
    assert "4.0.0 and 3.17.0 do not match" in by_check["mujoco, mujoco-mjx"].text
    assert command() == 1
    assert any(line.startswith("BAD  mujoco") for line in capsys.readouterr().out.splitlines())


def test_a_missing_package_names_the_install_command(monkeypatch):
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
    monkeypatch.setattr(doctor, "PORT", free_port())
    assert "are free" in findings()["ports"].text
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", doctor.PORT))
        busy.listen()
        ports = findings()["ports"]
    assert f"{doctor.PORT} is in use" in ports.text
    assert "--listen" in ports.text


def _slow(patch):
    """A disk on which every look at the clock finds that a minute has passed."""
    ticks = itertools.count(step=60.0)
    patch.setattr(doctor, "time", types.SimpleNamespace(monotonic=lambda: next(ticks), **CLOCK))


CHECKS = {
    "python": doctor.check_python,
    "gpu": doctor.check_gpu,
    "jax": doctor.check_jax,
    "disk": lambda: doctor.check_disk(pathlib.Path()),
    "clock": doctor.check_clock,
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
        (
            "jax",
            "NVIDIA GPU is not found",
            lambda m: m.setattr(doctor, "NVIDIA_DEVICE", os.devnull),
        ),
        (
            "gpu",
            "install the NVIDIA driver",
            lambda m: m.setattr(doctor, "NVIDIA_DEVICE", os.devnull),
        ),
        ("jax", "RuntimeError: no such device", lambda m: m.setattr(jax, "devices", _broken)),
    ],
)
def test_each_failed_check_names_its_problem(monkeypatch, what, words, patch):
    if what == "python":
        monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 4))
    with monkeypatch.context() as change:
        patch(change)
        (finding,) = doctor.run_check(CHECKS[what])
    assert finding.what == what, finding.text
    assert not finding.fine, finding.text
    assert re.search(words, finding.text), finding.text


def _broken():
    raise RuntimeError("no such device")


def test_an_exception_without_text_is_a_finding():
    def check_silence():
        raise AssertionError

    (finding,) = doctor.run_check(check_silence)
    assert finding.what == "silence"
    assert finding.text == "could not be checked: AssertionError"


def test_a_missing_folder_is_a_finding_of_the_disk(tmp_path):
    (finding,) = doctor.run_check(functools.partial(doctor.check_disk, tmp_path / "absent"))
    assert finding.what == "disk"
    assert not finding.fine
    assert "absent cannot be written" in finding.text


def test_an_old_driver_names_the_required_one(monkeypatch):
    answer = "NVIDIA H100, 81559, 1024, 535.1\nNVIDIA H100, 81559, 0, 580.65\n"
    monkeypatch.setattr(doctor, "NVIDIA_DEVICE", os.devnull)
    monkeypatch.setattr(
        subprocess, "run", lambda *a, **k: subprocess.CompletedProcess(a, 0, answer)
    )
    by_check = {finding.what: finding for finding in doctor.check_gpu()}
    assert not by_check["gpu 0"].fine
    assert "driver 535.1: 580 or newer is needed" in by_check["gpu 0"].text
    assert by_check["gpu 1"].fine
    assert by_check["gpu 1"].text == "NVIDIA H100, 80 GiB (0 used), driver 580.65"


def test_certificates_near_their_expiry_are_reported(tmp_path):
    (none,) = doctor.check_certificates(tmp_path)
    assert not none.fine
    assert "congrasp certs init" in none.text
    create_authority(tmp_path)
    issue(tmp_path, "actor", days=100.0)
    issue(tmp_path, "observer", days=3.0)
    by_certificate = {
        finding.text.split(":")[0]: finding for finding in doctor.check_certificates(tmp_path)
    }
    actor = by_certificate["quickstart.actor.0"]
    observer = by_certificate["quickstart.observer.0"]
    assert actor.fine
    assert not observer.fine
    assert "issue --force" in observer.text


def test_learner_connection_and_clock_offset_are_checked(monkeypatch):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint]) as server:
        hub = learner_hub(server, "r").hub
        assert [finding.fine for finding in doctor.check_learner(endpoint, "r")] == [True, True]
        real = hub.status
        monkeypatch.setattr(hub, "status", lambda: real() | {"time": real()["time"] + 7.0})
        _, clock = doctor.check_learner(endpoint, "r")
        assert not clock.fine
        assert clock.text.startswith(("+7.0", "+6.9"))
        (other,) = doctor.check_learner(endpoint, "other")
        assert not other.fine
        assert "No response for congrasp/other/status" in other.text
    (unreached,) = doctor.check_learner(endpoint, "r")
    assert not unreached.fine
    assert "Start the learner" in unreached.text
