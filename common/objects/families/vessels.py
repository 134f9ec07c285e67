"""Household vessels: hollow ones with a floor and wall segments, closed ones of solid pieces."""

import functools
import itertools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import (
    Builder,
    Draft,
    Rng,
    arc,
    grid,
    hull,
    lathe,
    moved,
    shell,
    smooth,
    sweep,
    vessel,
)
from congrasp.common.objects.spec import Piece

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)
_CERAMIC = (900.0, 1800.0)
_METAL = (800.0, 2200.0)
_PLASTIC = (300.0, 900.0)
"""Densities of walls, which are thicker than those of real vessels."""
_FILLED = (250.0, 1000.0)
"""Density of closed vessels with their content."""
_FLAT_SIDE = np.cos(np.pi / 16)
"""Distance of a side of a 16-sided polygon from its centre, in radii."""


@_family
def dish(rng: Rng) -> Draft:
    """A bowl with a curved wall, up to 17 cm wide."""
    top = rng.uniform(0.05, 0.085)
    height = rng.uniform(0.035, 0.08)
    wall = rng.uniform(0.004, 0.007)
    bottom = top * rng.uniform(0.4, 0.65)
    bend = rng.uniform(0.45, 0.9)
    middle = bottom + (top - bottom) * 0.45**bend
    pieces = vessel([(0, bottom), (0.45 * height, middle), (height, top)], wall, 6)
    return Draft(tuple(pieces), density=_CERAMIC)


@_family
def plate(rng: Rng) -> Draft:
    """A flat floor and a rim that rises; from a saucer to a soup plate."""
    radius = rng.uniform(0.06, 0.12)
    height = rng.uniform(0.017, 0.035)
    wall = rng.uniform(0.004, 0.006)
    pieces = vessel([(0, radius * rng.uniform(0.55, 0.75)), (height, radius)], wall, 10)
    return Draft(tuple(pieces), density=_CERAMIC)


@_family
def hollow_mug(rng: Rng) -> Draft:
    """A hollow mug with a handle of three rods or a bow of four pieces."""
    radius = rng.uniform(0.032, 0.048)
    height = rng.uniform(0.07, 0.115)
    wall = rng.uniform(0.004, 0.006)
    body = vessel([(0, radius * rng.uniform(0.75, 1.0)), (height, radius)], wall, 7)
    thick = rng.uniform(0.005, 0.008)
    handle = _bow(rng, radius, 0.5 * height, 0.35 * height, thick)
    return Draft(
        (*body, *handle),
        ("body", "handle"),
        draft.either(rng),
        density=_CERAMIC,
    )


@_family
def pitcher(rng: Rng) -> Draft:
    """A tall jug with a handle, some with a spout."""
    radius = rng.uniform(0.04, 0.06)
    height = rng.uniform(0.13, 0.235)
    wall = rng.uniform(0.004, 0.006)
    top = radius * rng.uniform(0.8, 1.1)
    body = vessel([(0, radius), (height, top)], wall, 7)
    if rng.random() < 0.6:
        lip = 0.9 * top
        corners = grid((-lip,), (-0.02, 0.02), (0.85 * height, height))
        tip = (-lip - rng.uniform(0.015, 0.03), 0, height)
        body.append(hull(corners, [tip]))
    thick = rng.uniform(0.009, 0.012)
    handle = _bow(rng, radius, 0.5 * height, 0.36 * height, thick)
    return Draft(
        (*body, *handle),
        ("body", "handle"),
        draft.either(rng),
        density=_PLASTIC,
    )


@_family
def skillet(rng: Rng) -> Draft:
    """A frying pan with a long handle."""
    radius = rng.uniform(0.05, 0.1)
    height = rng.uniform(0.025, 0.05)
    wall = rng.uniform(0.0035, 0.006)
    body = vessel([(0, radius * rng.uniform(0.75, 0.95)), (height, radius)], wall, 9)
    length = rng.uniform(0.09, 0.16)
    rise = rng.uniform(0.0, 0.035)
    thick = rng.uniform(0.015, 0.028)
    start = (radius - wall, 0.7 * height)
    end = (radius + length, 0.7 * height + rise)
    handle = _grip(rng, start, end, thick)
    return Draft((*body, *handle), ("pan", "handle"), (False, True), density=_METAL)


