"""Recordings survive: killed writers, full disks, cut and strange files, rotation."""

import errno
import functools
import io
import json
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message, encode
from congrasp.services.record.reader import log_files, read_metrics, read_records
from congrasp.services.record.writer import (
    CONVENTIONS,
    Entry,
    JsonChannels,
    LogWriter,
    opaque_channel,
)
from tests.children import python
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


def test_a_finished_file_is_sound_and_says_what_its_numbers_mean(tmp_path: pathlib.Path) -> None:
    raw = Entry(
        opaque_channel("/rollout/a", "congrasp.Rollout"),
        5,
        encode(Message({"x": np.arange(3)}, {})),
    )
    (path,) = write(tmp_path, [*metric_entries(20), raw])
    assert path.suffix == ".mcap" and is_complete(path)
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
    assert [r.data for path in log_files(tmp_path / "size") for r in read_records(path)] == [
        e.data for e in entries
    ]


def test_what_belongs_together_is_not_split_over_files(tmp_path: pathlib.Path) -> None:
    writer = LogWriter(tmp_path, "log", max_seconds=2.5)
    writer.write(*metric_entries(10))
    writer.write(*metric_entries(3, start=10))
    writer.close()
    assert [len(updates(path)) for path in writer.files] == [10, 3]


def test_writers_in_one_folder_leave_each_others_files_alone(tmp_path: pathlib.Path) -> None:
    """Two at once, and two more in the same second after them."""
    first, second = LogWriter(tmp_path, "log"), LogWriter(tmp_path, "log")
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
    assert [len(updates(path)) for path in files] == [1, 2, 3, 4] and sorted(
        tmp_path.iterdir()
    ) == sorted(files)


@settings(max_examples=30, deadline=None)
@given(share=st.floats(0, 1))
def test_a_file_cut_anywhere_gives_a_beginning(
    tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    path, _ = flushed_file(tmp_path_factory.mktemp("cut"))
    whole, cut = path.read_bytes(), path.with_name("cut.mcap.part")
    cut.write_bytes(whole[: round(share * len(whole))])
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


def test_what_is_no_recording_is_refused(tmp_path: pathlib.Path) -> None:
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
def test_after_a_damaged_chunk_reading_goes_on_and_says_what_was_dropped(tmp_path, damaged, at):
    path, chunks = flushed_file(tmp_path)
    data, (start, length) = bytearray(path.read_bytes()), chunks[damaged]
    data[start + at % length] ^= 4
    path.write_bytes(data)
    said: list[str] = []
    records = list(read_records(path, warn=said.append))
    read = [json.loads(record.data)["update"] for record in records]
    assert read == [i for i in range(15) if i // 3 != damaged]
    assert {(record.topic, record.schema) for record in records} == {
        ("/metrics/learner/0", records[0].schema)
    }
    places = f"damaged in 1 place(s), at byte {start}; at least 3 message(s) were dropped."
    assert said == [f"{path} is {places}"]


def test_what_was_dropped_is_warned_of_by_default(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, ((start, length), *_) = flushed_file(tmp_path)
    assert len(read_metrics(tmp_path)["learner/0/kl"][0]) == 15 and not caplog.messages
    data = path.read_bytes()
    path.write_bytes(data[: start + 9] + bytes(length) + data[start + 9 + length :])
    assert len(read_metrics(tmp_path)["learner/0/kl"][0]) == 12
    assert len(caplog.messages) == 1 and "damaged in 1 place(s)" in caplog.messages[0]


@settings(max_examples=150, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_one_flipped_bit_costs_one_chunk_at_most_and_never_without_a_word(
    tmp_path_factory, place, bit
):
    folder = tmp_path_factory.mktemp("flip")
    path, _ = flushed_file(folder)
    data = bytearray(path.read_bytes())
    at = 8 + int(place * (len(data) - 8))
    data[at] ^= 1 << bit
    path.write_bytes(data)
    said: list[str] = []
    read = [json.loads(record.data)["update"] for record in read_records(path, warn=said.append)]
    missing = sorted(set(range(15)) - set(read))
    assert read == sorted(set(read)) and len(missing) in (0, 3)
    assert not missing or (missing[0] % 3 == 0 and missing[-1] - missing[0] == 2)
    assert bool(missing) <= bool(said) and len(said) <= 1


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
    said: list[str] = []
    read = [json.loads(record.data)["update"] for record in read_records(path, warn=said.append)]
    assert read == sorted(set(read)) and set(read) <= set(range(15)) and len(said) <= 1
