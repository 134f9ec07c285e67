"""The wire format: compatible with safetensors, exact, and closed to damaged bytes."""

import json
import zlib

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
import zstandard
from hypothesis import given, settings

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import (
    MAX_HEADER,
    CompressedMessage,
    Message,
    SharedMessage,
    decode,
    encode,
)

DTYPES = ["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?"]
arrays = st.dictionaries(
    st.text(min_size=1, max_size=8).filter(lambda name: name != "__metadata__"),
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: hnp.arrays(
            np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)
        )
    ),
    max_size=5,
)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)
metas = st.dictionaries(st.text(), json_values, max_size=4)


def packed(header, section=b"", *, crc=None, **metadata):
    """Bytes with any header; the checksum of section and header is right unless given."""
    metadata = {"checksum": "00000000", "meta": "{}", **metadata}
    text = json.dumps({"__metadata__": metadata, **header}, separators=(",", ":")).encode()
    crc = f"{zlib.crc32(text, zlib.crc32(section)):08x}" if crc is None else crc
    text = text.replace(b"00000000", crc.encode(), 1)
    return len(text).to_bytes(8, "little") + text + section


def entry(dtype="F32", shape=(2,), offsets=(0, 8)):
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


def assert_equal(left, right):
    assert left.meta == right.meta
    assert left.arrays.keys() == right.arrays.keys()
    for name, array in left.arrays.items():
        assert right.arrays[name].dtype == array.dtype
        assert right.arrays[name].shape == array.shape
        assert right.arrays[name].tobytes() == np.ascontiguousarray(array).tobytes()


@settings(deadline=None, max_examples=40)
@given(arrays, metas)
def test_round_trip_is_exact(arrays, meta):
    message = Message(arrays, meta)
    assert_equal(message, decode(encode(message)))


@settings(deadline=None, max_examples=30)
@given(arrays, metas)
def test_safetensors_reads_what_encode_writes(arrays, meta):
    read = safetensors.numpy.load(encode(Message(arrays, meta)))
    assert_equal(Message(arrays), Message(read))


def test_decode_reads_what_safetensors_writes():
    written = {
        "w": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b": np.array([True, False]),
        "n": np.float64(3),
    }
    written = {name: np.asarray(array) for name, array in written.items()}
    plain = safetensors.numpy.save(written)
    length = int.from_bytes(plain[:8], "little")
    header = json.loads(plain[8 : 8 + length])
    assert_equal(
        Message(written, {"a": 1}), decode(packed(header, plain[8 + length :], meta='{"a": 1}'))
    )
    with pytest.raises(CongraspError, match="does not begin with its checksum"):
        decode(plain)


def test_arrays_are_read_only_views_of_the_message():
    data = encode(Message({"x": np.arange(5.0)}))
    array = decode(data).arrays["x"]
    assert not array.flags.writeable
    assert np.shares_memory(array, np.frombuffer(data, np.uint8))


def test_any_memory_layout_is_written_in_order():
    x = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    message = Message(
        {
            "t": x.T,
            "s": x[:, ::2, 1],
            "big": x.astype(">f4"),
            "device": jnp.asarray(x),
            "zero": x[:0],
        }
    )
    read = decode(encode(message)).arrays
    for name, array in (
        ("t", x.T),
        ("s", x[:, ::2, 1]),
        ("big", x),
        ("device", x),
        ("zero", x[:0]),
    ):
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == np.dtype("<f4")


def test_every_array_is_aligned():
    data = encode(Message({name: np.ones(3, name) for name in DTYPES}, {"odd": "x"}))
    start = np.frombuffer(data, np.uint8).ctypes.data
    for array in decode(data).arrays.values():
        assert (array.ctypes.data - start) % array.itemsize == 0


def test_shared_message_is_encoded_once():
    message = SharedMessage({"x": np.ones(3)}, {"a": 1})
    assert encode(message) is encode(message)
    assert encode(message) == encode(Message(message.arrays, message.meta))


