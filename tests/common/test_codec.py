"""The wire format: round trips, agreement with the safetensors library, and damage."""

import json
import struct

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from common.errors import CongraspError
from common.wire.codec import Message, decode, encode

dtypes = st.sampled_from(["?", "u1", "i1", "<i2", "<f2", "<i4", "<f4", "<i8", "<f8"])
arrays = dtypes.flatmap(lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)))
names = st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=8)
MESSAGE = Message({"a/b": np.arange(6, dtype=np.float32).reshape(2, 3), "c": np.array([True, False])}, {"x": [1, "y"]})


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(names, arrays, max_size=4), st.dictionaries(names, st.integers(), max_size=3))
def test_round_trip(named, meta):
    back = decode(encode(Message(named, meta)))
    assert back.meta == meta
    assert list(back.arrays) == list(named)
    for name, array in named.items():
        assert back.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(back.arrays[name], array)


def test_the_library_reads_what_we_write():
    loaded = safetensors.numpy.load(encode(MESSAGE))
    for name, array in MESSAGE.arrays.items():
        np.testing.assert_array_equal(loaded[name], array)


def test_non_contiguous_arrays_arrive_in_order():
    array = np.arange(12, dtype=np.float32).reshape(3, 4).T
    np.testing.assert_array_equal(decode(encode(Message({"a": array}, {}))).arrays["a"], array)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damage_never_goes_unnoticed(data):
    whole = encode(MESSAGE)
    position = data.draw(st.integers(0, len(whole) - 1))
    flipped = bytearray(whole)
    flipped[position] ^= 1 << data.draw(st.integers(0, 7))
    try:
        back = decode(bytes(flipped))
    except CongraspError:
        return
    # A flipped bit that changes neither names, shapes nor data can only sit in the metadata or in padding.
    assert position < 8 + struct.unpack("<Q", whole[:8])[0]
    for name, array in back.arrays.items():
        assert array.tobytes() in {a.tobytes() for a in MESSAGE.arrays.values()}, name


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_every_truncation_is_an_error(cut):
    whole = encode(MESSAGE)
    with pytest.raises(CongraspError):
        decode(whole[: cut % len(whole)])


def _with_header(header: dict, body: bytes) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04" + b"\0" * 40,
        struct.pack("<Q", 1 << 62) + b"{}",
        _with_header({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4),
        _with_header({"__metadata__": {"meta": "[]", "crc32": "0"}}, b""),
        _with_header(
            {"__metadata__": {"meta": "{}", "crc32": "0"}, "a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}},
            b"\0" * 4,
        ),
        _with_header(
            {"__metadata__": {"meta": "{}", "crc32": "0"}, "a": {"dtype": "OBJ", "shape": [1], "data_offsets": [0, 4]}},
            b"\0" * 4,
        ),
    ],
)
def test_hostile_bytes_are_refused_in_words(data):
    with pytest.raises(CongraspError, match="message"):
        decode(data)


def test_too_large_is_refused_before_it_is_read():
    with pytest.raises(CongraspError, match="more than the 10"):
        decode(encode(MESSAGE), max_bytes=10)


def test_objects_cannot_be_encoded():
    with pytest.raises(CongraspError, match="'bad'"):
        encode(Message({"bad": np.array([object()])}, {}))
