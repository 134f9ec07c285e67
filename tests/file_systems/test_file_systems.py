"""Checkpoints, locks and files on file systems that lack something, and in folders with planted
links.
"""

import fcntl
import os
import pathlib
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.journal import Journal
from congrasp.common.io.opening import open_to_append, open_to_update
from congrasp.learner.checkpoint import Checkpoints
from congrasp.learner.run_directory import exclusive, note_version
from congrasp.services.ops.lifetime import Child
from tests.file_systems import stand_ins

ROOT = pathlib.Path(__file__).resolve().parents[2]
LACKS = [
    *(("no_folder_fsync", name) for name in ("EINVAL", "ENOTSUP", "EBADF", "EACCES")),
    *(("no_links", name) for name in ("EPERM", "ENOTSUP", "EINVAL", "EACCES")),
    *(("no_locks", name) for name in ("ENOLCK", "ENOTSUP", "EINVAL")),
]


@pytest.fixture
def lacking(monkeypatch):
    """Takes a feature from the file systems of this process until the test ends."""
    for module, name in ((os, "fsync"), (os, "symlink"), (fcntl, "lockf"), (fcntl, "flock")):
        monkeypatch.setattr(module, name, getattr(module, name))

    def take(lack: str, number: str) -> None:
        getattr(stand_ins, lack)(stand_ins.NUMBERS[number])

    return take


def save_and_load(folder: pathlib.Path) -> tuple[int, int]:
    """Saves five checkpoints and loads the last; returns its version and the number of notices."""
    notices: list[str] = []
    checkpoints = Checkpoints(folder / "checkpoints")
    with exclusive(folder, notices.append) as check:
        for version in range(1, 6):
            check()
            checkpoints.save({"x": np.full(3, version)}, {}, version)
    tree, _ = checkpoints.load({"x": np.zeros(3, int)})
    return int(tree["x"][0]), len(notices)