@pytest.mark.parametrize(
    ("message", "match"),
    [
        (Message({"x": np.array(["text"])}), "'x' has dtype <U4"),
        (Message({"x": np.array([object()])}), "'x' has dtype object"),
        (Message({"x": np.ones(2, complex)}), "'x' has dtype complex128"),
        (Message({"__metadata__": np.ones(2)}), "cannot be the name"),
        (Message(meta={"a": float("nan")}), "cannot be written as JSON"),
        (Message(meta={"a": {1, 2}}), "cannot be written as JSON"),
        (Message(meta={"a": "x" * MAX_HEADER}), "header has .* bytes"),
    ],
)
def test_unencodable_values_are_named(message, match):
    with pytest.raises(CongraspError, match=match):
        encode(message)


TWO = np.array([1, 2], np.float32).tobytes()


def signed(rest):
    """A message without arrays whose header ends with `rest` instead of a brace; the checksum is
    right.
    """
    text = b'{"__metadata__":{"checksum":"00000000","meta":"{}"}' + rest
    text = text.replace(b"00000000", b"%08x" % zlib.crc32(text), 1)
    return len(text).to_bytes(8, "little") + text


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "cut: it has only 0 bytes"),
        (b"\x00" * 7, "cut"),
        ((MAX_HEADER + 1).to_bytes(8, "little") + b"{}", "claims 1048577 bytes"),
        (b"\xff" * 8, "claims 18446744073709551615 bytes"),
        ((100).to_bytes(8, "little") + b"{}", "cut inside its header"),
        ((2).to_bytes(8, "little") + b"[]", "does not begin with its checksum"),
        (packed({"x": entry()}, TWO, crc="00000001"), "does not match its checksum"),
        (packed({"x": entry()}, TWO, crc="zz"), "does not match its checksum"),
        (packed({"x": entry()}, TWO, more="x"), "lacks its metadata"),
        (packed({}, meta=3), "lacks its metadata"),
        (signed(b"]"), "not JSON"),
        (signed(b',"a":\xff}'), "not JSON"),
        (signed(b',"a":' + b"[" * (1 << 18)), "not JSON"),
        (signed(b',"a":1,"a":2}'), "key twice"),
        (packed({}, meta="[1]"), "not a JSON object"),
        (packed({}, meta='{"a": NaN}'), "NaN"),
        (packed({"x": entry()}, TWO[:-1]), "cut: the array 'x' ends at 8 of 7"),
        (packed({"x": entry()}, TWO + b"\0"), "1 bytes that belong to no array"),
        (packed({}, TWO), "8 bytes that belong to no array"),
        (packed({"x": entry(shape=(3,))}, TWO), r"8 bytes, which is not float32 times \(3,\)"),
        (packed({"x": entry(dtype="F8")}, TWO), "dtype 'F8'"),
        (packed({"x": entry(dtype=["F32"])}, TWO), "dtype"),
        (packed({"x": entry(shape=(-2,))}, TWO), "shape"),
        (packed({"x": entry(shape=(2.0,))}, TWO), "shape"),
        (packed({"x": entry(shape=(True, 2))}, TWO), "shape"),
        (packed({"x": entry(shape="2")}, TWO), "shape"),
        (packed({"x": entry(shape=[1] * 9 + [2])}, TWO), "shape"),
        (packed({"x": entry(shape=(1 << 39, 1 << 39, 0), offsets=(0, 0))}), "shape"),
        (packed({"x": entry(shape=(10**30, 0), offsets=(0, 0))}), "shape"),
        (packed({"x": entry(offsets=(0, 8, 9))}, TWO), "data_offsets"),
        (packed({"x": entry(offsets=(8, 0))}, TWO), "starts at byte 8, not at 0"),
        (packed({"x": entry(offsets=None)}, TWO), "data_offsets"),
        (packed({"x": {**entry(), "more": 1}}, TWO), "not described by"),
        (packed({"x": 7}), "not described by"),
        (packed({"x": entry(), "y": entry()}, TWO), "gap or an overlap"),
        (
            packed(
                {"x": entry(shape=(1,), offsets=(0, 4)), "y": entry(shape=(1,), offsets=(3, 7))},
                TWO,
            ),
            "overlap",
        ),
        (packed({"x": entry(shape=(1,), offsets=(4, 8))}, TWO), "starts at byte 4, not at 0"),
        (packed({"x": entry("BOOL", (2,), (0, 2))}, b"\x01\x02"), "booleans other than 0 and 1"),
    ],
)
def test_damage_is_named(data, match):
    with pytest.raises(CongraspError, match=match) as caught:
        decode(data)
    assert len(str(caught.value)) < 250
    assert str(caught.value).isascii()


