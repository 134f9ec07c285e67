"""Cores and memory of this process by its control groups."""

import pytest

from congrasp.common.runtime import resources
from congrasp.common.runtime.resources import cores, memory, memory_kills


@pytest.fixture
def control_groups(tmp_path, monkeypatch):
    """Function that replaces the control groups of this process by files."""

    def replace(membership, files):
        monkeypatch.setattr(resources, "CGROUPS", tmp_path)
        monkeypatch.setattr(resources, "CGROUP_MEMBERSHIP", tmp_path / "membership")
        (tmp_path / "membership").write_text(membership)
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(f"{text}\n")

    return replace


@pytest.mark.parametrize(
    ("membership", "files", "expected"),
    [
        (
            "0::/jobs/mine",
            {"jobs/mine/cpu.max": ("50000 100000"), "jobs/mine/memory.max": "max"},
            (1, None),
        ),
        (
            "0::/jobs/mine",
            {"jobs/mine/cpu.max": ("max 100000"), "jobs/cpu.max": "150000 100000"},
            (2, None),
        ),
        # Less than this process uses
        ("0::/", {"cpu.max": "800000 100000", "memory.max": f"{8 << 20}"}, (3, 0)),
        (
            "5:memory:/docker/1\n4:cpu,cpuacct:/docker/1",
            {
                "cpu/cpu.cfs_quota_us": "110000",
                "cpu/cpu.cfs_period_us": "100000",
                "memory/docker/1/memory.limit_in_bytes": f"{8 << 20}",
            },
            (2, 0),
        ),
        ("4:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, (3, None)),
        ("", {}, (3, None)),
    ],
)
def test_quotas_of_control_groups_count(membership, files, expected, control_groups, monkeypatch):
    """Those of the process's group and of all above it, in both versions, on a machine with three
    cores.
    """
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda pid: {0, 1, 2})
    control_groups(membership, files)
    assert cores() == expected[0]
    assert memory() == expected[1] if expected[1] is not None else memory() > 1 << 26


@pytest.mark.parametrize(
    ("membership", "files"),
    [
        (
            "0::/mine",
            {
                "memory.max": "20000000",
                "memory.current": "15000000",
                "memory.stat": "anon 1\nactive_file 1000000\ninactive_file 2000000",
                "mine/memory.max": "max",
                "mine/memory.current": "1000000",
            },
        ),
        (
            "4:memory:/",
            {
                "memory/memory.limit_in_bytes": "20000000",
                "memory/memory.usage_in_bytes": "15000000",
                "memory/memory.stat": "active_file 7\ntotal_active_file 1000000\n"
                "total_inactive_file 2000000",
            },
        ),
    ],
)
def test_memory_is_what_the_group_leaves(membership, files, control_groups):
    """Other processes of the group use it as well; cached files do not count."""
    control_groups(membership, files)
    assert memory() == 20_000_000 - 12_000_000


@pytest.mark.parametrize(
    ("membership", "files", "kills"),
    [
        (
            "0::/jobs/mine",
            {
                "jobs/mine/memory.events.local": "oom 3\noom_kill 2\noom_group_kill 0",
                "jobs/mine/memory.events": "oom 3\noom_kill 2",
                "jobs/memory.events.local": "oom_kill 1",
                "jobs/memory.events": "oom_kill 9",  # also of other jobs
            },
            2,
        ),
        ("0::/mine", {"mine/memory.events": "oom 1\noom_kill 1", "memory.events": "oom_kill 5"}, 1),
        (
            "4:memory:/docker/1",  # of which the container sees only its own, as the root
            {"memory/memory.oom_control": "oom_kill_disable 0\nunder_oom 0\noom_kill 4"},
            4,
        ),
        ("0::/", {}, 0),
    ],
)
def test_kills_are_those_of_the_own_group(membership, files, kills, control_groups):
    control_groups(membership, files)
    assert memory_kills() == kills