def on(stand_in: str, program: str, folder: pathlib.Path) -> subprocess.CompletedProcess[str]:
    """Runs a program in a process on a file system that lacks something."""
    lines = [
        "import pathlib, sys",
        "from tests.file_systems import stand_ins",
        f"stand_ins.{stand_in}",
        "folder = pathlib.Path(sys.argv[1])",
        textwrap.dedent(program),
    ]
    return subprocess.run(
        [sys.executable, "-c", "\n".join(lines), str(folder)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        check=False,
    )


@pytest.mark.parametrize(("lack", "number"), LACKS)
def test_checkpoints_without_a_feature(tmp_path, lacking, lack, number):
    lacking(lack, number)
    notices = 0
    if lack == "no_locks":
        notices = 1
    assert save_and_load(tmp_path) == (5, notices)
    folder = tmp_path / "checkpoints"
    assert len(list(folder.glob("*.safetensors"))) == 3
    latest = folder / "latest"
    if lack == "no_links":
        assert latest.read_text().strip() == "checkpoint_000000005.safetensors"
    else:
        assert latest.resolve().name == "checkpoint_000000005.safetensors"
    assert not list(tmp_path.rglob(".*")), "no temporary file is left"


def test_the_link_of_an_old_run_becomes_a_file(tmp_path, lacking):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    victim = folder / "checkpoint_000000000.safetensors"
    victim.write_bytes(b"old")
    (folder / "latest").symlink_to(victim.name)
    lacking("no_links", "EPERM")
    save_and_load(tmp_path)
    assert not (folder / "latest").is_symlink()


HOLD = """
    import os, time
    from congrasp.learner.run_directory import exclusive
    with exclusive(folder):
        print(os.getpid(), flush=True)
        time.sleep(END)
"""


def test_two_learners_without_locks_are_refused(tmp_path):
    lines = ["import pathlib, sys", "from tests.file_systems import stand_ins"]
    lines += ["stand_ins.no_locks(37)", "folder = pathlib.Path(sys.argv[1])"]
    program = "\n".join([*lines, textwrap.dedent(HOLD.replace("END", "100"))])
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as first:
        process = first.stdout.readline().strip()
        second = on("no_locks(37)", HOLD.replace("END", "0"), tmp_path)
        first.kill()
    assert second.returncode
    assert f"in use by process {process}" in second.stderr
    third = on("no_locks(37)", HOLD.replace("END", "0"), tmp_path)
    assert third.returncode == 0, "the claim of a killed process is replaced"
    (tmp_path / "claim").write_text('{"host": "elsewhere", "process": 7}')
    fourth = on("no_locks(37)", HOLD.replace("END", "0"), tmp_path)
    assert fourth.returncode
    assert "elsewhere" in fourth.stderr


CASES = {
    "a file": """
        from congrasp.common.io.files import write_atomically
        write_atomically(folder / "Mug.npz", b"1")
        write_atomically(folder / "mug.npz", b"second")
    """,
    "a journal": """
        from congrasp.common.io.journal import Journal
        Journal(folder / "Mug.jsonl").write(a=1)
        Journal(folder / "mug.jsonl").write(a="second")
    """,
}


@pytest.mark.parametrize("case", CASES)
def test_names_that_differ_in_case(tmp_path, case):
    confused = on("ignores_case()", CASES[case], tmp_path)
    assert confused.returncode
    assert "CongraspError" in confused.stderr
    assert "mug" in confused.stderr.lower()
    for path in tmp_path.iterdir():
        assert b"second" not in path.read_bytes()
    plain = on("NUMBERS", CASES[case], tmp_path / "plain")
    assert plain.returncode == 0, plain.stderr


def test_a_name_is_written_twice_where_case_is_ignored(tmp_path):
    program = """
        from congrasp.common.io.files import write_atomically
        write_atomically(folder / "Mug.npz", b"1")
        write_atomically(folder / "Mug.npz", b"2")
    """
    assert on("ignores_case()", program, tmp_path).returncode == 0
    assert (tmp_path / "Mug.npz").read_bytes() == b"2"


def _journal(path: pathlib.Path) -> None:
    Journal(path).write(a=1)


def _log(path: pathlib.Path) -> None:
    child = Child("actor", ["--version"], path)
    child.start()
    child.process.wait(60)


def _lock(path: pathlib.Path) -> None:
    with exclusive(path.parent):
        pass


OPENED = {
    "journal": ("a.jsonl", _journal),
    "log": ("actor.log", _log),
    "lock": ("lock", _lock),
    "version": ("version", lambda path: note_version(path.parent, 3)),
    "append": ("x", open_to_append),
    "update": ("x", open_to_update),
}


@pytest.mark.parametrize("kind", ["symbolic", "hard", "pipe"])
@pytest.mark.parametrize("name", OPENED)
def test_planted_names_are_refused(tmp_path, name, kind):
    file, use = OPENED[name]
    victim = tmp_path / "victim"
    victim.write_text("of the user")
    path = tmp_path / "run" / file
    path.parent.mkdir()
    if kind == "symbolic":
        path.symlink_to(victim)
    elif kind == "hard":
        os.link(victim, path)
    else:
        os.mkfifo(path)
    with pytest.raises(CongraspError, match=file):
        use(path)
    assert victim.read_text() == "of the user"


def test_a_planted_link_is_replaced_by_an_atomic_write(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("of the user")
    path = tmp_path / "config.json"
    path.symlink_to(victim)
    (tmp_path / f".config.json.{os.getpid()}.tmp").symlink_to(victim)
    write_atomically(path, b"new")
    assert victim.read_text() == "of the user"
    assert path.read_bytes() == b"new"
    assert not path.is_symlink()


@pytest.mark.parametrize("before", [True, False])
def test_an_earlier_file_is_named_only_if_there_is_one(tmp_path, monkeypatch, before):
    path = tmp_path / "a"
    if before:
        path.write_text("old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CongraspError) as raised:
        write_atomically(path, b"new")
    assert ("intact" in str(raised.value)) == before
    assert [one.name for one in tmp_path.iterdir()] == ["a"] * before


def test_a_failed_folder_flush_is_not_called_intact(tmp_path, monkeypatch):
    flushed = []

    def broken(descriptor: int) -> None:
        flushed.append(descriptor)
        if len(flushed) > 1:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(CongraspError) as raised:
        write_atomically(tmp_path / "a", b"new")
    assert "intact" not in str(raised.value)
    assert (tmp_path / "a").read_bytes() == b"new"
