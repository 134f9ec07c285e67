"""Long replies in chunks: the server stores a reply, and the client fetches it at its link's pace.

`Outbox` is the server's side, `Pace` and `fetch` are the client's.
"""

import contextlib
import math
import secrets
import struct
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator

from congrasp.common.errors import TransportError

_MIN_CHUNK_BYTES = 8 << 10
_DEFAULT_CHUNK_BYTES = 32 << 10
_MAX_CHUNK_BYTES = 4 << 20
_FAST_S = 0.1
"""Duration of a chunk beyond the round trip below which the next one is longer."""
_SLOW_S = 0.4
"""Duration of a chunk beyond the round trip above which the next one is shorter."""
CHUNK_TIMEOUT_S = 1.0
"""Time until a chunk counts as lost."""
PAUSE_S = 0.05
"""Pause after a chunk that was lost or deferred."""
_TOKEN_BYTES = 8
_HEAD = struct.Struct(f"<{_TOKEN_BYTES}sQ")
"""Attachment of a first chunk: token and length of the whole reply."""
_REQUEST = struct.Struct(f"<{_TOKEN_BYTES}sQI")
"""Attachment of a query for a further chunk: token, offset and longest length."""
_FIRST_REQUEST = struct.Struct("<I")
"""Attachment of a query that requests a longer first chunk: its longest length."""

RequestChunk = Callable[[bytes, float], bytes | None]
"""(request, seconds) -> the chunk, or None if it is not available now."""


