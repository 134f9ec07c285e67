"""Python on Linux as congrasp's modules would see it on Windows.

Python imports this module at its start if the folder is on PYTHONPATH. Modules of congrasp, and no
others, then lack what Windows lacks: modules (`fcntl`, `resource`), functions and constants (of
`os`, `signal`, `select`, `socket`), forks, symbolic links, /proc, and a default encoding. Ctrl-Break
is SIGUSR2, process groups of Windows are sessions, and a killed process has the exit code 1. Files
that are open cannot be renamed, replaced or removed, and names follow the rules of Windows.

Libraries are left alone, since they have their versions for Windows. Only `filelock` also lacks
`fcntl`, so that its locks do not exist at all, and psutil may read /proc, as it must on Linux.

With `TRACE_LACKS` in the environment, what was missed is appended to that file.
"""

import builtins
import enum
import multiprocessing
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import types
import warnings

_ROOT = pathlib.Path(__file__).resolve().parents[2]
_OURS = tuple(f"{_ROOT / name}{os.sep}" for name in ("common", "actors", "learner", "services"))
_STDLIB = sysconfig.get_path("stdlib")
_MODULES = {
    "fcntl",
    "resource",
    "pwd",
    "grp",
    "termios",
    "tty",
    "pty",
    "posix",
    "syslog",
    "readline",
}
_OS_NAMES = """
    chown chroot confstr copy_file_range ctermid eventfd fchdir fchmod fchown fdatasync fork
    forkpty fstatvfs geteuid getegid getgid getgroups getloadavg getpgid getpgrp getpriority
    getresgid getresuid getsid getuid killpg lchown lockf major memfd_create minor mkfifo mknod nice
    openpty pidfd_open posix_fadvise posix_fallocate posix_spawn pread preadv pwrite pwritev
    register_at_fork sched_getaffinity sched_setaffinity sched_yield sendfile setegid seteuid setgid
    setpgid setpriority setsid setuid setxattr splice statvfs sync sysconf tcgetpgrp tcsetpgrp
    ttyname uname wait wait3 wait4 waitid O_CLOEXEC O_DIRECTORY O_DSYNC O_NOATIME O_NOFOLLOW
    O_NONBLOCK O_PATH O_SYNC O_TMPFILE WNOHANG WIFEXITED WIFSIGNALED WEXITSTATUS WTERMSIG
"""
_KEPT_SIGNALS = (
    "SIGABRT",
    "SIGFPE",
    "SIGILL",
    "SIGINT",
    "SIGSEGV",
    "SIGTERM",
    "SIG_DFL",
    "SIG_IGN",
)
_SIGNAL = {
    *(name for name in dir(signal) if name.startswith("SIG") and name not in _KEPT_SIGNALS),
    *("alarm", "setitimer", "getitimer", "pause", "pthread_kill", "pthread_sigmask", "sigwait"),
    *("ITIMER_PROF", "ITIMER_REAL", "ITIMER_VIRTUAL", "siginterrupt", "sigpending"),
}
_BREAK = int(signal.SIGUSR2)
_GROUP = 0x200
_RESERVED = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_FORBIDDEN = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$')
_trace = os.environ.get("TRACE_LACKS")


