"""Mutated messages at every key, and mutated files at every loader: no traceback, no growth, no
hang.

Each takes half of `CONGRASP_FUZZ_SECONDS`, 4 by default, from the seed `CONGRASP_FUZZ_SEED`, 0 by
default:

    CONGRASP_FUZZ_SECONDS=600 pytest tests/e2e/test_fuzz.py -n 0
"""

import contextlib
import io
import json
import logging
import os
import pathlib
import pickle
import random
import threading
import time
import zlib

import numpy as np
import pytest
import trimesh

from congrasp.common.config import NetworkConfig, RunConfig, run_config_from_json, to_json
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text, read_hand
from congrasp.common.io.journal import Journal, read_journal
from congrasp.common.io.pickles import read_pickle
from congrasp.common.objects import store
from congrasp.common.objects.procedural import generate
from congrasp.common.policy import bundle as bundles
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling import set_file
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.learner.hub.task_ranges import Ranges
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.grasp.bvh import read_bvh
from congrasp.services.grasp.wrist_paths import read_wrist_path
from congrasp.services.record.converter import Converter
from congrasp.services.record.reader import read_episodes, read_metrics
from congrasp.services.record.recorder import Recorder
from congrasp.services.record.writer import LogWriter
from congrasp.services.serve.requests import Layout
from congrasp.services.serve.server import parse_timeout
from congrasp.services.train.command import untrained
from tests.episodes import episode, episode_message
from tests.rollouts import bundle, learner_hub, rollout
from tests.services.test_hostile_files import BVH, constraint_set

SECONDS = float(os.environ.get("CONGRASP_FUZZ_SECONDS", "4")) / 2
SEED = int(os.environ.get("CONGRASP_FUZZ_SEED", "0"))
KEYS = Keys("chaos")
FORM = RolloutForm(3, 2, 32, 4, half=True)
GROWTH = 150 << 20  # bytes of memory
LONGEST = 20.0  # seconds of one message or file
pytestmark = pytest.mark.timeout(240 + 2 * SECONDS)
ODD = [
    None,
    True,
    -1,
    0,
    2**53,
    10**30,
    1e300,
    0.5,
    "",
    "x" * 70_000,
    "../../etc/passwd",
    "/dev/zero",
    "a.json",
    "{",
    "\ud800",
    "\x1b[2J",
    "*",
    "a/b",
    [],
    [[]],
    ["x"] * 1000,
    {},
    {"a": {"b": {}}},
]
DTYPES = ["f2", "f4", "f8", "i4", "i8", "u1", "?"]


def odd_tree(rng, tree):
    """A JSON value with one place of it replaced, dropped or doubled."""
    if isinstance(tree, (dict, list)) and tree and rng.random() < 0.8:
        changed = dict(tree) if isinstance(tree, dict) else list(tree)
        at = rng.choice(list(changed) if isinstance(changed, dict) else range(len(changed)))
        if rng.random() < 0.1:
            del changed[at]
        else:
            changed[at] = odd_tree(rng, changed[at])
        return changed
    return rng.choice(ODD)


def odd_array(rng, array):
    """An array of another shape, dtype or with other values."""
    kind = rng.randrange(5)
    if kind == 0:
        return np.zeros(
            [rng.choice([0, 1, 2, 7, 99]) for _ in range(rng.randrange(4))], rng.choice(DTYPES)
        )
    if kind == 1:
        with np.errstate(all="ignore"):
            return np.asarray(array).astype(rng.choice(DTYPES))
    if kind == 2:
        return np.asarray(array)[..., None]
    changed = np.array(array)
    if changed.size:
        worst = (
            [np.nan, np.inf, -3e38, 65504.0, 1e19, 0.0, -1.0]
            if changed.dtype.kind == "f"
            else [0, 1, 127]
        )
        changed.reshape(-1)[rng.randrange(changed.size)] = np.asarray(rng.choice(worst)).astype(
            changed.dtype
        )
    return changed


