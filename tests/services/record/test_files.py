"""Recordings survive: killed writers, full disks, cut and strange files, rotation."""

import errno
import functools
import io
import itertools
import json
import pathlib
import struct

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message, encode
from congrasp.services.export.layout import export_layout
from congrasp.services.record.episode_file import save_episode
from congrasp.services.record.reader import (
    log_files,
    read_episodes,
    read_metrics,
    read_records,
    read_rollouts,
)
from congrasp.services.record.writer import (
    CONVENTIONS,
    Entry,
    JsonChannels,
    LogWriter,
    opaque_channel,
)
from tests.children import python
from tests.episodes import episode
from tests.limits import limited
from tests.recordings import is_complete

SECOND = 10**9


def metric_entries(count: int, start: int = 0) -> list[Entry]:
    channels = JsonChannels()
    return [
        channels.entry(
            "/metrics/learner/0",
            i * SECOND,
            {"update": i, "values": {"kl": i / 10, "term": {"a": -i}}},
        )
        for i in range(start, start + count)
    ]


def updates(path: pathlib.Path) -> list[int]:
    return [json.loads(record.data)["update"] for record in read_records(path)]


def write(directory: pathlib.Path, entries: list[Entry], **options: float) -> list[pathlib.Path]:
    writer = LogWriter(directory, "log", run="r", **options)  # type: ignore[arg-type]
    for entry in entries:
        writer.write(entry)
    writer.close()
    return writer.files


doctor = functools.partial(python, "-m", "pymcap_cli.cli", "doctor", env={"COLUMNS": "400"})
"""Runs `pymcap-cli doctor`."""


def test_a_finished_file_is_sound_and_describes_its_fields(tmp_path: pathlib.Path) -> None:
    raw = Entry(
        opaque_channel("/rollout/a", "congrasp.Rollout"),
        5,
        encode(Message({"x": np.arange(3)}, {})),
    )
    (path,) = write(tmp_path, [*metric_entries(20), raw])
    assert path.suffix == ".mcap"
    assert is_complete(path)
    checked = doctor(path)
    assert checked.returncode == 0, checked.stdout
    assert "passed" in checked.stdout
    with path.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert metadata.metadata == {"run": "r", **CONVENTIONS}


def test_metrics_come_back_with_their_names(tmp_path: pathlib.Path) -> None:
    write(tmp_path, metric_entries(4))
    series = read_metrics(tmp_path)
    assert set(series) == {"learner/0/kl", "learner/0/term/a"}
    np.testing.assert_array_equal(series["learner/0/kl"][0], [0, 1, 2, 3])
    np.testing.assert_allclose(series["learner/0/term/a"][1], [0, -1, -2, -3])


def test_after_a_resume_the_later_value_of_an_update_counts(tmp_path: pathlib.Path) -> None:
    channels = JsonChannels()
    again = [
        channels.entry("/metrics/learner/0", 100 * SECOND, {"update": 2, "values": {"kl": 9.0}})
    ]
    write(tmp_path, metric_entries(4) + again)
    steps, values = read_metrics(tmp_path)["learner/0/kl"]
    np.testing.assert_array_equal(steps, [0, 1, 2, 3])
    np.testing.assert_allclose(values, [0, 0.1, 9.0, 0.3])


def test_rotation_by_age_and_by_size_keeps_everything(tmp_path: pathlib.Path) -> None:
    by_age = write(tmp_path / "age", metric_entries(25), max_seconds=9.5)
    assert [updates(path) for path in by_age] == [[*range(10)], [*range(10, 20)], [*range(20, 25)]]
    assert all(is_complete(path) for path in by_age)
    noise = np.random.default_rng(0)
    blob = opaque_channel("/rollout/a", "congrasp.Rollout")
    entries = [Entry(blob, i, noise.bytes(1 << 20)) for i in range(6)]
    by_size = write(tmp_path / "size", entries, max_bytes=2 << 20)
    assert len(by_size) >= 2
    records = itertools.chain(*map(read_records, log_files(tmp_path / "size")))
    assert [record.data for record in records] == [entry.data for entry in entries]


