"""A training that ends with its first update, as warm-up and benchmarks run it, and the caches that
it fills.
"""

import io
import json
import pathlib
import tarfile
import threading

import pytest

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.services.cli import cache_archive, warmup
from congrasp.services.train import learn as training


def test_it_ends_with_the_first_update_and_leaves_no_run_behind(monkeypatch):
    seen = {}
    events = []

    def learn(run_dir, config, *, wire, inside, stop, monitoring):
        seen.update(run_dir=run_dir, config=config, inside=inside, stop=stop)
        assert pathlib.Path(run_dir, "config.json").exists()
        for update in range(2):
            events.append(f"update {update}")
            monitoring.on_update({})

    monkeypatch.setattr(training, "learn", learn)
    stop = threading.Event()
    training.until_first_update(RunConfig(), "native", stop, lambda: events.append("reported"))
    assert events == ["update 0", "reported", "update 1"]
    assert stop.is_set()
    assert seen["stop"] is stop
    assert seen["inside"].physics == "native"
    assert seen["config"].updates == 1
    assert not seen["run_dir"].exists()


def test_nothing_is_reported_of_a_start_that_was_stopped(monkeypatch):
    def learn(run_dir, config, *, stop, monitoring, **rest):
        stop.set()
        monitoring.on_update({})

    reported = []
    monkeypatch.setattr(training, "learn", learn)
    training.until_first_update(
        RunConfig(), "native", threading.Event(), lambda: reported.append(1)
    )
    assert not reported


def test_an_engine_in_this_process_is_prepared_before_the_learner(monkeypatch, tmp_path):
    begun = []
    config = RunConfig()
    monkeypatch.setattr(training, "prepare_physics", lambda *engine: begun.append(engine))
    monkeypatch.setattr(training, "run_learner", lambda *run, **options: begun.append("learner"))
    training.learn(
        tmp_path, config, wire=None, inside=training.InnerActor("native"), stop=threading.Event()
    )
    assert begun == [("native", get_hand(config.task.hand), config.task), "learner"]


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Makes this a machine with empty caches and a version of JAX; returns the caches' parent
    folder.
    """

    def become(name, version="1.2"):
        folders = {kind: tmp_path / name / "caches" / kind for kind in ("jax", "warp")}
        monkeypatch.setattr(cache_archive, "cache_folders", lambda: folders)
        monkeypatch.setattr(
            cache_archive, "machine_facts", lambda: {"JAX": version, "device": "GPU"}
        )
        return tmp_path / name

    return become


def test_caches_travel_with_a_file(machine, tmp_path, monkeypatch):
    caches = machine("a") / "caches"
    file = tmp_path / "caches.tar"

    def first_update(config, physics, stop, report):
        for name, content in (
            ("jax/program", b"1"),
            ("warp/module/kernel.cubin", b"2"),
            ("warp/.module.tmp", b"3"),
        ):
            (caches / name).parent.mkdir(parents=True, exist_ok=True)
            (caches / name).write_bytes(content)
        (caches / "jax/link").symlink_to("program")
        stop.set()

    monkeypatch.setattr(training, "until_first_update", first_update)
    for path in (tmp_path, pathlib.Path()):
        with pytest.raises(CongraspError, match="is the folder"):
            warmup.warmup(export=path)
    with pytest.raises(CongraspError, match="given together"):
        warmup.warmup(export=file, source=file)
    assert not caches.exists()
    file = tmp_path / "new" / "caches.tar"
    assert warmup.warmup(export=file) == 0
    assert [path.name for path in file.parent.iterdir()] == ["caches.tar"]
    there = machine("b") / "caches"
    (there / "jax").mkdir(parents=True)
    (there / "jax/program").write_bytes(b"in use")
    assert warmup.warmup(source=file) == 0
    files = {
        str(path.relative_to(there)): path.read_bytes()
        for path in there.rglob("*")
        if path.is_file()
    }
    assert files == {"jax/program": b"in use", "warp/module/kernel.cubin": b"2"}


def _written(path, *members, manifest=None):
    """A file of caches with a manifest and these members, of which each is a name or a
    `TarInfo`.
    """
    text = json.dumps({"JAX": "1.2", "device": "GPU"} if manifest is None else manifest).encode()
    with tarfile.open(path, "w") as archive:
        about = tarfile.TarInfo("caches.json")
        about.size = len(text)
        archive.addfile(about, io.BytesIO(text))
        for member in members:
            archive.addfile(
                member if isinstance(member, tarfile.TarInfo) else tarfile.TarInfo(member)
            )
    return path


def _link(kind, target):
    link = tarfile.TarInfo("jax/link")
    link.type = kind
    link.linkname = target
    return link


@pytest.mark.parametrize(
    "member",
    [
        "jax/../../escaped",
        "jax//escaped",
        "jax",
        "jax/.",
        "jax/deeper/..",
        "/jax/escaped",
        "../jax/escaped",
        "elsewhere/escaped",
        _link(tarfile.SYMTYPE, "../../escaped"),
        _link(tarfile.LNKTYPE, "caches.json"),
        _link(tarfile.FIFOTYPE, ""),
    ],
    ids=lambda member: (
        member if isinstance(member, str) else f"{member.type.decode()}:{member.linkname}"
    ),
)
def test_only_files_in_the_folders_of_the_caches_are_written(machine, tmp_path, member):
    file = _written(tmp_path / "caches.tar", "jax/program", member)
    here = machine("a")
    with pytest.raises(CongraspError, match="no file of a cache"):
        cache_archive.import_caches(file)
    assert not here.exists()  # not even the members before it


def test_caches_of_other_versions_and_files_of_other_kinds_are_one_line(machine, tmp_path):
    machine("a")
    with pytest.raises(CongraspError, match=r"made for JAX '1.1', but this machine has 1.2"):
        cache_archive.import_caches(
            _written(tmp_path / "old.tar", manifest={"JAX": "1.1", "device": "GPU"})
        )
    (tmp_path / "text").write_text("no archive")
    other = [
        _written(tmp_path / f"{n}.tar", manifest=made_for)
        for n, made_for in enumerate(([], {}, "text"))
    ]
    with tarfile.open(tmp_path / "plain.tar", "w") as archive:
        archive.addfile(tarfile.TarInfo("jax/program"))
    for path in (tmp_path / "text", tmp_path / "plain.tar", *other):
        with pytest.raises(CongraspError, match="is not a file of caches, or is damaged"):
            cache_archive.import_caches(path)
    with pytest.raises(CongraspError, match=r"cannot be read: No such file"):
        cache_archive.import_caches(tmp_path / "missing.tar")
    with pytest.raises(CongraspError, match="cannot be read: Is a directory"):
        cache_archive.import_caches(tmp_path)
