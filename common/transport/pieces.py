"""Long replies in pieces, which whoever asked fetches one after another, at the pace of its own link.

The first piece is short, or as long as the asker wishes who has had pieces of that length before: a reply that is no
longer comes whole. The attachment of any other holds a token and the length of the whole. The rest is asked for under
the same key, by token, offset and length. So nothing that is sent at once is longer than the asker's link takes in a
moment, and a reader who is slow or stopped costs the process that serves it nothing but pieces that are dropped.
"""

import contextlib
import secrets
import struct
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator

from congrasp.common.errors import TransportError

_SHORTEST, _FIRST, _LONGEST = 8 << 10, 32 << 10, 4 << 20  # bytes of a piece
_FAST, _SLOW = 0.1, 0.4  # seconds of a piece below which the next is longer, and above which it is shorter
TIMEOUT = 1.0
"""Seconds until a piece counts as lost."""
_PAUSE = 0.05  # seconds to wait after a piece that was lost or put off
_TOKEN = 8
_HEAD = struct.Struct(f"<{_TOKEN}sQ")
_REQUEST = struct.Struct(f"<{_TOKEN}sQI")
_WISH = struct.Struct("<I")

Ask = Callable[[bytes, float], bytes | None]
"""(request, seconds) -> the piece, or None if there is none now."""


class Pace:
    """How long pieces may be: longer while they come quickly, and remembered from one reply to the next."""

    def __init__(self) -> None:
        self._length = _FIRST

    def wish(self) -> bytes | None:
        """Attachment of a query whose reply may begin with a longer piece; None before there has been one."""
        return _WISH.pack(self._length) if self._length > _FIRST else None

    def lost(self) -> None:
        """Takes in that a longer first piece did not come: begins anew."""
        self._length = _FIRST

    def request(self, token: bytes, offset: int) -> bytes:
        """Attachment of a query for a further piece."""
        return _REQUEST.pack(token, offset, self._length)

    def note(self, seconds: float, *, came: bool) -> None:
        """Takes in how long a piece took, and whether it came; one that was only put off says nothing."""
        if seconds > _SLOW:
            self._length = max(_SHORTEST, self._length // 2)
        elif came and seconds < _FAST:
            self._length = min(_LONGEST, 2 * self._length)


class Outbox:
    """Long replies that are being fetched: the same bytes are kept once, and of others the latest that were used."""

    def __init__(self, most: int = 8, at_once: int = 2):
        """Keeps `most` replies; so many pieces are on their way to one account `at_once`."""
        self._most, self._at_once = most, at_once
        self._sending: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()

    @contextlib.contextmanager
    def first(self, payload: bytes, attachment: bytes, account: str) -> Iterator[tuple[bytes, bytes | None]]:
        """Around the sending of a reply: its first piece, and the attachment of that; None if it is the whole.

        Args:
          payload: the whole.
          attachment: of the query.
          account: whose it is. It has no long first piece while it has others on their way.
        """
        longest = min(_WISH.unpack(attachment)[0], _LONGEST) if len(attachment) == _WISH.size else 0
        if len(payload) <= _FIRST or longest <= _FIRST:
            yield self._cut(payload, _FIRST)
            return
        with self.turn(account) as mine:
            yield self._cut(payload, longest if mine else _FIRST)

    def _cut(self, payload: bytes, longest: int) -> tuple[bytes, bytes | None]:
        """The first piece of a reply, which is kept if that is not the whole, and its attachment."""
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
        """Around the sending of a piece: whether the account has none too many on their way."""
        with self._lock:
            mine = self._sending[account] < self._at_once
            self._sending[account] += mine
        try:
            yield mine
        finally:
            with self._lock:
                self._sending[account] -= mine
                self._sending += Counter()  # keeps what is above zero

    def piece(self, request: bytes) -> bytes:
        """What a request asks for; empty if the reply is not kept any more."""
        token, offset, length = _REQUEST.unpack(request)
        with self._lock:
            payload = self._kept.get(token, b"")
            if payload:
                self._kept.move_to_end(token)
        return payload[offset : offset + min(length, _LONGEST)]


def is_request(attachment: bytes) -> bool:
    """Whether a query with this attachment asks for a further piece."""
    return len(attachment) == _REQUEST.size


def fetch(head: bytes, first: bytes, ask: Ask, pace: Pace, *, most: int, timeout: float) -> bytes:
    """Fetches the rest of a reply.

    Args:
      head: attachment of the first piece.
      first: the first piece.
      ask: asks for a piece.
      pace: of the link.
      most: bytes of the longest reply that is taken.
      timeout: seconds that each piece may take.

    Returns:
      The whole reply.

    Raises:
      TransportError: it is too long or gone, or a piece did not come in time.
    """
    if len(head) != _HEAD.size:
        raise TransportError("A reply has an attachment that is none of a piece.")
    token, size = _HEAD.unpack(head)
    if size > most:
        raise TransportError(f"A reply of {size} bytes is longer than the {most} that are allowed.")
    parts, have, deadline = [first], len(first), time.monotonic() + timeout
    while have < size:
        began = time.monotonic()
        if began >= deadline:
            raise TransportError(f"Only {have} of {size} bytes of a reply came in time.")
        piece = ask(pace.request(token, have), min(TIMEOUT, deadline - began))
        ended = time.monotonic()
        pace.note(ended - began, came=piece is not None)
        if piece is None:
            time.sleep(max(0.0, min(_PAUSE, deadline - ended)))
            continue
        if not piece or have + len(piece) > size:
            raise TransportError("The rest of a reply is not kept any more.", "Ask again.")
        parts.append(piece)
        have, deadline = have + len(piece), ended + timeout
    return b"".join(parts)