def test_entries_written_together_are_in_one_file(tmp_path: pathlib.Path) -> None:
    writer = LogWriter(tmp_path, "log", max_seconds=2.5)
    writer.write(*metric_entries(10))
    writer.write(*metric_entries(3, start=10))
    writer.close()
    assert [len(updates(path)) for path in writer.files] == [10, 3]


def test_writers_in_one_folder_leave_each_others_files_alone(tmp_path: pathlib.Path) -> None:
    """Two at once, and two more in the same second after them."""
    first = LogWriter(tmp_path, "log")
    second = LogWriter(tmp_path, "log")
    for count, writer in ((1, first), (2, second)):
        writer.write(*metric_entries(count))
    first.close()
    second.close()
    files = [
        *first.files,
        *second.files,
        *write(tmp_path, metric_entries(3)),
        *write(tmp_path, metric_entries(4)),
    ]
    assert [len(updates(path)) for path in files] == [1, 2, 3, 4]
    assert sorted(tmp_path.iterdir()) == sorted(files)


@settings(max_examples=30, deadline=None)
@given(share=st.floats(0, 1))
def test_a_file_cut_anywhere_gives_a_beginning(
    tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    path, _ = flushed_file(tmp_path_factory.mktemp("cut"))
    data = path.read_bytes()
    cut = path.with_name("cut.mcap.part")
    cut.write_bytes(data[: round(share * len(data))])
    read = updates(cut)
    assert read == [*range(len(read))]


class FullDisk(io.FileIO):
    """A file on a disk that has `room` bytes."""

    def __init__(self, path: pathlib.Path, room: int):
        super().__init__(path, "xb")
        self._room = room

    def write(self, data: object) -> int:
        size = memoryview(data).nbytes  # type: ignore[arg-type]
        if size > self._room:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._room -= size
        return super().write(data)  # type: ignore[arg-type]


def test_a_full_disk_is_an_error_and_keeps_what_was_flushed(tmp_path: pathlib.Path) -> None:
    writer = LogWriter(
        tmp_path, "log", open_file=lambda path: io.BufferedWriter(FullDisk(path, 20_000))
    )
    flushed = 0
    with pytest.raises(OSError, match="No space left"):
        for entry in metric_entries(5_000):
            writer.write(entry)
            if entry.time // SECOND % 10 == 9:
                writer.flush()
                flushed = entry.time // SECOND
    writer.abandon()
    assert flushed > 9
    assert updates(log_files(tmp_path)[0])[: flushed + 1] == [*range(flushed + 1)]


def test_an_episode_that_cannot_be_saved_leaves_no_file(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "grasp.mcap"
    folder.mkdir()
    with pytest.raises(CongraspError, match="could not be written"):
        save_episode(folder, "grasp", episode(3))
    assert list(tmp_path.iterdir()) == [folder]


def test_another_kind_of_file_is_refused(tmp_path: pathlib.Path) -> None:
    with pytest.raises(CongraspError, match="no recording"):
        log_files(tmp_path)
    (tmp_path / "a.mcap").write_text("a text")
    with pytest.raises(CongraspError, match=r"a\.mcap is not an MCAP file"):
        read_metrics(tmp_path)
    with pytest.raises(CongraspError, match="cannot be read"):
        list(read_records(tmp_path / "absent.mcap"))
    with pytest.raises(CongraspError, match=r"no file or folder .*absent\. Pass a run"):
        log_files(tmp_path / "absent")
    (tmp_path / "file").write_text("")
    with pytest.raises(CongraspError, match="cannot be created"):
        LogWriter(tmp_path / "file" / "logs", "log")


def flushed_file(
    directory: pathlib.Path, chunks: int = 5
) -> tuple[pathlib.Path, list[tuple[int, int]]]:
    """A finished file with three messages in each chunk, and where its chunks are."""
    writer = LogWriter(directory, "log")
    for entries in (metric_entries(3, 3 * i) for i in range(chunks)):
        writer.write(*entries)
        writer.flush()
    writer.close()
    with writer.files[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return writer.files[0], [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]


@pytest.mark.parametrize("damaged", [0, 2, 4])
@pytest.mark.parametrize("at", [-5, 32], ids=["contents", "uncompressed size"])
def test_reading_continues_after_a_damaged_chunk(tmp_path, damaged, at):
    path, chunks = flushed_file(tmp_path)
    data = bytearray(path.read_bytes())
    start, length = chunks[damaged]
    data[start + at % length] ^= 4
    path.write_bytes(data)
    notes: list[str] = []
    records = list(read_records(path, warn=notes.append))
    read = [json.loads(record.data)["update"] for record in records]
    assert read == [i for i in range(15) if i // 3 != damaged]
    assert {(record.topic, record.schema) for record in records} == {
        ("/metrics/learner/0", records[0].schema)
    }
    places = f"damaged in 1 place(s), at byte {start}; at least 3 message(s) were dropped."
    assert notes == [f"{path} is {places}"]


def test_dropped_chunks_are_warned_of_by_default(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, ((start, length), *_) = flushed_file(tmp_path)
    assert len(read_metrics(tmp_path)["learner/0/kl"][0]) == 15
    assert not caplog.messages
    data = path.read_bytes()
    path.write_bytes(data[: start + 9] + bytes(length) + data[start + 9 + length :])
    assert len(read_metrics(tmp_path)["learner/0/kl"][0]) == 12
    assert len(caplog.messages) == 1
    assert "damaged in 1 place(s)" in caplog.messages[0]


def test_a_chunk_is_read_whatever_its_opcode(tmp_path):
    path, ((start, _), *_) = flushed_file(tmp_path)
    data = bytearray(path.read_bytes())
    for opcode in range(256):
        data[start] = opcode
        path.write_bytes(data)
        assert updates(path) == list(range(15)), opcode


@settings(max_examples=150, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_costs_at_most_one_chunk_with_a_note(tmp_path_factory, place, bit):
    folder = tmp_path_factory.mktemp("flip")
    path, _ = flushed_file(folder)
    data = bytearray(path.read_bytes())
    at = 8 + int(place * (len(data) - 8))
    data[at] ^= 1 << bit
    path.write_bytes(data)
    notes: list[str] = []
    read = [json.loads(record.data)["update"] for record in read_records(path, warn=notes.append)]
    missing = sorted(set(range(15)) - set(read))
    assert read == sorted(set(read))
    assert len(missing) in (0, 3)
    assert not missing or (missing[0] % 3 == 0 and missing[-1] - missing[0] == 2)
    assert bool(missing) <= bool(notes)
    assert len(notes) <= 1


@settings(max_examples=60, deadline=None)
@given(
    wounds=st.lists(
        st.tuples(st.floats(0, 1), st.binary(max_size=60), st.integers(0, 60)),
        min_size=1,
        max_size=4,
    )
)
def test_overwritten_and_inserted_bytes_end_in_a_line_at_most(tmp_path_factory, wounds):
    path, _ = flushed_file(tmp_path_factory.mktemp("wounds"))
    data = path.read_bytes()
    for place, content, replaced in wounds:
        at = 8 + int(place * (len(data) - 8))
        data = data[:at] + content + data[at + replaced :]
    path.write_bytes(data)
    notes: list[str] = []
    read = [json.loads(record.data)["update"] for record in read_records(path, warn=notes.append)]
    assert read == sorted(set(read))
    assert set(read) <= set(range(15))
    assert len(notes) <= 1


def compressed_file(
    path: pathlib.Path, compression: CompressionType, messages: int = 30, size: int = 0
) -> pathlib.Path:
    """A finished file of metrics with a second between them, of several chunks."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression)
        writer.start()
        schema = writer.register_schema("metrics", "jsonschema", b"{}")
        channel = writer.register_channel("/metrics/learner/0", "json", schema)
        for i in range(messages):
            data = json.dumps({"update": i, "values": {"kl": 0.5}}).encode() + b" " * size
            writer.add_message(channel, (i + 1) * SECOND, data, (i + 1) * SECOND)
        writer.finish()
    return path


COMPRESSED = [CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE]


@pytest.mark.parametrize("compression", COMPRESSED)
def test_every_compression_is_read(tmp_path, compression):
    path = compressed_file(tmp_path / "a.mcap", compression, size=200)
    notices: list[str] = []
    records = list(read_records(path, warn=notices.append))
    assert [json.loads(record.data)["update"] for record in records] == [*range(30)]
    assert not notices


@pytest.mark.parametrize("compression", COMPRESSED[:2])
def test_a_damaged_chunk_of_any_compression_is_dropped(tmp_path, compression):
    path = compressed_file(tmp_path / "a.mcap", compression, size=200)
    with path.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[1]
    data = bytearray(path.read_bytes())
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 20] = bytes(20)
    path.write_bytes(data)
    notices: list[str] = []
    records = list(read_records(path, warn=notices.append))
    assert 20 < len(records) < 30
    assert len(notices) == 1
    assert "damaged in 1 place" in notices[0]


def notices_of(path: pathlib.Path) -> list[str]:
    """Warnings about a file."""
    notices: list[str] = []
    for _ in read_records(path, warn=notices.append):
        pass
    return notices


def bomb(path: pathlib.Path, compression: str, claimed: int, actual: int, chunks: int) -> None:
    """A file of chunks that inflate to `actual` zeros, and claim another size."""
    compress = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    data = compress(bytes(actual))
    head = struct.pack("<QQQI", SECOND, SECOND, claimed, 0)
    name = struct.pack("<I", len(compression)) + compression.encode()
    record = head + name + struct.pack("<Q", len(data)) + data
    path.write_bytes(
        MCAP0_MAGIC + (struct.pack("<BQ", 6, len(record)) + record) * chunks + MCAP0_MAGIC
    )


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("claimed", [1 << 40, 1 << 10])
def test_a_chunk_of_another_size_is_dropped(tmp_path, compression, claimed):
    bomb(tmp_path / "a.mcap", compression, claimed, 64 << 20, 1)
    notice = limited(notices_of, tmp_path / "a.mcap", memory=300 << 20)
    assert "damaged in 1 place" in notice


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_file_that_inflates_without_end_is_refused(tmp_path, compression):
    bomb(tmp_path / "a.mcap", compression, 64 << 20, 64 << 20, 4)
    with pytest.raises(CongraspError, match=r"a\.mcap cannot be read"):
        list(read_records(tmp_path / "a.mcap", warn=lambda text: None))


def test_an_unknown_compression_is_damage(tmp_path):
    bomb(tmp_path / "a.mcap", "lz4", 1 << 10, 1 << 10, 1)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data.replace(b"lz4", b"xyz"))
    notices: list[str] = []
    assert not list(read_records(tmp_path / "a.mcap", warn=notices.append))
    assert len(notices) == 1


READERS = {
    "records": lambda path: list(read_records(path)),
    "metrics": read_metrics,
    "episodes": lambda path: list(read_episodes(path)),
    "rollouts": lambda path: list(read_rollouts(path)),
    "layout": lambda path: export_layout(path, path.with_name("layout.json")),
}


@pytest.mark.parametrize("compression", COMPRESSED)
@pytest.mark.parametrize("reader", READERS)
def test_a_file_without_its_end_is_named(tmp_path, compression, reader, caplog):
    path = compressed_file(tmp_path / "a.mcap", compression, size=200)
    READERS[reader](path)
    assert not caplog.messages
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    READERS[reader](path)
    assert len(caplog.messages) == 1
    line = caplog.messages[0]
    assert str(path) in line
    assert "not finished" in line
    assert " s or more may be missing" in line


def test_the_seconds_of_a_cut_chunk_are_counted(tmp_path):
    path = compressed_file(tmp_path / "a.mcap", CompressionType.ZSTD, size=200)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    second = chunks[1]
    path.write_bytes(path.read_bytes()[: second.chunk_start_offset + second.chunk_length // 2])
    notices: list[str] = []
    list(read_records(path, warn=notices.append))
    lost = (second.message_end_time - chunks[0].message_end_time) / SECOND
    assert lost > 2
    assert f"{lost:.1f} s" in notices[0]
