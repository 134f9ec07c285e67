"""What can be wrong with a machine or an installation, in words."""

import importlib.metadata
import os
import platform
import shutil
import socket
import sys
import time
from typing import NamedTuple

from common.transport.zenoh_transport import FLOWS

_TOGETHER = {"mujoco": "3.17.0", "mujoco-mjx": "3.17.0"}
_PORT = 7447
_LEAST_GIB = 2.0


class Finding(NamedTuple):
    """One thing that was looked at."""

    what: str
    fine: bool
    text: str


def examine() -> list[Finding]:
    """Looks at everything; nothing is changed."""
    return [_python(), *_packages(), _gpu(), _port(), _disk(), _clock()]


def _python() -> Finding:
    fine = (3, 11) <= sys.version_info[:2] < (3, 14)
    return Finding("python", fine, f"{platform.python_version()}" + ("" if fine else ": 3.11, 3.12 or 3.13 is needed"))


def _packages() -> list[Finding]:
    found = []
    for name, version in _TOGETHER.items():
        try:
            have = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found.append(Finding(name, False, "not installed; run: pip install 'congrasp[train]'"))
            continue
        fine = have == version
        found.append(Finding(name, fine, have if fine else f"{have}: this version of congrasp needs {version}"))
    return found


def _gpu() -> Finding:
    import jax

    devices = ", ".join(device.device_kind for device in jax.devices())
    backend = jax.default_backend()
    missing = backend == "cpu" and os.path.exists("/dev/nvidia0")
    hint = ": there is an NVIDIA GPU, but JAX does not see it; run: pip install 'congrasp[cuda]'" if missing else ""
    return Finding("devices", not missing, f"JAX {jax.__version__} on {backend} ({devices}){hint}")


def _port() -> Finding:
    last = _PORT + len(FLOWS) - 1
    for port in range(_PORT, last + 1):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return Finding("ports", True, f"{port} is in use (a learner runs here?); choose others with --listen")
    return Finding("ports", True, f"{_PORT}-{last} are free")


def _disk() -> Finding:
    free = shutil.disk_usage(".").free / 2**30
    fine = free > _LEAST_GIB
    return Finding("disk", fine, f"{free:.1f} GiB free here" + ("" if fine else f": a run needs some {_LEAST_GIB} GiB"))


def _clock() -> Finding:
    fine = time.time() > 1.7e9
    return Finding("clock", fine, time.strftime("%Y-%m-%d %H:%M:%S %Z") + ("" if fine else ": it is years behind"))
