"""Compressed messages, for slow links: the bytes of a message as one zstd frame.

Rollouts of the human hand in half precision shrink to 48 % at 190 MB/s (`docs/notes/scaling.md`).
"""

from congrasp.common.errors import CongraspError

FRAME_START = b"\x28\xb5\x2f\xfd"
"""First bytes of a zstd frame. Read as the length of a message's header, they exceed its limit, so
that no other message begins with them."""
_LEVEL = 1
_MAX_RATIO = 100
"""Greatest ratio of the lengths: a short message must not cost its receiver much memory."""


def deflated(data: bytes) -> bytes:
    """Returns a message's bytes compressed, or as they are if they shrink beyond what `inflated`
    accepts.
    """
    import zstandard  # clients of a policy need not have it

    compressed = zstandard.ZstdCompressor(level=_LEVEL).compress(data)
    if len(data) > _MAX_RATIO * len(compressed):
        return data
    return compressed


def inflated(data: bytes, max_bytes: int) -> bytes:
    """Returns the bytes of a compressed message.

    Raises:
      CongraspError: they are not one intact frame, or have more than `max_bytes`.
    """
    import zstandard

    limit = min(max_bytes, _MAX_RATIO * len(data))
    try:
        content_bytes = zstandard.frame_content_size(data)
        if not 0 <= content_bytes <= limit:
            raise CongraspError(
                f"The compressed message does not say that it has at most {limit} bytes."
            )
        return zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CongraspError(f"The compressed message is damaged: {error}.") from None