def odd_bytes(rng, data):
    """Bytes with flips, cuts, doubled parts and noise."""
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        at = (
            rng.randrange(len(changed) + 1)
            if rng.random() < 0.5
            else rng.randrange(min(2000, len(changed)) + 1)
        )
        kind = rng.randrange(5)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del changed[at:]
        elif kind == 2:
            changed[at:at] = changed[at : at + rng.randrange(64)]
        elif kind == 3:
            noise = rng.choice(
                [b"9" * 9, b"-1", b"1e99", b"null", b"[[[[", b'"', b"NaN", b"\xff" * 8, b"\0" * 8]
            )
            changed[at : at + len(noise)] = noise
        else:
            changed[at : at + rng.randrange(16)] = rng.randbytes(rng.randrange(16))
    return bytes(changed)


def mutated(rng, message):
    """The bytes of a message with something odd in it, whose checksum is mostly right."""
    arrays = dict(message.arrays)
    meta = dict(message.meta)
    with contextlib.suppress(CongraspError, ValueError, OverflowError, UnicodeEncodeError):
        for _ in range(rng.randrange(3)):
            meta = odd_tree(rng, meta)
            meta = meta if isinstance(meta, dict) else {}
        if arrays and rng.random() < 0.5:
            name = rng.choice(list(arrays))
            arrays[rng.choice([name, name, "made/up", "episode/" + "x" * 300])] = odd_array(
                rng, arrays.pop(name)
            )
        data = encode(Message(arrays, meta))
        return data if rng.random() < 0.7 else odd_bytes(rng, data)
    return odd_bytes(rng, encode(message))


@contextlib.contextmanager
def no_tracebacks():
    """Fails if anything is logged with a traceback, or a thread dies, while the block runs."""
    tracebacks = []

    class Handler(logging.Handler):
        def emit(self, record):
            if record.exc_info:
                tracebacks.append(f"{record.getMessage()}: {record.exc_info[1]!r}")

    handler = Handler()
    before = threading.excepthook
    logging.getLogger().addHandler(handler)
    threading.excepthook = lambda arguments: tracebacks.append(repr(arguments.exc_value))
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        threading.excepthook = before
    assert not tracebacks, tracebacks[:3]


def memory():
    """Bytes that this process has in memory."""
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


# --- messages ---


def requests():
    """A valid message for every key that is asked, and for every one that is published under."""
    who = {"actor": "NAME", "incarnation": "01"}
    sample_rollout = rollout(0.5, FORM, **who, sequence=0, run_id="e", ticket="t")
    named = {**sample_rollout.arrays, "episode/success": np.ones(1, np.float32)}
    queries = {
        KEYS.config: Message(),
        KEYS.status: Message(),
        KEYS.weights: Message(meta={"newer_than": 3, "session_id": "x"}),
        KEYS.ticket("NAME"): Message(meta={**who, "ticket": "t", "give_back": False}),
        KEYS.rollout("NAME"): Message(named, sample_rollout.meta),
        KEYS.act: Message({"packed": np.zeros((2, LAYOUT.size), np.float32)}, QUERY),
        KEYS.health: Message(),
    }
    publications = {
        KEYS.log("metrics", "actor", "NAME"): Message(
            meta={"time": 1.0, "update": 1, "values": {"a/b": 1.0, "c": 2}}
        ),
        KEYS.log("event", "actor", "NAME"): Message(
            meta={"time": 1.0, "level": "info", "text": "x"}
        ),
        KEYS.log("version", "actor", "NAME"): Message(meta={"version": 1, "run_id": "e"}),
        KEYS.log("episode", "actor", "NAME"): episode_message(3),
        KEYS.log("rollout", "actor", "NAME"): Message(named, {"actor": "a", "version": 1}),
        KEYS.log("odd", "actor", "NAME"): Message(),
        KEYS.announcement: Message(
            meta={"version": 1, "run_id": "e", "session_id": "x", "finished": False}
        ),
    }
    return list(queries.items()), list(publications.items())


LAYOUT = Layout(get_hand("human"), TaskConfig(surface_points=8, trajectory_points=3))
QUERY = {"constraints": ["heading"], "layout": LAYOUT.digest, "timeout": 1.0}