class Pace:
    """Chunk length of a link: longer while chunks arrive quickly, and kept between replies."""

    def __init__(self) -> None:
        self._chunk_bytes = _DEFAULT_CHUNK_BYTES
        self._round_trip_s = math.inf

    def first_request(self) -> bytes | None:
        """Attachment of a query that requests a longer first chunk; None before the first long
        reply.
        """
        if self._chunk_bytes <= _DEFAULT_CHUNK_BYTES:
            return None
        return _FIRST_REQUEST.pack(self._chunk_bytes)

    def reset(self) -> None:
        """Restarts from the default length, since a longer first chunk was lost."""
        self._chunk_bytes = _DEFAULT_CHUNK_BYTES

    def request(self, token: bytes, offset: int) -> bytes:
        """Attachment of a query for a further chunk."""
        return _REQUEST.pack(token, offset, self._chunk_bytes)

    def record(self, seconds: float, *, arrived: bool) -> None:
        """Records the duration of a chunk and whether it arrived; a deferred one changes
        nothing.

        The shortest duration counts as the round trip, which the length does not change.
        """
        if arrived:
            self._round_trip_s = min(self._round_trip_s, seconds)
        transfer_s = seconds
        if math.isfinite(self._round_trip_s):
            transfer_s -= self._round_trip_s
        if transfer_s > _SLOW_S:
            self._chunk_bytes = max(_MIN_CHUNK_BYTES, self._chunk_bytes // 2)
        elif arrived and transfer_s < _FAST_S:
            self._chunk_bytes = min(_MAX_CHUNK_BYTES, 2 * self._chunk_bytes)


class Outbox:
    """Long replies in chunks, fetched one after another by the client at the speed of its link.

    The first chunk is short, or as long as requested by a client that has received chunks of that
    length before. A reply no longer than that is complete. Otherwise its attachment holds a token
    and the total length, and the client queries the rest under the same key, by token, offset and
    length. No message is therefore longer than the client's link transfers in a moment, and a slow
    or stopped client costs the server nothing but dropped chunks.

    A payload sent repeatedly is stored once, and only the last used ones are stored.
    """

    def __init__(self, max_replies: int = 8, max_concurrent: int = 2):
        """Creates an empty outbox.

        Args:
          max_replies: limit of the stored replies.
          max_concurrent: limit of the chunks sent to one account at a time.
        """
        self._max_replies = max_replies
        self._max_concurrent = max_concurrent
        self._sending: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._replies: OrderedDict[bytes, bytes] = OrderedDict()

    @contextlib.contextmanager
    def first_chunk(
        self, payload: bytes, attachment: bytes, account: str
    ) -> Iterator[tuple[bytes, bytes | None]]:
        """Context of sending a reply: yields its first chunk and the chunk's attachment, None if
        the reply is complete.

        Args:
          payload: the whole reply.
          attachment: attachment of the query.
          account: account of the client. Its first chunk is short while others are being sent to
            it.
        """
        requested = _requested_bytes(attachment)
        if len(payload) <= _DEFAULT_CHUNK_BYTES or requested <= _DEFAULT_CHUNK_BYTES:
            yield self._cut(payload, _DEFAULT_CHUNK_BYTES)
            return
        with self.turn(account) as has_turn:
            yield self._cut(payload, requested if has_turn else _DEFAULT_CHUNK_BYTES)

    def _cut(self, payload: bytes, chunk_bytes: int) -> tuple[bytes, bytes | None]:
        """Returns the first chunk of a reply, and the attachment with which a caller requests more.

        A reply of several chunks is stored. The attachment of a single chunk is None.
        """
        if len(payload) <= chunk_bytes:
            return payload, None
        with self._lock:
            token = self._token_of(payload) or secrets.token_bytes(_TOKEN_BYTES)
            self._replies[token] = payload
            self._replies.move_to_end(token)
            if len(self._replies) > self._max_replies:
                self._replies.popitem(last=False)
        return payload[:chunk_bytes], _HEAD.pack(token, len(payload))

    def _token_of(self, payload: bytes) -> bytes | None:
        """Token of a reply that is stored already; the caller holds the lock."""
        for token, stored in self._replies.items():
            if stored is payload:
                return token
        return None

    @property
    def busy_accounts(self) -> set[str]:
        """Accounts to which chunks are being sent."""
        with self._lock:
            return set(self._sending)

    @contextlib.contextmanager
    def turn(self, account: str) -> Iterator[bool]:
        """Context of sending a chunk: yields True unless too many are being sent to the account."""
        with self._lock:
            has_turn = self._sending[account] < self._max_concurrent
            self._sending[account] += has_turn
        try:
            yield has_turn
        finally:
            with self._lock:
                self._sending[account] -= has_turn
                self._sending += Counter()  # drops counts of zero

    def chunk(self, request: bytes) -> bytes:
        """Returns the requested chunk; empty if the reply is no longer stored."""
        token, offset, length = _REQUEST.unpack(request)
        with self._lock:
            payload = self._replies.get(token, b"")
            if payload:
                self._replies.move_to_end(token)
        return payload[offset : offset + min(length, _MAX_CHUNK_BYTES)]


def _requested_bytes(attachment: bytes) -> int:
    """Length of the first chunk that a query requests; zero without a request."""
    if len(attachment) != _FIRST_REQUEST.size:
        return 0
    (requested,) = _FIRST_REQUEST.unpack(attachment)
    return min(requested, _MAX_CHUNK_BYTES)


def is_request(attachment: bytes) -> bool:
    """True if a query with this attachment requests a further chunk."""
    return len(attachment) == _REQUEST.size


def fetch(
    head: bytes,
    first: bytes,
    request_chunk: RequestChunk,
    pace: Pace,
    *,
    max_bytes: int,
    timeout: float,
) -> bytes:
    """Fetches the rest of a reply.

    Args:
      head: attachment of the first chunk.
      first: the first chunk.
      request_chunk: queries a chunk.
      pace: pace of the link.
      max_bytes: limit of the reply's length.
      timeout: deadline of each chunk in seconds.

    Returns:
      The whole reply.

    Raises:
      TransportError: the reply is too long or no longer stored, or a chunk did not arrive in time.
    """
    if len(head) != _HEAD.size:
        raise TransportError("A reply has an invalid attachment.")
    token, size = _HEAD.unpack(head)
    if size > max_bytes:
        raise TransportError(f"A reply has {size} bytes; the limit is {max_bytes}.")
    chunks = [first]
    received = len(first)
    deadline = time.monotonic() + timeout
    while received < size:
        start = time.monotonic()
        if start >= deadline:
            raise TransportError(f"Only {received} of {size} bytes of a reply arrived in time.")
        request = pace.request(token, received)
        chunk = request_chunk(request, min(CHUNK_TIMEOUT_S, deadline - start))
        end = time.monotonic()
        pace.record(end - start, arrived=chunk is not None)
        if chunk is None:
            time.sleep(max(0.0, min(PAUSE_S, deadline - end)))
            continue
        if not chunk or received + len(chunk) > size:
            raise TransportError(
                "The rest of a reply is no longer available.", "Send the query again."
            )
        chunks.append(chunk)
        received += len(chunk)
        deadline = end + timeout
    return b"".join(chunks)
