"""`congrasp doctor`: checks of this machine and installation, each with a remedy if it fails."""

import functools
import importlib.metadata
import os
import pathlib
import platform
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import FLOWS
from congrasp.common.transport.ports import LEARNER_URL, LOOPBACK_REMEDY, loopback_fault
from congrasp.services.ops.certificates import certificates
from congrasp.services.ops.status import ask

_PACKAGES = ("mujoco", "mujoco-mjx", "warp-lang", "jax", "flax", "eclipse-zenoh")
_MATCHING_PACKAGES = (("mujoco", "mujoco-mjx"), ("jax", "jaxlib"))
"""Packages whose versions must match."""
PORT = int(LEARNER_URL.rpartition(":")[2])
"""First of the default ports of a learner."""
_MIN_FREE_GIB = 2.0
_MIN_DISK_MB_S = 5.0
_SAMPLE_BYTES = 16 << 20
"""Size of the file that is written to measure a disk."""
_MIN_DATE_S = 1.7e9
"""Time in the year 2023, since 1970: an earlier clock is wrong."""
_MAX_DRIFT_S = 0.1
"""Tolerated difference of two clocks over 0.2 s."""
_MIN_DRIVER = 580
"""Oldest NVIDIA driver that JAX and Warp run on."""
_MIN_CERTIFICATE_DAYS = 14.0
"""Time until a certificate expires below which it is reported."""
_MAX_CLOCK_OFFSET_S = 1.0
"""Tolerated offset from the learner's clock."""
_REQUEST_PAUSE_S = 0.05
"""Time between two requests; a secured learner accepts a hundred per second."""
NVIDIA_DEVICE = "/dev/nvidia0"
"""File that exists on a machine with an NVIDIA GPU."""


class Finding(NamedTuple):
    """Result of one check."""

    what: str
    """Name of the part that was checked."""
    fine: bool
    state: str
    """Facts about it, such as its version."""
    remedy: str = ""
    """Problem and repair; printed for a failure."""

    @property
    def text(self) -> str:
        """One line, with the remedy of a failure."""
        if self.fine or not self.remedy:
            return self.state
        return f"{self.state}: {self.remedy}"


def examine(
    connect: str = "",
    run: str = "quickstart",
    folder: pathlib.Path = pathlib.Path(),
    certs: pathlib.Path | None = None,
) -> list[Finding]:
    """Runs all checks, without side effects.

    Args:
      connect: endpoint of a learner to test, if any.
      run: name of its run.
      folder: folder for runs.
      certs: folder of certificates to check, and to use for the connection.
    """
    checks: list[Callable[[], Iterator[Finding]]] = [
        check_python,
        check_packages,
        check_gpu,
        check_jax,
        check_warp,
        check_ports,
    ]
    checks += [functools.partial(check_disk, folder), check_clock]
    if certs:
        checks.append(functools.partial(check_certificates, certs))
    if connect:
        checks.append(functools.partial(check_learner, connect, run, certs))
    findings: list[Finding] = []
    for check in checks:
        findings += run_check(check)
    return findings


