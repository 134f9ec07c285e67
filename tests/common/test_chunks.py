"""Long replies in chunks that are lost, deferred or no longer stored."""

import itertools
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import TransportError
from congrasp.common.transport import chunks
from congrasp.common.transport.chunks import Outbox, Pace, fetch, is_request
from congrasp.common.transport.keys import account


def _first(outbox, payload, attachment=b"", account="a"):
    """First chunk of a reply and its attachment."""
    with outbox.first_chunk(payload, attachment, account) as chunk_and_head:
        return chunk_and_head


def _fetched(outbox, payload, lost=(), **options):
    """Reply fetched from an outbox, while the chunks with numbers in `lost` do not arrive."""
    first, head = _first(outbox, payload)
    if head is None:
        return first
    numbers = itertools.count()

    def request_chunk(request, seconds):
        assert is_request(request)
        assert not is_request(head)
        assert seconds <= 1.0
        return None if next(numbers) in lost else outbox.chunk(request)

    options = {"max_bytes": 1 << 30, "timeout": 5.0, **options}
    return fetch(head, first, request_chunk, Pace(), **options)


@settings(max_examples=30, deadline=None)
@given(size=st.integers(0, 3 << 20), lost=st.sets(st.integers(0, 8), max_size=3))
def test_fetch_with_lost_chunks(size, lost, no_pauses):
    payload = bytes(range(256)) * (size // 256 + 1)
    assert _fetched(Outbox(), payload[:size], lost) == payload[:size]


@pytest.fixture(scope="module")
def no_pauses():
    """Removes the pauses after lost chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "PAUSE_S", 0.0)
        yield patch


def test_pace_of_a_fast_and_a_slow_link():
    pace = Pace()
    lengths = []
    for seconds in [0.01] * 10 + [0.5] * 12:
        lengths.append(int.from_bytes(pace.request(b"t" * 8, 0)[-4:], "little"))
        pace.record(seconds, arrived=seconds < 1)
    assert lengths[:3] == [32 << 10, 64 << 10, 128 << 10]
    assert max(lengths) == 4 << 20
    assert lengths[-1] == 8 << 10
    pace.record(0.0, arrived=False)  # deferred: no measurement of the link
    assert pace.request(b"t" * 8, 0)[-4:] == (8 << 10).to_bytes(4, "little")


def test_outbox_drops_least_used_reply():
    outbox = Outbox(max_replies=2)
    payloads = [bytes([i]) * (1 << 20) for i in range(3)]
    heads = [_first(outbox, payloads[0])[1], _first(outbox, payloads[1])[1]]
    assert _first(outbox, payloads[0])[1] == heads[0]
    fresh = _first(outbox, payloads[2])[1]
    request = lambda head: Pace().request(head[:8], 100)  # noqa: E731
    assert outbox.chunk(request(heads[1])) == b""
    assert outbox.chunk(request(heads[0])) == payloads[0][100 : 100 + (32 << 10)]
    assert outbox.chunk(request(fresh)) == payloads[2][100 : 100 + (32 << 10)]
    assert outbox.chunk(Pace().request(fresh[:8], 1 << 40)) == b""


def test_first_chunk_after_long_chunks():
    outbox = Outbox(max_concurrent=1)
    pace = Pace()
    payload = bytes(3 << 20)
    assert pace.first_request() is None
    assert _first(outbox, payload, b"")[0] == payload[: 32 << 10]
    for _ in range(6):
        pace.record(0.01, arrived=True)
    chunk, head = _first(outbox, payload, pace.first_request())
    assert len(chunk) == 2 << 20
    assert (
        fetch(
            head,
            chunk,
            lambda request, _: outbox.chunk(request),
            pace,
            max_bytes=1 << 30,
            timeout=5.0,
        )
        == payload
    )
    pace.record(0.01, arrived=True)
    assert _first(outbox, payload, pace.first_request()) == (payload, None)
    with outbox.turn("a"):  # one of its chunks is being sent
        assert len(_first(outbox, payload, pace.first_request())[0]) == 32 << 10
        assert _first(outbox, payload, pace.first_request(), account="b") == (payload, None)
    assert len(_first(outbox, bytes(5 << 20), b"\xff" * 4)[0]) == 4 << 20  # limit of a request
    pace.reset()
    assert pace.first_request() is None


def test_fetch_of_incomplete_reply_is_error():
    outbox = Outbox()
    payload = bytes(1 << 20)
    with pytest.raises(TransportError, match="the limit is 1000"):
        _fetched(outbox, payload, max_bytes=1000)
    with pytest.raises(TransportError, match="Only 32768 of 1048576 bytes"):
        _fetched(outbox, payload, lost=range(10**6), timeout=0.2)
    first, head = _first(outbox, payload)
    with pytest.raises(TransportError, match="no longer available"):
        fetch(head, first, lambda request, seconds: b"", Pace(), max_bytes=1 << 30, timeout=1.0)
    with pytest.raises(TransportError, match="no longer available"):  # longer than announced
        fetch(
            head,
            first,
            lambda request, seconds: bytes(2 << 20),
            Pace(),
            max_bytes=1 << 30,
            timeout=1.0,
        )
    with pytest.raises(TransportError, match="invalid attachment"):
        fetch(b"x", first, lambda request, seconds: b"", Pace(), max_bytes=1 << 30, timeout=1.0)


def test_outbox_limits_chunks_of_one_account():
    outbox = Outbox(max_concurrent=2)
    with (
        outbox.turn("a") as one,
        outbox.turn("a") as two,
        outbox.turn("a") as three,
        outbox.turn("b") as other,
    ):
        assert (one, two, three, other) == (True, True, False, True)
    with outbox.turn("a") as one, outbox.turn("a") as two:
        assert one
        assert two
    assert outbox.busy_accounts == set()
    assert account("congrasp/r/weights/latest/actor/3.gpu") == account(
        "congrasp/r/weights/latest/actor/3.b"
    )
    assert account("congrasp/r/policy/act/3.b") != account("congrasp/r/policy/act/4.b")


def test_fetch_over_a_slow_link():
    """The deadline applies to each chunk; the whole reply may take longer."""
    outbox = Outbox()
    payload = bytes(range(256)) * 8192
    first, head = _first(outbox, payload)

    def request_chunk(request, seconds):
        time.sleep(0.12)
        return outbox.chunk(request)

    began = time.monotonic()
    assert fetch(head, first, request_chunk, Pace(), max_bytes=1 << 30, timeout=0.4) == payload
    assert time.monotonic() - began > 0.4