@contextlib.contextmanager
def served(endpoint, folder):
    """Everything that listens: a learner's hub, what a policy server makes of a query, and a
    recorder.
    """

    def act(key, request):
        parse_timeout(request.meta.get("timeout", 1.0))
        LAYOUT.parse(request)
        return Message()

    ranges = Ranges(np.full(32, 1.0), 10.0, 100.0, {"episode/success": (0.0, 1.0)})
    with ZenohTransport(listen=[endpoint]) as transport:
        staleness = StalenessManager(1, 2, ticket_seconds=1.0)
        hub, rollouts = learner_hub(
            transport, "chaos", form=FORM, staleness=staleness, admission=Admission(lambda: ranges)
        )
        hub.publish_weights(bundle(0), 0)
        transport.serve(KEYS.act, act, workers=2, depth=64)
        transport.serve(KEYS.health, lambda key, request: Message(meta={"ready": True}))
        with Recorder(transport, "chaos", folder, warn=lambda text: None) as recorder:
            yield hub, rollouts, recorder


def test_mutated_messages_at_every_key(tmp_path):
    rng = random.Random(SEED)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    queries, publications = requests()
    with (
        no_tracebacks(),
        served(endpoint, tmp_path) as (hub, rollouts, recorder),
        ZenohTransport(connect=[endpoint]) as raw,
    ):
        began = time.monotonic()
        first = 0
        sent = 0
        while (now := time.monotonic()) < began + SECONDS:
            key, message = rng.choice(queries if rng.random() < 0.7 else publications)
            name = f"{rng.randrange(2000)}.x"
            meta = {k: name if v == "NAME" else v for k, v in message.meta.items()}
            session = raw.session(key)
            data, key = mutated(rng, Message(message.arrays, meta)), key.replace("NAME", name)
            if "/log/" in key or "announce" in key:
                session.put(key, data, attachment=rng.choice([None, b"", rng.randbytes(16)]))
            else:
                answers = list(session.get(key, payload=data, timeout=LONGEST))
                assert time.monotonic() - now < 2 * LONGEST, key
                for answer in answers:
                    text = b"" if answer.ok else answer.err.payload.to_bytes()
                    assert b"failed on" not in text, (
                        key,
                        text,
                    )
                    assert len(text) < 1500, (
                        key,
                        text,
                    )
                    assert b"\n" not in text, (
                        key,
                        text,
                    )
            sent += 1
            if sent % 50 == 0:
                token_key = f"congrasp/chaos/alive/{rng.choice(['actor', 'server'])}/{name}/x"
                token = raw.session(KEYS.status).liveliness().declare_token(token_key)
                token.undeclare() if rng.random() < 0.5 else None
                assert hub.status()["run"] == "chaos"
            if not first and time.monotonic() > began + SECONDS / 3:
                first = memory()
            while len(list(tmp_path.glob("*.mcap"))) > 2:
                next(tmp_path.glob("*.mcap")).unlink()
        assert memory() - first < GROWTH, (
            f"grew by {(memory() - first) >> 20} MiB in {sent} messages"
        )
        # An honest one is served as ever.
        rollouts.next_batch(2, 0.0)
        hub.publish_weights(bundle(1), 1)
        fine = Message(meta={"actor": "77777.a", "incarnation": "1", "ticket": "t"})
        assert raw.query(KEYS.ticket("77777.a"), fine, timeout=10.0).meta["version"] == 1
        raw.query(
            KEYS.act,
            Message({"packed": np.zeros((2, LAYOUT.size), np.float32)}, QUERY),
            timeout=10.0,
        )
        assert not recorder.error
        assert recorder.messages
        assert recorder.damaged
    print(
        f"{sent} messages, {recorder.messages} log messages recorded, {recorder.damaged} left out"
    )


# --- files ---

SEALED = {"object": store.load, "set": set_file.load, "policy": bundles.load}
"""Loaders of messages with a checksum."""