@_family
def pot(rng: Rng) -> Draft:
    """A saucepan with two ears or one long handle, some with a lid and a knob."""
    radius = rng.uniform(0.045, 0.085)
    height = rng.uniform(0.05, 0.11)
    wall = rng.uniform(0.004, 0.006)
    pieces = vessel([(0, radius), (height, radius)], wall, 9)
    if rng.random() < 0.5:
        reach = radius + rng.uniform(0.09, 0.14)
        thick = rng.uniform(0.015, 0.025)
        pieces += _grip(rng, (radius - wall, 0.75 * height), (reach, 0.85 * height), thick)
    else:
        half = (rng.uniform(0.012, 0.02), rng.uniform(0.02, 0.035), rng.uniform(0.004, 0.007))
        x = radius * _FLAT_SIDE - wall + half[0]
        pieces += [draft.box(half, (side * x, 0, 0.8 * height), part=1) for side in (-1, 1)]
    if rng.random() < 0.5:
        top = height + 0.005
        knob = rng.uniform(0.012, 0.02)
        knob_top = top + rng.uniform(0.018, 0.03)
        pieces.append(draft.cylinder((0, 0, height), (0, 0, top), radius))
        pieces.append(draft.cylinder((0, 0, top), (0, 0, knob_top), knob, part=1))
    return Draft(tuple(pieces), ("body", "handles"), draft.either(rng), density=_METAL)


@_family
def goblet(rng: Rng) -> Draft:
    """A hollow glass on a stem."""
    radius = rng.uniform(0.03, 0.045)
    high = rng.uniform(0.06, 0.1)
    stem = rng.uniform(0.04, 0.09)
    wall = 0.004
    profile = [(0, 0.4 * radius), (0.45 * high, radius), (high, radius * rng.uniform(0.75, 1.0))]
    bowl = [moved(piece, (0, 0, stem)) for piece in vessel(profile, wall, 6)]
    foot = rng.uniform(0.028, 0.04)
    pieces = (
        *bowl,
        draft.cylinder((0, 0, 0.004), (0, 0, stem), rng.uniform(0.004, 0.007), part=1),
        draft.cylinder((0, 0, -0.003), (0, 0, 0.004), foot, part=1),
    )
    return Draft(pieces, ("bowl", "stem"), draft.either(rng), density=_CERAMIC)


@_family
def vase(rng: Rng) -> Draft:
    """A hollow vessel under a random smooth profile."""
    height = rng.uniform(0.08, 0.2)
    wall = rng.uniform(0.004, 0.007)
    radii = smooth(rng, 3, rng.uniform(0.022, 0.035), rng.uniform(0.035, 0.055))
    profile = list(zip(np.linspace(0, height, 3), radii, strict=True))
    body = vessel(profile, wall, 6, squash=rng.uniform(0.7, 1.0))
    return Draft(tuple(body), density=_CERAMIC)


@_family
def tray(rng: Rng) -> Draft:
    """An open box of a floor and four walls, which may lean outwards."""
    x = rng.uniform(0.035, 0.06)
    y = rng.uniform(0.05, 0.11)
    height = rng.uniform(0.025, 0.09)
    wall = rng.uniform(0.004, 0.007)
    lean = rng.uniform(0.0, 0.25) * height

    def corners(z: float, outset: float, inset: float) -> np.ndarray:
        """Corners (4, 3) of a wall at height z: of its outside, or `inset` metres inwards."""
        half_x = x + outset - inset
        half_y = y + outset - inset
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return np.array([(sign_x * half_x, sign_y * half_y, z) for sign_x, sign_y in signs])

    outside = np.stack([corners(0.0, 0.0, 0.0), corners(height, lean, 0.0)])
    inside = np.stack([corners(0.0, 0.0, wall), corners(height, lean, wall)])
    walls = []
    for i in range(4):
        side = [i, (i + 1) % 4]
        walls.append(hull(outside[:, side].reshape(-1, 3), inside[:, side].reshape(-1, 3)))
    floor = hull(corners(0.0, 0.0, wall), corners(wall, wall / height * lean, wall))
    return Draft((floor, *walls), density=_PLASTIC)


@_family
def roll(rng: Rng) -> Draft:
    """A thick ring, like a roll of tape or paper."""
    inner = rng.uniform(0.012, 0.035)
    outer = inner + rng.uniform(0.008, 0.03)
    half = rng.uniform(0.01, 0.055)
    pieces = shell([(-half, outer, inner), (half, outer, inner)], 8)
    return Draft(tuple(pieces), density=(150.0, 900.0))


@_family
def can(rng: Rng) -> Draft:
    """A tin, from tuna to coffee."""
    half = rng.uniform(0.016, 0.085)
    radius = rng.uniform(0.025, 0.051)
    return Draft((draft.cylinder((0, 0, -half), (0, 0, half), radius),), density=_FILLED)