def test_length_is_limited():
    data = encode(Message({"x": np.zeros(100)}))
    with pytest.raises(CongraspError, match=f"has {len(data)} bytes; the limit is 100"):
        decode(data, max_bytes=100)
    assert decode(data, max_bytes=len(data)).arrays["x"].shape == (100,)


WHOLE = encode(
    Message({"x": np.arange(6, dtype=np.float32), "b": np.array([True])}, {"actor": "a", "n": 3})
)


def test_every_flipped_bit_is_found():
    """In names, dtypes, shapes, meta data and the checksum itself as well as in the data."""
    for at in range(len(WHOLE)):
        for bit in range(8):
            damaged = bytearray(WHOLE)
            damaged[at] ^= 1 << bit
            with pytest.raises(CongraspError):
                decode(bytes(damaged))


@settings(deadline=None, max_examples=100)
@given(
    st.dictionaries(
        st.sampled_from("xyz"),
        st.fixed_dictionaries(
            {
                "dtype": st.sampled_from(["F32", "BOOL", "U8", "F64", ""]) | json_values,
                "shape": st.lists(st.integers(-1, 2**70) | st.integers(0, 4), max_size=10)
                | json_values,
                "data_offsets": st.lists(st.integers(0, 40), min_size=2, max_size=2) | json_values,
            }
        )
        | json_values,
        max_size=3,
    ),
    st.binary(max_size=40),
)
def test_invented_headers_raise_nothing_else(header, section):
    _decode_or_refuse(packed(header, section))


def _decode_or_refuse(data):
    try:
        message = decode(data)
    except CongraspError:
        return
    assert sum(array.nbytes for array in message.arrays.values()) <= len(data)


@given(arrays, metas)
def test_a_compressed_message_arrives_as_a_plain_one(arrays, meta):
    sent = encode(CompressedMessage(arrays, meta))
    received = decode(sent)
    assert encode(received) == encode(Message(arrays, meta))


REPETITIVE = CompressedMessage({"a": np.repeat(np.arange(1000.0), 20)})


def test_a_compressed_message_is_shorter():
    assert len(encode(REPETITIVE)) < len(encode(Message(REPETITIVE.arrays))) / 2


def test_a_message_that_would_cost_its_receiver_much_memory_is_sent_as_it_is():
    zeros = {"a": np.zeros(1_000_000)}
    assert encode(CompressedMessage(zeros)) == encode(Message(zeros))


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (lambda data: data[:-5], "compressed message is damaged"),
        (lambda data: data + b"more", "compressed message is damaged"),
        (lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:], "damaged|checksum|JSON"),
        (lambda data: zstandard.compress(bytes(10_000_000)), "does not say that it has at most"),
        (
            lambda data: zstandard.ZstdCompressor(write_content_size=False).compress(data),
            "does not say that it has at most",
        ),
    ],
    ids=["cut", "longer", "flipped", "bomb", "no size"],
)
def test_damage_of_a_compressed_message_is_named(damage, match):
    with pytest.raises(CongraspError, match=match):
        decode(damage(encode(REPETITIVE)))


def test_the_length_of_a_compressed_message_is_limited_before_it_is_inflated():
    with pytest.raises(CongraspError, match="at most 1000 bytes"):
        decode(encode(REPETITIVE)[:1000], max_bytes=1000)
