"""File systems that lack something, put in front of the system's calls of a process."""

import errno
import fcntl
import os
import stat

_fsync = os.fsync
_lexists = os.path.lexists
_listdir = os.listdir
_open = os.open


def no_folder_fsync(number: int) -> None:
    """Flushing a folder fails, as on CIFS before Linux 4.17."""

    def fsync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        _fsync(descriptor)

    os.fsync = fsync


def no_links(number: int) -> None:
    """Symbolic links cannot be created, as on SMB and FAT."""

    def symlink(source: object, target: object, *_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    os.symlink = symlink


def no_locks(number: int) -> None:
    """Files cannot be locked, as on some network shares."""

    def lockf(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    fcntl.lockf = lockf
    fcntl.flock = lockf


def ignores_case() -> None:
    """Names that differ in case only are one file, as on macOS and Windows."""

    def actual(path: object) -> str:
        folder, name = os.path.split(os.fspath(path))
        try:
            names = _listdir(folder or ".")
        except OSError:
            return os.fspath(path)
        if name in names:
            return os.fspath(path)
        alike = (one for one in names if one.casefold() == name.casefold())
        return os.path.join(folder, next(alike, name))

    def resolved_open(path: object, *arguments: object, **options: object) -> int:
        return _open(actual(path), *arguments, **options)

    def resolved_lexists(path: object) -> bool:
        return _lexists(actual(path))

    os.open = resolved_open
    os.path.lexists = resolved_lexists


NUMBERS = {
    name: getattr(errno, name)
    for name in ("EINVAL", "ENOTSUP", "EBADF", "EACCES", "EPERM", "ENOLCK")
}