def resealed(data):
    """The message with the checksum of its damaged data, as one who means harm would write it."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        section = data[8 + length :]
        header = {
            "__metadata__": {"checksum": "00000000", "meta": header.pop("__metadata__")["meta"]},
            **header,
        }
        text = json.dumps(header, separators=(",", ":")).encode()
        text = text.replace(b"00000000", b"%08x" % zlib.crc32(text, zlib.crc32(section)), 1)
        return len(text).to_bytes(8, "little") + text + section
    return data


def odd_file(rng, name, data):
    """A file with something odd in it, whose checksum is mostly right."""
    if rng.random() < 0.5:
        changed = odd_bytes(rng, data)
        return resealed(changed) if name in SEALED else changed
    if name in ("config", "hand"):
        return json.dumps(odd_tree(rng, json.loads(data))).encode()
    if name == "motion":
        arrays = dict(np.load(io.BytesIO(data)))
        np.savez(
            made := io.BytesIO(),
            **{**arrays, "meta": json.dumps(odd_tree(rng, json.loads(str(arrays["meta"]))))},
        )
        return made.getvalue()
    return mutated(rng, decode(data)) if name in SEALED else odd_bytes(rng, data)


def _files(folder):
    """A valid file for every loader, and the loader."""
    store.save(generate(0, "box"), folder / "object")
    (folder / "set").write_bytes(encode(constraint_set()))
    network = NetworkConfig(hidden=(2,), encoder=2)
    task = TaskConfig(surface_points=4, trajectory_points=2)
    bundles.save(untrained(RunConfig(task=task, network=network)), folder / "policy")
    (folder / "hand").write_text(hand_text(get_hand("human")))
    save_motion(folder / "motion", episode().normalised())
    (folder / "config").write_text(to_json(RunConfig()))
    (folder / "x.bvh").write_text(BVH)
    (folder / "x.csv").write_text("x,y,z,qw,qx,qy,qz\n" + "0,0,0,1,0,0,0\n" * 3)
    np.savez(
        folder / "x.npz", position=np.zeros((2, 3)), quaternion=np.tile([1.0, 0, 0, 0], (2, 1))
    )
    (folder / "pickle").write_bytes(pickle.dumps({"a": [1, "x", np.zeros(3)], "b": (None, 2.5)}, 4))
    journal = Journal(folder / "journal")
    for i in range(5):
        journal.write(actor="a", made=i)
    journal.close()
    writer = LogWriter(folder, "log")
    convert = Converter()
    for key, message in requests()[1][:4]:
        writer.write(*convert(key.replace("NAME", "a"), message, 10**18))
    writer.close()
    writer.files[0].rename(folder / "x.mcap")
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    for suffix in ("stl", "obj", "ply", "glb"):
        mesh.export(folder / f"x.{suffix}")
    everything = {
        **SEALED,
        "hand": read_hand,
        "motion": load_motion,
        "config": lambda path: run_config_from_json(path.read_bytes()),
        "x.bvh": lambda path: read_bvh(path, "RightHand"),
        "x.csv": read_wrist_path,
        "x.npz": read_wrist_path,
        "pickle": read_pickle,
        "journal": read_journal,
        "x.mcap": lambda path: (read_metrics(path), list(read_episodes(path))),
        **dict.fromkeys(("x.stl", "x.obj", "x.ply", "x.glb"), read_mesh),
    }
    return {folder / name: load for name, load in everything.items()}


def test_mutated_files_at_every_loader(tmp_path):
    rng = random.Random(SEED)
    loaders = _files(tmp_path)
    valid = {path: path.read_bytes() for path in loaders}
    for path, load in loaders.items():
        load(path)
    # A process reads each pickle
    often = [0.1 if path.name == "pickle" else 1.0 for path in loaders]
    began = time.monotonic()
    first = 0
    count = 0
    refused = 0
    with no_tracebacks():
        while (now := time.monotonic()) < began + SECONDS or count < 50 * len(loaders):
            (path,) = rng.choices(list(loaders), often)
            data = odd_file(rng, path.name, valid[path])
            path.write_bytes(data)
            try:
                loaders[path](path)
            except CongraspError as error:
                refused += 1
                assert "\n" not in str(error)
                assert len(str(error)) < 3000
            except Exception as error:
                failures = tmp_path / "failed"
                failures.write_bytes(data)
                raise AssertionError(
                    f"{path.name}, seed {SEED}, number {count}: {error!r}, see {failures}"
                ) from error
            assert time.monotonic() - now < LONGEST, path.name
            count += 1
            if not first and time.monotonic() > began + SECONDS / 3:
                first = memory()
    assert memory() - first < GROWTH, f"grew by {(memory() - first) >> 20} MiB in {count} files"
    assert refused > count / 10
    print(f"{count} files, {refused} refused")
