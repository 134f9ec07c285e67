"""Exclusive locks of files between processes, which the system releases when a process ends."""

import errno
from typing import BinaryIO

import filelock

_UNSUPPORTED = (
    errno.ENOLCK,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.EINVAL,
    errno.ENOSYS,
    errno.EPERM,
    errno.ENOTTY,
)
FIRST_READABLE = 1
"""First byte of a locked file that other processes can read: Windows locks the one before it."""


class NoLocksError(OSError):
    """The file system or Python has no locks."""


def try_lock(file: BinaryIO) -> bool:
    """Locks a file, without waiting; closing it unlocks it.

    Returns:
      True if it is locked now, False if another process or another file object holds the lock.

    Raises:
      NoLocksError: the file system or Python has no locks.
      OSError: another error of the system.
    """
    try:
        return filelock.lock_descriptor(file.fileno(), blocking=False)
    except OSError as error:
        if error.errno in _UNSUPPORTED:
            raise NoLocksError(error.errno, error.strerror) from None
        raise
