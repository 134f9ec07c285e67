"""Processor cores and memory available to this process, by the limits of its control groups.

A container limits its processes through Linux control groups (cgroups). Version 2 has one hierarchy
of groups, version 1 a hierarchy for each controller, such as `memory`. A limit of a group holds for
all groups below it. Other systems have none.
"""

import math
import os
import pathlib
import re
from collections.abc import Iterator
from typing import NamedTuple

import psutil

CGROUPS = pathlib.Path("/sys/fs/cgroup")
"""Folder of the kernel's control groups."""
CGROUP_MEMBERSHIP = pathlib.Path("/proc/self/cgroup")
"""File with the control groups of this process."""


class _ControlGroup(NamedTuple):
    """A control group: this process's, or one above it."""

    version: int
    """1 or 2."""
    folder: pathlib.Path
    """Folder with the files of the group's limits and counters."""

    def text(self, v2_file: str, v1_file: str) -> str | None:
        """Returns the text of the group's file in either version; None if it cannot be read."""
        file = self.folder / (v2_file if self.version == 2 else v1_file)
        try:
            return file.read_text(encoding="utf-8").strip()
        except OSError:
            return None


def cores() -> int:
    """Number of cores available to this process, by its affinity and the quotas of its control
    groups, rounded up.
    """
    if hasattr(os, "sched_getaffinity"):
        available: float = len(os.sched_getaffinity(0))
    else:
        available = os.cpu_count() or 1
    for group in _control_groups("cpu"):
        quota = _cpu_quota(group)
        if quota is not None:
            available = min(available, quota)
    return max(1, math.ceil(available))


def memory() -> int:
    """Bytes of memory available to this process: those that are free on the machine and within the
    limits of its control groups.
    """
    available = psutil.virtual_memory().available
    for group in _control_groups("memory"):
        limit = group.text("memory.max", "memory.limit_in_bytes")
        if limit is None or limit == "max":
            continue
        available = min(available, int(limit) - _used_bytes(group))
    return max(0, available)


def memory_kills() -> int:
    """Number of processes in this process's control group that the kernel has killed for lack of
    memory; 0 where it counts none.
    """
    for group in _control_groups("memory"):
        # The local counter leaves out groups below, `memory.events` (before Linux 5.2) does not.
        counters = group.text("memory.events.local", "memory.oom_control")
        if counters is None:
            counters = group.text("memory.events", "memory.oom_control")
        if counters is not None:
            return _counter(counters, "oom_kill")
    return 0


def _control_groups(controller: str) -> Iterator[_ControlGroup]:
    """Yields this process's control group and the groups above it.

    In a container, groups outside of it have no folder.

    Args:
      controller: name of the controller of version 1.
    """
    try:
        lines = CGROUP_MEMBERSHIP.read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        version = 1 if controllers else 2
        if version == 1 and controller not in controllers.split(","):
            continue
        root = CGROUPS / controller if version == 1 else CGROUPS
        path = pathlib.PurePath(name.lstrip("/"))
        for group in (path, *path.parents):
            yield _ControlGroup(version, root / group)


def _cpu_quota(group: _ControlGroup) -> float | None:
    """Cores that a group may use on average; None without a limit.

    The time (µs) that its processes may compute in each period (µs) is a line "quota period" in
    version 2, and two files in version 1.
    """
    text = group.text("cpu.max", "cpu.cfs_quota_us")
    period = group.text("cpu.max", "cpu.cfs_period_us")
    if text is None or period is None:
        return None
    quota = text.split()[0]
    if quota in ("max", "-1"):
        return None
    return int(quota) / int(period.split()[-1])


def _used_bytes(group: _ControlGroup) -> int:
    """Bytes of memory that the processes of a group use, without cached files, which the kernel
    drops when memory is needed.
    """
    used = group.text("memory.current", "memory.usage_in_bytes")
    if used is None:
        return int(psutil.Process().memory_info().rss)
    statistics = group.text("memory.stat", "memory.stat") or ""
    prefix = "total_" if group.version == 1 else ""
    cached = _counter(statistics, f"{prefix}active_file")
    cached += _counter(statistics, f"{prefix}inactive_file")
    return int(used) - cached


def _counter(text: str, name: str) -> int:
    """Value of a counter in lines "name value"; 0 without it."""
    match = re.search(rf"^{name} (\d+)$", text, re.MULTILINE)
    return int(match[1]) if match else 0
