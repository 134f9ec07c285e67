"""JSON, BVH, CSV and MCAP files of others: limits of size and depth, and errors of one line."""

import os

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.wire.codec import Message, encode
from congrasp.services.grasp import wrist_paths
from congrasp.services.record.reader import (
    metrics_of,
    pick_episode,
    read_episodes,
    read_metrics,
    read_records,
)
from congrasp.services.record.scene import EPISODE_SCHEMA
from congrasp.services.record.writer import Entry, JsonChannels, LogWriter, opaque_channel
from tests.episodes import episode

BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT RightHand
 {
  OFFSET 1 0 0
  CHANNELS 3 Zrotation Xrotation Yrotation
 }
}
MOTION
Frames: 2
Frame Time: 0.01
0 0 0 0 0 0 0 0 0
1 0 0 0 0 0 0 0 0
"""


def refused(function, path, why):
    with pytest.raises(CongraspError, match=why) as caught:
        result = function(path)
        list(result) if hasattr(result, "__next__") else None
    assert len(str(caught.value)) < 1000 and str(caught.value).isprintable()


def test_json_is_of_bounded_size_and_depth(tmp_path):
    path = tmp_path / "x.json"
    for text in ("[" * 100_000, "{", ""):
        path.write_text(text)
        refused(lambda path: read_json(path, 10**6), path, "is not JSON")
    path.write_text("[" + "1," * 2000 + "1]")
    refused(lambda path: read_json(path, 1000), path, "4003 bytes; the limit is 1000")
    assert len(read_json(path, 5000)) == 2001
    path.write_bytes(b'"\xff"')
    refused(lambda path: read_json(path, 1000), path, "is not JSON")
    os.mkfifo(pipe := tmp_path / "pipe.json")
    refused(lambda path: read_json(path, 1000), pipe, "not a regular file")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("CHANNELS 3 Zrotation", "CHANNELS 999999999 Zrotation"),
        ("CHANNELS 3 Zrotation", "CHANNELS -3 Zrotation"),
        ("Zrotation Xrotation Yrotation\n }", "Qrotation Xrotation Yrotation\n }"),
        ("Xposition", "Qposition"),
        ("OFFSET 1 0 0", "OFFSET 1 0"),
        ("Frames: 2", "Frames: 999999999999"),
        ("Frame Time: 0.01", "Frame Time: nan"),
        ("\n1 0 0", "\nnan 0 0"),
        ("{\n OFFSET", "{\n" * 300 + " OFFSET"),
        ("}\n}", "}\n}\n}\n}"),
        ("Frame Time: 0.01", ""),
    ],
)
def test_a_bvh_that_is_none_is_one_line(tmp_path, before, after):
    path = tmp_path / "x.bvh"
    path.write_text(BVH)
    assert wrist_paths.read_bvh(path, "RightHand")[0].shape == (2, 3)
    assert before in BVH
    path.write_text(BVH.replace(before, after))
    refused(lambda path: wrist_paths.read_bvh(path, "RightHand"), path, "cannot be read as BVH")


def test_motions_of_others_are_of_bounded_size(tmp_path, monkeypatch):
    monkeypatch.setattr(wrist_paths, "_LARGEST", 100)
    for name in ("x.bvh", "x.csv"):
        (tmp_path / name).write_text("0,0,0,1,0,0,0\n" * 20)
        refused(wrist_paths.read_wrist_path, tmp_path / name, "bytes; the limit is 100")


def _recording(folder, *entries):
    writer = LogWriter(folder, "log")
    writer.write(*entries)
    writer.close()
    return writer.files[0]


def test_recordings_of_others_are_one_line(tmp_path):
    channel = JsonChannels().entry("/metrics/learner/0", 1, {"values": {"x": 1.0}}).channel
    for number, data in enumerate((b"{", b"[" * 10**5, b"[]", b"{}", b'{"values": 7}', b'{"values": {"x": "y"}}',
                                   b'{"values": {}, "update": "z"}')):  # fmt: skip
        path = _recording(tmp_path / str(number), Entry(channel, 1, data))
        refused(read_metrics, path, "is not JSON|has no metrics")
        (record,) = read_records(path)
        refused(lambda path, record=record: metrics_of(record), path, "A record of '/metrics/learner/0'")
    raw = opaque_channel("/episode/a/raw", EPISODE_SCHEMA)
    whole = episode()
    for number, (change, why) in enumerate((
        ({"hand": "/etc/hosts.json"}, "not a hand that a message can name"),
        ({"success": None}, "'success' is None"),
        ({"metrics": []}, r"'metrics' is \[\]"),
    )):  # fmt: skip
        data = encode(Message(whole.arrays, {**whole.meta, **change}))
        path = _recording(tmp_path / f"e{number}", Entry(raw, 1, data))
        refused(read_episodes, path, why)
        refused(lambda path: pick_episode(path, -1), path, why)
    lost = {name: array for name, array in whole.arrays.items() if name != "visual_faces"}
    path = _recording(tmp_path / "lost", Entry(raw, 1, encode(Message(lost, whole.meta))))
    refused(read_episodes, path, "lacks the array 'visual_faces'")
    path = _recording(tmp_path / "fine", Entry(raw, 1, encode(whole)))
    np.testing.assert_array_equal(next(read_episodes(path)).arrays["q"], whole.arrays["q"])
