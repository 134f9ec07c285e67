"""`constraints.txt` pins every package of an installation with all extras."""

import importlib.metadata
import pathlib
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import NormalizedName, canonicalize_name

ROOT = pathlib.Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def pins() -> dict[NormalizedName, Requirement]:
    """Pins by name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(each.name): each for each in requirements}


def declared() -> list[Requirement]:
    """Requirements of the package and of its extras."""
    lines = list(PROJECT["dependencies"])
    for extra in PROJECT["optional-dependencies"].values():
        lines += extra
    requirements = [Requirement(line) for line in lines]
    return [each for each in requirements if each.name != PROJECT["name"]]


def applies(requirement: Requirement, extras: set[str]) -> bool:
    """True if a requirement holds on this machine for an installation with these extras."""
    if requirement.marker is None:
        return True
    return any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras))


def installed() -> dict[NormalizedName, str]:
    """Versions of the required packages that are installed here, direct or not."""
    versions: dict[NormalizedName, str] = {}
    seen: set[str] = set()
    waiting = declared()
    while waiting:
        requirement = waiting.pop()
        if str(requirement) in seen:
            continue
        seen.add(str(requirement))
        try:
            package = importlib.metadata.distribution(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            continue
        versions[canonicalize_name(requirement.name)] = package.version
        further = [Requirement(line) for line in package.requires or ()]
        waiting += [each for each in further if applies(each, requirement.extras)]
    return versions


def test_every_required_package_is_pinned():
    assert sorted(set(installed()) - set(pins())) == []


@pytest.mark.parametrize("requirement", declared(), ids=str)
def test_pin_satisfies_a_requirement(requirement):
    pin = pins()[canonicalize_name(requirement.name)]
    (exact,) = pin.specifier
    assert exact.operator == "=="
    assert requirement.specifier.contains(exact.version)
