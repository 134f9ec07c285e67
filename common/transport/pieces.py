"""Long replies in chunks, fetched one after another by the client at the speed of its link.

The first chunk is short, or as long as requested by a client that has received chunks of that length before. A reply no
longer than that is complete. Otherwise its attachment holds a token and the total length, and the client queries the
rest under the same key, by token, offset and length. No message is therefore longer than the client's link transfers in
a moment, and a slow or stopped client costs the server nothing but dropped chunks.
"""

import contextlib
import secrets
import struct
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator

from congrasp.common.errors import TransportError

_SHORTEST, _FIRST, _LONGEST = 8 << 10, 32 << 10, 4 << 20  # bytes of a chunk
_FAST, _SLOW = 0.1, 0.4  # seconds of a chunk below which the next is longer, and above which it is shorter
TIMEOUT = 1.0
"""Seconds until a chunk counts as lost."""
_PAUSE = 0.05  # seconds to wait after a chunk that was lost or deferred
_TOKEN = 8
_HEAD = struct.Struct(f"<{_TOKEN}sQ")
_REQUEST = struct.Struct(f"<{_TOKEN}sQI")
_WISH = struct.Struct("<I")

Ask = Callable[[bytes, float], bytes | None]
"""(request, seconds) -> the chunk, or None if it is not available now."""


class Pace:
    """Chunk length of a link: longer while chunks arrive quickly, and kept between replies."""

    def __init__(self) -> None:
        self._length = _FIRST

    def wish(self) -> bytes | None:
        """Attachment of a query that requests a longer first chunk; None before the first long reply."""
        return _WISH.pack(self._length) if self._length > _FIRST else None

    def lost(self) -> None:
        """Records that a longer first chunk was lost: restarts from the default length."""
        self._length = _FIRST

    def request(self, token: bytes, offset: int) -> bytes:
        """Attachment of a query for a further chunk."""
        return _REQUEST.pack(token, offset, self._length)

    def note(self, seconds: float, *, came: bool) -> None:
        """Records the duration of a chunk and whether it arrived; a deferred one changes nothing."""
        if seconds > _SLOW:
            self._length = max(_SHORTEST, self._length // 2)
        elif came and seconds < _FAST:
            self._length = min(_LONGEST, 2 * self._length)


class Outbox:
    """Long replies being fetched: a payload sent repeatedly is stored once, and only the last used ones are kept."""

    def __init__(self, most: int = 8, at_once: int = 2):
        """Keeps `most` replies, and sends at most `at_once` chunks to one account at a time."""
        self._most, self._at_once = most, at_once
        self._sending: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()

    @contextlib.contextmanager
    def first(self, payload: bytes, attachment: bytes, account: str) -> Iterator[tuple[bytes, bytes | None]]:
        """Context of sending a reply: yields its first chunk and the chunk's attachment, None if the reply is complete.

        Args:
          payload: the whole reply.
          attachment: attachment of the query.
          account: account of the client. Its first chunk is short while others are being sent to it.
        """
        longest = min(_WISH.unpack(attachment)[0], _LONGEST) if len(attachment) == _WISH.size else 0
        if len(payload) <= _FIRST or longest <= _FIRST:
            yield self._cut(payload, _FIRST)
            return
        with self.turn(account) as mine:
            yield self._cut(payload, longest if mine else _FIRST)

    def _cut(self, payload: bytes, longest: int) -> tuple[bytes, bytes | None]:
        """Returns the first chunk of a reply and its attachment; stores the reply if that is not all of it."""
        if len(payload) <= longest:
            return payload, None
        with self._lock:
            token = next((token for token, kept in self._kept.items() if kept is payload), None)
            token = token or secrets.token_bytes(_TOKEN)
            self._kept[token] = payload
            self._kept.move_to_end(token)
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return payload[:longest], _HEAD.pack(token, len(payload))

    @contextlib.contextmanager
    def turn(self, account: str) -> Iterator[bool]:
        """Context of sending a chunk: yields True unless too many are being sent to the account."""
        with self._lock:
            mine = self._sending[account] < self._at_once
            self._sending[account] += mine
        try:
            yield mine
        finally:
            with self._lock:
                self._sending[account] -= mine
                self._sending += Counter()  # drops counts of zero

    def piece(self, request: bytes) -> bytes:
        """Returns the requested chunk; empty if the reply is no longer stored."""
        token, offset, length = _REQUEST.unpack(request)
        with self._lock:
            payload = self._kept.get(token, b"")
            if payload:
                self._kept.move_to_end(token)
        return payload[offset : offset + min(length, _LONGEST)]


def is_request(attachment: bytes) -> bool:
    """True if a query with this attachment requests a further chunk."""
    return len(attachment) == _REQUEST.size


def fetch(head: bytes, first: bytes, ask: Ask, pace: Pace, *, most: int, timeout: float) -> bytes:
    """Fetches the rest of a reply.

    Args:
      head: attachment of the first chunk.
      first: the first chunk.
      ask: queries a chunk.
      pace: pace of the link.
      most: limit of the reply's length in bytes.
      timeout: deadline of each chunk in seconds.

    Returns:
      The whole reply.

    Raises:
      TransportError: the reply is too long or no longer stored, or a chunk did not arrive in time.
    """
    if len(head) != _HEAD.size:
        raise TransportError("A reply has an invalid attachment.")
    token, size = _HEAD.unpack(head)
    if size > most:
        raise TransportError(f"A reply has {size} bytes; the limit is {most}.")
    parts, have, deadline = [first], len(first), time.monotonic() + timeout
    while have < size:
        began = time.monotonic()
        if began >= deadline:
            raise TransportError(f"Only {have} of {size} bytes of a reply arrived in time.")
        piece = ask(pace.request(token, have), min(TIMEOUT, deadline - began))
        ended = time.monotonic()
        pace.note(ended - began, came=piece is not None)
        if piece is None:
            time.sleep(max(0.0, min(_PAUSE, deadline - ended)))
            continue
        if not piece or have + len(piece) > size:
            raise TransportError("The rest of a reply is no longer available.", "Send the query again.")
        parts.append(piece)
        have, deadline = have + len(piece), ended + timeout
    return b"".join(parts)