@_family
def jar(rng: Rng) -> Draft:
    """A glass with a lid."""
    radius = rng.uniform(0.028, 0.048)
    height = rng.uniform(0.05, 0.13)
    lid = rng.uniform(0.012, 0.025)
    lid_radius = radius * rng.uniform(0.8, 1.06)
    pieces = (
        draft.cylinder((0, 0, 0), (0, 0, height), radius),
        draft.cylinder((0, 0, height), (0, 0, height + lid), lid_radius, part=1),
    )
    grasp_jar = bool(rng.random() < 0.75)
    return Draft(pieces, ("jar", "lid"), (grasp_jar, not grasp_jar), density=_FILLED)


@_family
def flask(rng: Rng) -> Draft:
    """A closed bottle with shoulders and a cap, round or oval."""
    radius = rng.uniform(0.025, 0.046)
    height = rng.uniform(0.1, 0.24)
    squash = rng.choice([1.0, rng.uniform(0.5, 0.9)])
    neck = radius * squash * rng.uniform(0.35, 0.7)
    shoulder = rng.uniform(0.55, 0.78) * height
    waist = radius * rng.uniform(0.85, 1.02)
    body = [
        (0, 0.94 * radius),
        (0.04 * height, radius),
        (0.5 * shoulder, waist),
        (shoulder, radius),
        (0.5 * shoulder + 0.42 * height, 0.55 * radius + 0.45 * neck),
        (0.87 * height, neck),
    ]
    pieces = lathe(body, squash=squash)
    pieces.append(draft.cylinder((0, 0, 0.87 * height), (0, 0, height), 1.1 * neck, part=1))
    return Draft(tuple(pieces), ("body", "cap"), (True, False), density=_FILLED)


@_family
def spray_bottle(rng: Rng) -> Draft:
    """A bottle with a pistol head and a trigger."""
    radius = rng.uniform(0.028, 0.042)
    height = rng.uniform(0.1, 0.16)
    squash = rng.uniform(0.65, 1.0)
    neck = 0.4 * radius
    top = height + rng.uniform(0.02, 0.035)
    length = rng.uniform(0.03, 0.05)
    half = rng.uniform(0.01, 0.015)
    head = grid((-0.03,), (-half, half), (top, top + 0.022))
    nose = grid((length,), (-0.7 * half, 0.7 * half), (top + 0.006, top + 0.024))
    trigger_root = (0.5 * length, 0, top + 0.01)
    trigger_tip = (0.8 * length, 0, top - rng.uniform(0.025, 0.04))
    profile = [
        (0, 0.95 * radius),
        (0.05 * height, radius),
        (0.6 * height, radius),
        (height, neck),
    ]
    pieces = (
        *lathe(profile, squash=squash),
        draft.cylinder((0, 0, height), (0, 0, top + 0.006), neck, part=1),
        hull(head, nose, part=1),
        draft.capsule(trigger_root, trigger_tip, 0.005, part=1),
    )
    grasp_bottle = bool(rng.random() < 0.7)
    return Draft(pieces, ("bottle", "head"), (grasp_bottle, not grasp_bottle), density=_FILLED)


def _bow(rng: Rng, radius: float, middle: float, half: float, thick: float) -> list[Piece]:
    """A handle next to a wall of this radius, from a half length below the middle to one above, as
    part 1.
    """
    reach = rng.uniform(0.025, 0.035) + 1.5 * thick
    root = radius * rng.uniform(0.9, 0.94)
    if rng.random() < 0.5:
        path = arc(-0.5 * np.pi, 0.5 * np.pi, 5, (reach, half), (root, 0, middle))
        return sweep(path, (0, 1, 0), 2 * thick, rng.uniform(2.0, 4.0) * thick, part=1)
    corners = [
        (root, 0, middle - half),
        (radius + reach, 0, middle - half),
        (radius + reach, 0, middle + half),
        (root, 0, middle + half),
    ]
    return [draft.capsule(a, b, thick, part=1) for a, b in itertools.pairwise(corners)]


def _grip(
    rng: Rng, start: tuple[float, float], end: tuple[float, float], thick: float
) -> list[Piece]:
    """A long handle from one place (x, z) to another, thicker at its end, as part 1."""
    x0, z0 = start
    x1, z1 = end
    if rng.random() < 0.4:
        return [draft.capsule((x0, 0, z0), (x1, 0, z1), thick / 2, part=1)]
    bend = (x0 + 0.4 * (x1 - x0), 0, z0 + 0.3 * (z1 - z0))
    path = np.array([(x0, 0, z0), bend, (x1, 0, z1)])
    widths = thick * np.array([0.5, 0.9, 1.0])
    thicknesses = thick * np.array([0.9, 1.2, 1.2])
    return sweep(path, (0, 1, 0), widths, thicknesses, rounded=True, part=1)
