"""Locks of files between processes.

Locks belong to the process: forked children do not inherit them, and the system releases them when
the process ends. This is the only module that uses `fcntl`.
"""

import errno
import fcntl
from typing import IO

_HELD = (errno.EACCES, errno.EAGAIN)
_UNSUPPORTED = (
    errno.ENOLCK,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.EINVAL,
    errno.ENOSYS,
    errno.EPERM,
    errno.ENOTTY,
)


class NoLocksError(OSError):
    """The file system has no locks."""


def try_lock(file: int | IO[bytes], span: range | None = None, *, shared: bool = False) -> bool:
    """Locks a file, without waiting; closing any of its descriptors in this process unlocks it.

    Args:
      file: the file or its descriptor.
      span: bytes to lock; all of them by default.
      shared: locks together with other shared locks.

    Returns:
      True if it is locked now, False if another process holds a lock.

    Raises:
      NoLocksError: the file system has no locks.
      OSError: another error of the system.
    """
    kind = fcntl.LOCK_EX
    if shared:
        kind = fcntl.LOCK_SH
    start = 0
    length = 0
    if span is not None:
        start = span.start
        length = len(span)
    try:
        fcntl.lockf(file, kind | fcntl.LOCK_NB, length, start)
    except OSError as error:
        if error.errno in _HELD:
            return False
        if error.errno in _UNSUPPORTED:
            raise NoLocksError(error.errno, error.strerror) from None
        raise
    return True
