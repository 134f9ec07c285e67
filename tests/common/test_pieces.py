"""Long replies in pieces: whole again however they are cut, lost, put off or forgotten."""

import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import TransportError
from congrasp.common.transport import zenoh_transport
from congrasp.common.transport.keys import account
from congrasp.common.transport.zenoh_transport import Outbox, Pace, fetch, is_request


def _first(outbox, payload, wish=b"", account="a"):
    """The first piece of a reply and its attachment."""
    with outbox.first(payload, wish, account) as found:
        return found


def _fetched(outbox, payload, lost=(), **options):
    """A reply that went through an outbox, of which some pieces are lost on the way."""
    first, head = _first(outbox, payload)
    if head is None:
        return first
    asked = iter(range(10**9))

    def ask(request, seconds):
        assert is_request(request) and not is_request(head) and seconds <= 1.0
        return None if next(asked) in lost else outbox.piece(request)

    return fetch(head, first, ask, Pace(), **{"most": 1 << 30, "timeout": 5.0, **options})


@settings(max_examples=30, deadline=None)
@given(size=st.integers(0, 3 << 20), lost=st.sets(st.integers(0, 8), max_size=3))
def test_a_reply_is_whole_again(size, lost, no_pauses):
    payload = bytes(range(256)) * (size // 256 + 1)
    assert _fetched(Outbox(), payload[:size], lost) == payload[:size]


@pytest.fixture(scope="module")
def no_pauses():
    """No pauses after lost pieces."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zenoh_transport, "_PAUSE", 0.0)
        yield patch


def test_pieces_grow_on_a_fast_link_and_shrink_on_a_slow_one():
    pace, lengths = Pace(), []
    for seconds in [0.01] * 10 + [0.5] * 12:
        lengths.append(int.from_bytes(pace.request(b"t" * 8, 0)[-4:], "little"))
        pace.note(seconds, came=seconds < 1)
    assert (
        lengths[:3] == [32 << 10, 64 << 10, 128 << 10]
        and max(lengths) == 4 << 20
        and lengths[-1] == 8 << 10
    )
    pace.note(0.0, came=False)  # put off: says nothing of the link
    assert pace.request(b"t" * 8, 0)[-4:] == (8 << 10).to_bytes(4, "little")


def test_the_same_bytes_are_kept_once_and_what_nobody_fetches_goes_first():
    outbox = Outbox(most=2)
    payloads = [bytes([i]) * (1 << 20) for i in range(3)]
    heads = [_first(outbox, payloads[0])[1], _first(outbox, payloads[1])[1]]
    assert _first(outbox, payloads[0])[1] == heads[0]
    fresh = _first(outbox, payloads[2])[1]
    request = lambda head: Pace().request(head[:8], 100)  # noqa: E731
    assert outbox.piece(request(heads[1])) == b""
    assert outbox.piece(request(heads[0])) == payloads[0][100 : 100 + (32 << 10)]
    assert outbox.piece(request(fresh)) == payloads[2][100 : 100 + (32 << 10)]
    assert outbox.piece(Pace().request(fresh[:8], 1 << 40)) == b""


def test_a_reply_comes_whole_to_an_asker_that_has_had_pieces_as_long():
    outbox, pace, payload = Outbox(at_once=1), Pace(), bytes(3 << 20)
    assert pace.wish() is None and _first(outbox, payload, b"")[0] == payload[: 32 << 10]
    for _ in range(6):
        pace.note(0.01, came=True)
    piece, head = _first(outbox, payload, pace.wish())
    assert len(piece) == 2 << 20
    assert (
        fetch(
            head, piece, lambda request, _: outbox.piece(request), pace, most=1 << 30, timeout=5.0
        )
        == payload
    )
    pace.note(0.01, came=True)
    assert _first(outbox, payload, pace.wish()) == (payload, None)
    with outbox.turn("a"):  # one of its pieces is on its way
        assert len(_first(outbox, payload, pace.wish())[0]) == 32 << 10
        assert _first(outbox, payload, pace.wish(), account="b") == (payload, None)
    assert len(_first(outbox, bytes(5 << 20), b"\xff" * 4)[0]) == 4 << 20  # whatever is wished
    pace.lost()
    assert pace.wish() is None


def test_what_cannot_be_whole_is_an_error_with_a_deadline():
    outbox, payload = Outbox(), bytes(1 << 20)
    with pytest.raises(TransportError, match="the limit is 1000"):
        _fetched(outbox, payload, most=1000)
    with pytest.raises(TransportError, match="Only 32768 of 1048576 bytes"):
        _fetched(outbox, payload, lost=range(10**6), timeout=0.2)
    first, head = _first(outbox, payload)
    with pytest.raises(TransportError, match="no longer available"):
        fetch(head, first, lambda request, seconds: b"", Pace(), most=1 << 30, timeout=1.0)
    with pytest.raises(TransportError, match="no longer available"):  # longer than announced
        fetch(
            head, first, lambda request, seconds: bytes(2 << 20), Pace(), most=1 << 30, timeout=1.0
        )
    with pytest.raises(TransportError, match="invalid attachment"):
        fetch(b"x", first, lambda request, seconds: b"", Pace(), most=1 << 30, timeout=1.0)


def test_one_account_has_few_pieces_on_their_way():
    outbox = Outbox(at_once=2)
    with (
        outbox.turn("a") as one,
        outbox.turn("a") as two,
        outbox.turn("a") as three,
        outbox.turn("b") as other,
    ):
        assert (one, two, three, other) == (True, True, False, True)
    with outbox.turn("a") as one, outbox.turn("a") as two:
        assert one and two
    assert not outbox._sending
    assert account("congrasp/r/weights/latest/actor/3.gpu") == account(
        "congrasp/r/weights/latest/actor/3.b"
    )
    assert account("congrasp/r/policy/act/3.b") != account("congrasp/r/policy/act/4.b")


def test_a_slow_link_gets_a_long_reply_while_it_makes_progress():
    """The deadline is for each piece: a whole that takes longer than it arrives all the same."""
    outbox, payload = Outbox(), bytes(range(256)) * 1024
    first, head = _first(outbox, payload)

    def ask(request, seconds):
        time.sleep(0.12)
        return outbox.piece(request)

    began = time.monotonic()
    assert fetch(head, first, ask, Pace(), most=1 << 30, timeout=0.4) == payload
    assert time.monotonic() - began > 0.4
