"""Long replies in pieces, which whoever asked fetches one after another, at the pace of its own link.

The first reply holds the first piece and, as its attachment, a token and the length of the whole. The others are asked
for under the same key, by token, offset and length. So nothing that is sent at once is longer than a socket takes, and
a reader who is slow or stopped costs the process that serves it nothing but a refused piece.
"""

import secrets
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from common.errors import TransportError

FIRST = 32 << 10
"""Bytes of the first piece; shorter replies are sent whole."""
_SHORTEST, _LONGEST = 8 << 10, 1 << 20
_FAST, _SLOW = 0.02, 0.2  # seconds of a piece below which the next is longer, and above which it is shorter
_TIMEOUT = 2.0  # seconds until a piece counts as lost
_PAUSE = 0.05  # seconds to wait after a piece that was lost or put off
_TOKEN = 8
_HEAD = struct.Struct(f"<{_TOKEN}sQ")
_REQUEST = struct.Struct(f"<{_TOKEN}sQI")

Ask = Callable[[bytes, float], bytes | None]
"""(request, seconds) -> the piece, or None if there is none now."""


class Outbox:
    """Long replies that are being fetched: the same bytes are kept once, and of others the latest that were used."""

    def __init__(self, most: int = 8):
        """Keeps `most` replies."""
        self._most = most
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()

    def put(self, payload: bytes) -> bytes:
        """Keeps a reply; returns the attachment of its first piece."""
        with self._lock:
            token = next((token for token, kept in self._kept.items() if kept is payload), None)
            token = token or secrets.token_bytes(_TOKEN)
            self._kept[token] = payload
            self._kept.move_to_end(token)
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return _HEAD.pack(token, len(payload))

    def piece(self, request: bytes) -> bytes:
        """What a request asks for, of at most a mebibyte; empty if the reply is not kept any more."""
        token, offset, length = _REQUEST.unpack(request)
        with self._lock:
            payload = self._kept.get(token, b"")
            if payload:
                self._kept.move_to_end(token)
        return payload[offset : offset + min(length, _LONGEST)]


def is_request(attachment: bytes) -> bool:
    """Whether a query with this attachment asks for a piece."""
    return len(attachment) == _REQUEST.size


def fetch(head: bytes, first: bytes, ask: Ask, *, most: int, timeout: float) -> bytes:
    """Fetches the rest of a reply; pieces grow while they come quickly.

    Args:
      head: attachment of the first piece.
      first: the first piece.
      ask: asks for a piece.
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
    whole, length = bytearray(first), FIRST
    deadline = time.monotonic() + timeout
    while len(whole) < size:
        began = time.monotonic()
        if began >= deadline:
            raise TransportError(f"Only {len(whole)} of {size} bytes of a reply came in time.")
        piece = ask(_REQUEST.pack(token, len(whole), length), min(_TIMEOUT, deadline - began))
        spent = time.monotonic() - began
        if piece is None:
            length = max(_SHORTEST, length // 2)
            time.sleep(min(_PAUSE, max(0.0, deadline - time.monotonic())))
            continue
        deadline = time.monotonic() + timeout
        if not piece or len(whole) + len(piece) > size:
            raise TransportError("The rest of a reply is not kept any more.", "Ask again.")
        whole += piece
        length = min(_LONGEST, 2 * length) if spent < _FAST else max(_SHORTEST, length // (1 + (spent > _SLOW)))
    return bytes(whole)