def _note(text: str) -> None:
    """Appends what was missed to the file of `TRACE_LACKS`."""
    if _trace:
        descriptor = os.open(_trace, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(descriptor, f"{text}\n".encode())
        os.close(descriptor)


class _Popen(subprocess.Popen):
    """Children as on Windows: options, and exit codes of killed processes."""

    def __init__(self, *arguments, creationflags=0, **options):
        for name in ("pass_fds", "preexec_fn"):
            if options.get(name):
                raise ValueError(f"{name} is not supported on Windows platforms")
        options.pop("start_new_session", None)
        new_session = bool(creationflags & _GROUP)
        super().__init__(*arguments, start_new_session=new_session, **options)

    @property
    def returncode(self):
        return self._code

    @returncode.setter
    def returncode(self, code):
        self._code = code if code is None or code >= 0 else 1


class _Module(types.ModuleType):
    """A module without some of its names, and with others."""

    def __init__(self, module, lacks=(), has=None):
        super().__init__(module.__name__)
        vars(self).update(module=module, lacks=frozenset(lacks), has=has or {})

    def __getattr__(self, name):
        if name in self.has:
            return self.has[name]
        if name in self.lacks:
            _note(f"{self.module.__name__}.{name}")
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        return getattr(self.module, name)

    def __setattr__(self, name, value):
        setattr(self.module, name, value)


def _context(method=None):
    """The contexts of Windows."""
    if method not in (None, "spawn"):
        raise ValueError(f"cannot find context for {method!r}")
    return multiprocessing.get_context("spawn")


def _rename(source, target, **options):
    """Renames a file, but not over another."""
    if os.path.lexists(target):
        raise FileExistsError(17, "File exists", source, None, target)
    os.rename(source, target, **options)


_signals = enum.IntEnum(
    "Signals",
    {
        **{name: int(getattr(signal, name)) for name in _KEPT_SIGNALS if name[3] != "_"},
        "SIGBREAK": _BREAK,
    },
)


def _stand_ins() -> dict[str, types.ModuleType]:
    """Modules by the names under which congrasp's modules import them."""
    breaks = {"SIGBREAK": _BREAK, "CTRL_BREAK_EVENT": _BREAK, "Signals": _signals}
    select = __import__("select")
    socket = __import__("socket")
    return {
        "os": _Module(os, _OS_NAMES.split(), {"name": "nt", "rename": _rename}),
        "sys": _Module(sys, (), {"platform": "win32"}),
        "signal": _Module(signal, _SIGNAL - breaks.keys(), breaks),
        "select": _Module(select, ("poll", "epoll")),
        "socket": _Module(socket, ("AF_UNIX", "SO_REUSEPORT", "fromfd")),
        "subprocess": _Module(
            subprocess, (), {"Popen": _Popen, "CREATE_NEW_PROCESS_GROUP": _GROUP}
        ),
        "multiprocessing": _Module(multiprocessing, (), {"get_context": _context}),
    }


def _is_ours(names: dict | None) -> bool:
    """True for the globals of a module of congrasp, also if that runs as a program."""
    if not names:
        return False
    spec = names.get("__spec__")
    name = spec.name if spec else str(names.get("__name__"))
    return name.partition(".")[0] == "congrasp" or str(names.get("__file__")).startswith(_OURS)


_import = builtins.__import__


def _lacking_import(name, names=None, locals=None, fromlist=(), level=0):
    """Imports for congrasp what Windows has, and for others everything."""
    root = name.partition(".")[0]
    ours = _is_ours(names)
    is_locker = str((names or {}).get("__name__")).startswith("filelock")
    if root in _MODULES and level == 0 and (ours or is_locker):
        _note(root)
        raise ModuleNotFoundError(f"No module named '{root}'", name=root)
    module = _import(name, names, locals, fromlist, level)
    if not ours or level or (fromlist and "." in name):
        return module
    return _replaced.get(root, module)


def _caller() -> str:
    """Who called: `ours`, or the name of the module outside the standard library."""
    frame = sys._getframe(2)
    while frame is not None:
        names = frame.f_globals
        file = str(names.get("__file__", _STDLIB))
        is_library = file.startswith(_STDLIB) and "site-packages" not in file
        if _is_ours(names):
            return "ours"
        if not is_library and names.get("__name__") != __name__:
            return str(names.get("__name__"))
        frame = frame.f_back
    return ""


def _is_open(path: str) -> bool:
    """True if this process has a file open, or one inside a folder."""
    real = os.path.realpath(path)
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:
            continue
        if target == real or target.startswith(f"{real}/"):
            return True
    return False


def _check_open(path, flags) -> None:
    """Raises what opening a file raises on Windows."""
    text = os.fsdecode(path)
    if _caller() != "ours":
        return
    if text.startswith(("/proc/", "/sys/", "/dev/")) and text != os.devnull:
        _note(text)
        raise FileNotFoundError(2, "No such file or directory", text)
    if os.path.isdir(text) and _is_ours(sys._getframe(2).f_globals):
        _note(f"open {text}")
        raise PermissionError(13, "Permission denied", text)
    if flags & os.O_CREAT:
        _check_name(text)


def _check_name(path: str) -> None:
    """Raises what a name that Windows forbids raises."""
    name = os.path.basename(path)
    if _FORBIDDEN.search(name) or _RESERVED.fullmatch(name):
        raise OSError(22, "Invalid argument", path)


def _check_unused(*paths) -> None:
    """Raises what renaming or removing an open file raises."""
    if _caller() != "ours":
        return
    for path in paths:
        text = os.fsdecode(path)
        if _is_open(text):
            raise PermissionError(13, "The file is in use by another process", text)


def _audit(event: str, arguments: tuple) -> None:
    """Refuses what Windows refuses."""
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _check_open(arguments[0], arguments[2])
    elif event == "os.rename":
        _check_unused(*arguments[:2])
        if _caller() == "ours":
            _check_name(os.fsdecode(arguments[1]))
    elif event in ("os.remove", "os.rmdir") and arguments[1] == -1:
        _check_unused(arguments[0])
    elif event == "os.mkdir" and _caller() == "ours":
        _check_name(os.fsdecode(arguments[0]))
    elif event == "os.symlink" and _caller() == "ours":
        _note("symlink")
        raise OSError(1314, "A required privilege is not held by the client")


_replaced = _stand_ins()
shutil._use_fd_functions = False  # folders are removed without opening them
builtins.__import__ = _lacking_import
sys.addaudithook(_audit)
if sys.flags.warn_default_encoding:
    warnings.filterwarnings("ignore", category=EncodingWarning)
    warnings.filterwarnings("error", category=EncodingWarning, module=r"congrasp\b")