def run_check(check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """Yields the findings of a check; an exception is a failed finding."""
    try:
        yield from check()
    except Exception as error:
        function = getattr(check, "func", check)  # of a `functools.partial`
        name = getattr(function, "__name__", "check").strip("_<>").removeprefix("check_")
        reason = type(error).__name__
        lines = str(error).splitlines()
        if lines:
            reason = f"{reason}: {lines[0]}"
        yield Finding(name, False, f"could not be checked: {reason}")


def check_python() -> Iterator[Finding]:
    """Checks the version of Python."""
    fine = (3, 11) <= sys.version_info[:2] < (3, 14)
    yield Finding("python", fine, platform.python_version(), "3.11, 3.12 or 3.13 is needed")


def check_packages() -> Iterator[Finding]:
    """Checks versions required by the package's metadata, and those that must match."""
    extra = "cuda" if os.path.exists(NVIDIA_DEVICE) else "train"
    required = _required_versions(("", "train", extra))
    installed: dict[str, str] = {}
    for name in _PACKAGES:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            if name in required:
                yield Finding(name, False, f"not installed; run: pip install 'congrasp[{extra}]'")
            continue
        version = required.get(name)
        fine = version is None or version.contains(installed[name])
        remedy = f"{version} is needed; run: pip install '{name}{version}'"
        yield Finding(name, fine, installed[name], remedy)
    for first, second in _MATCHING_PACKAGES:
        if first not in installed:
            continue
        expected = importlib.metadata.version(first)
        actual = importlib.metadata.version(second)
        if expected != actual:
            text = f"{expected} and {actual} do not match; run: pip install '{second}=={expected}'"
            yield Finding(f"{first}, {second}", False, text)


def _required_versions(extras: Sequence[str]) -> dict[str, SpecifierSet]:
    """Versions of packages that congrasp needs with any of these extras, by the package's name."""
    required: dict[str, SpecifierSet] = {}
    for text in importlib.metadata.requires("congrasp") or ():
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
            required[requirement.name] = requirement.specifier
    return required


def check_gpu() -> Iterator[Finding]:
    """Reports name, memory and driver of each NVIDIA GPU."""
    if not os.path.exists(NVIDIA_DEVICE):
        yield Finding("gpu", True, "no NVIDIA GPU here; actors use the native engine")
        return
    query = [
        "nvidia-smi",
        "--query-gpu=name,memory.total,memory.used,driver_version",
        "--format=csv,noheader,nounits",
    ]
    try:
        lines = subprocess.run(
            query, capture_output=True, text=True, timeout=30, check=True
        ).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        yield Finding("gpu", False, "nvidia-smi does not respond", "install the NVIDIA driver")
        return
    for number, line in enumerate(lines):
        name, total_mib, used_mib, driver = (column.strip() for column in line.split(","))
        fine = int(driver.split(".")[0]) >= _MIN_DRIVER
        memory = f"{int(total_mib) / 1024:.0f} GiB ({int(used_mib) / 1024:.0f} used)"
        text = f"{name}, {memory}, driver {driver}"
        yield Finding(f"gpu {number}", fine, text, f"{_MIN_DRIVER} or newer is needed; update it")


def check_jax() -> Iterator[Finding]:
    """Checks that JAX finds the machine's devices, and that a small program runs."""
    # A learner may be using this GPU
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax
    import jax.numpy as jnp

    devices = ", ".join(device.device_kind for device in jax.devices())
    backend = jax.default_backend()
    sum_of_squares = jax.jit(lambda x: (x * x).sum())
    computed = float(sum_of_squares(jnp.arange(4.0)))
    lacks_gpu = backend == "cpu" and os.path.exists(NVIDIA_DEVICE)
    remedy = "an NVIDIA GPU is not found; run: pip install 'congrasp[cuda]'"
    if not lacks_gpu:
        remedy = f"a small program gave {computed}, not 14; reinstall it"
    text = f"{jax.__version__} on {backend} ({devices}), a small program runs"
    yield Finding("jax", not lacks_gpu and computed == 14.0, text, remedy)


def check_warp() -> Iterator[Finding]:
    """Checks that Warp finds the GPU, and that a small kernel runs."""
    if not os.path.exists(NVIDIA_DEVICE):
        return
    import warp as wp

    @wp.kernel
    def double(values: wp.array(dtype=float)):  # type: ignore[valid-type]
        i = wp.tid()
        values[i] = 2.0 * values[i]  # type: ignore[index]

    devices = wp.get_cuda_devices()
    if not devices:
        yield Finding(
            "warp", False, "no GPU found; run: pip install 'congrasp[cuda]', and update the driver"
        )
        return
    values = wp.full(4, 3.0, dtype=float, device=devices[0])
    wp.launch(double, dim=4, inputs=[values], device=devices[0])
    total = float(values.numpy().sum())
    text = f"{wp.__version__} ({', '.join(device.name for device in devices)}), a small kernel runs"
    yield Finding("warp", total == 24.0, text, f"it gave {total}, not 24; reinstall it")


def check_ports() -> Iterator[Finding]:
    """Checks the loopback interface and the default ports of a learner."""
    fault = loopback_fault()
    if fault:
        state = f"the loopback interface does not work ({fault})"
        yield Finding("ports", False, state, LOOPBACK_REMEDY)
        return
    last = PORT + len(FLOWS) - 1
    for port in range(PORT, last + 1):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                yield Finding(
                    "ports",
                    True,
                    f"{port} is in use (by another learner?); pass others with --listen",
                )
                return
    yield Finding("ports", True, f"{PORT}-{last} are free")


def check_disk(folder: pathlib.Path) -> Iterator[Finding]:
    """Checks free space of a folder's disk, and the speed of a synchronous write there."""
    try:
        free_gib = shutil.disk_usage(folder).free / 2**30
        if free_gib < _MIN_FREE_GIB:
            need = f"a run needs about {_MIN_FREE_GIB:g} GiB"
            remedy = f"{need}; free some, or pass another --run-dir"
            yield Finding("disk", False, f"{free_gib:.1f} GiB free", remedy)
            return
        speed = _write_speed_mb_s(folder)
    except OSError as error:
        yield Finding(
            "disk",
            False,
            f"{folder.absolute()} cannot be written: {error.strerror}; pass another --run-dir",
        )
        return
    text = f"{free_gib:.1f} GiB free, written at {speed:.0f} MB/s"
    need = f"checkpoints and recordings need about {_MIN_DISK_MB_S:g} MB/s"
    yield Finding("disk", speed >= _MIN_DISK_MB_S, text, f"{need}; pass another --run-dir")


def _write_speed_mb_s(folder: pathlib.Path) -> float:
    """Speed of a synchronous write to a temporary file in a folder, MB/s."""
    sample = os.urandom(_SAMPLE_BYTES)
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        start = time.monotonic()
        file.write(sample)
        file.flush()
        os.fsync(file.fileno())
        return _SAMPLE_BYTES / 1e6 / (time.monotonic() - start)


def check_clock() -> Iterator[Finding]:
    """Checks that the date is plausible, and that it advances as the monotonic clock does."""
    date = time.time()
    monotonic = time.monotonic()
    time.sleep(0.2)
    drift_s = abs((time.time() - date) - (time.monotonic() - monotonic))
    is_behind = date < _MIN_DATE_S
    remedy = f"it jumped by {drift_s:.2f} s in 0.2 s; check the time service"
    if is_behind:
        remedy = "it is years behind; set it (timedatectl set-ntp true)"
    fine = not is_behind and drift_s <= _MAX_DRIFT_S
    yield Finding("clock", fine, time.strftime("%Y-%m-%d %H:%M:%S %Z"), remedy)


def check_certificates(folder: pathlib.Path) -> Iterator[Finding]:
    """Reports the expiry of each certificate in a folder."""
    try:
        listed = certificates(folder)
    except CongraspError as error:
        yield Finding("certificates", False, str(error))
        return
    for certificate in listed:
        text = f"{certificate.name}: expired"
        if certificate.days > 0:
            text = f"{certificate.name}: valid until {certificate.expires:%Y-%m-%d}"
        remedy = (
            "run 'congrasp certs issue --force' to renew it, 'certs init --force' for all of them"
        )
        yield Finding("certificate", certificate.days > _MIN_CERTIFICATE_DAYS, text, remedy)


def check_learner(connect: str, run: str, certs: pathlib.Path | None = None) -> Iterator[Finding]:
    """Checks that a learner responds, and the offset of its clock.

    Args:
      connect: endpoint of the learner.
      run: name of its run.
      certs: folder of certificates for the connection.
    """
    try:
        with urls.connect(connect, "observer", certs=certs, wait=5.0, run=run) as transport:
            ask(transport, run)  # the first request takes longer
            time.sleep(_REQUEST_PAUSE_S)
            start = time.time()
            status = ask(transport, run)
            end = time.time()
    except CongraspError as error:
        yield Finding("learner", False, str(error))
        return
    yield Finding(
        "learner",
        True,
        f"{connect} responds in {1e3 * (end - start):.1f} ms, version {status['version']}",
    )
    # The learner read its clock at some time between the request and the reply.
    offset_s = status["time"] - (start + end) / 2
    uncertainty_s = (end - start) / 2
    fine = abs(offset_s) < _MAX_CLOCK_OFFSET_S + uncertainty_s
    text = f"{offset_s:+.3f} s from this one (± {uncertainty_s:.3f})"
    remedy = "times in recordings will not match; synchronise both clocks"
    yield Finding("its clock", fine, text, remedy)


def doctor(
    connect: str = "",
    run: str = "quickstart",
    folder: pathlib.Path = pathlib.Path(),
    certs: pathlib.Path | None = None,
) -> int:
    """Check this machine and installation: versions, GPU, ports, disk, clock, certificates.

    Prints one line per check, with a remedy if it failed; the exit code is 1 if any failed.
    `congrasp train --preset check` then runs physics, messages, log, server and pictures.

    Args:
      connect: Endpoint of a learner to test; its clock is compared with this machine's.
      run: Name of the learner's run.
      folder: Folder for runs.
      certs: Folder of certificates (congrasp certs) to check, and to connect with as an observer.

    Examples:
      congrasp doctor
      congrasp doctor --connect tcp/10.0.0.5:7447 --run human
    """
    findings = examine(connect, run, folder, certs)
    for finding in findings:
        print(f"{'ok  ' if finding.fine else 'BAD '} {finding.what:13s} {finding.text}")
    fine = all(finding.fine for finding in findings)
    if fine:
        print(
            "Next: congrasp train --preset check --actors 1 (tries physics, messages, log, server "
            "and pictures)"
        )
    return 0 if fine else 1


COMMAND = doctor
