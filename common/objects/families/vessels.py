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
_CERAMIC, _METAL, _PLASTIC = (900.0, 1800.0), (800.0, 2200.0), (300.0, 900.0)
"""Densities of walls, which are thicker than those of real vessels."""
_FILLED = (250.0, 1000.0)
# Distance of a side of a 16-sided polygon from its centre, in radii
_FLAT_SIDE = np.cos(np.pi / 16)


@_family
def dish(rng: Rng) -> Draft:
    """A bowl with a curved wall, up to 17 cm wide."""
    top, height, wall = (
        rng.uniform(0.05, 0.085),
        rng.uniform(0.035, 0.08),
        rng.uniform(0.004, 0.007),
    )
    bottom, bend = top * rng.uniform(0.4, 0.65), rng.uniform(0.45, 0.9)
    middle = bottom + (top - bottom) * 0.45**bend
    pieces = vessel([(0, bottom), (0.45 * height, middle), (height, top)], wall, 6)
    return Draft(tuple(pieces), density=_CERAMIC)


@_family
def plate(rng: Rng) -> Draft:
    """A flat floor and a rim that rises; from a saucer to a soup plate."""
    radius, height, wall = (
        rng.uniform(0.06, 0.12),
        rng.uniform(0.017, 0.035),
        rng.uniform(0.004, 0.006),
    )
    pieces = vessel([(0, radius * rng.uniform(0.55, 0.75)), (height, radius)], wall, 10)
    return Draft(tuple(pieces), density=_CERAMIC)


@_family
def hollow_mug(rng: Rng) -> Draft:
    """A hollow mug with a handle of three rods or a bow of four pieces."""
    radius, height, wall = (
        rng.uniform(0.032, 0.048),
        rng.uniform(0.07, 0.115),
        rng.uniform(0.004, 0.006),
    )
    body = vessel([(0, radius * rng.uniform(0.75, 1.0)), (height, radius)], wall, 7)
    return Draft(
        (*body, *_bow(rng, radius, 0.5 * height, 0.35 * height, rng.uniform(0.005, 0.008))),
        ("body", "handle"),
        draft.either(rng),
        (),
        _CERAMIC,
    )


@_family
def pitcher(rng: Rng) -> Draft:
    """A tall jug with a handle, some with a spout."""
    radius, height, wall = (
        rng.uniform(0.04, 0.06),
        rng.uniform(0.13, 0.235),
        rng.uniform(0.004, 0.006),
    )
    top = radius * rng.uniform(0.8, 1.1)
    body = vessel([(0, radius), (height, top)], wall, 7)
    if rng.random() < 0.6:
        lip = 0.9 * top
        corners = [(-lip, y, z) for y in (-0.02, 0.02) for z in (0.85 * height, height)]
        body.append(hull(corners, [(-lip - rng.uniform(0.015, 0.03), 0, height)]))
    return Draft(
        (*body, *_bow(rng, radius, 0.5 * height, 0.36 * height, rng.uniform(0.009, 0.012))),
        ("body", "handle"),
        draft.either(rng),
        (),
        _PLASTIC,
    )


@_family
def skillet(rng: Rng) -> Draft:
    """A frying pan with a long handle."""
    radius, height, wall = (
        rng.uniform(0.05, 0.1),
        rng.uniform(0.025, 0.05),
        rng.uniform(0.0035, 0.006),
    )
    body = vessel([(0, radius * rng.uniform(0.75, 0.95)), (height, radius)], wall, 9)
    length, rise, thick = (
        rng.uniform(0.09, 0.16),
        rng.uniform(0.0, 0.035),
        rng.uniform(0.015, 0.028),
    )
    handle = _grip(
        rng, (radius - wall, 0.7 * height), (radius + length, 0.7 * height + rise), thick
    )
    return Draft((*body, *handle), ("pan", "handle"), (False, True), (), _METAL)


@_family
def pot(rng: Rng) -> Draft:
    """A saucepan with two ears or one long handle, some with a lid and a knob."""
    radius, height, wall = (
        rng.uniform(0.045, 0.085),
        rng.uniform(0.05, 0.11),
        rng.uniform(0.004, 0.006),
    )
    pieces = vessel([(0, radius), (height, radius)], wall, 9)
    if rng.random() < 0.5:
        reach = radius + rng.uniform(0.09, 0.14)
        pieces += _grip(
            rng, (radius - wall, 0.75 * height), (reach, 0.85 * height), rng.uniform(0.015, 0.025)
        )
    else:
        half = (rng.uniform(0.012, 0.02), rng.uniform(0.02, 0.035), rng.uniform(0.004, 0.007))
        place = radius * _FLAT_SIDE - wall + half[0]
        pieces += [draft.box(half, (side * place, 0, 0.8 * height), part=1) for side in (-1, 1)]
    if rng.random() < 0.5:
        top, knob = height + 0.005, rng.uniform(0.012, 0.02)
        pieces.append(draft.cylinder((0, 0, height), (0, 0, top), radius))
        pieces.append(
            draft.cylinder((0, 0, top), (0, 0, top + rng.uniform(0.018, 0.03)), knob, part=1)
        )
    return Draft(tuple(pieces), ("body", "handles"), draft.either(rng), (), _METAL)


@_family
def goblet(rng: Rng) -> Draft:
    """A hollow glass on a stem."""
    radius, high, stem, wall = (
        rng.uniform(0.03, 0.045),
        rng.uniform(0.06, 0.1),
        rng.uniform(0.04, 0.09),
        0.004,
    )
    profile = [(0, 0.4 * radius), (0.45 * high, radius), (high, radius * rng.uniform(0.75, 1.0))]
    bowl = [moved(piece, (0, 0, stem)) for piece in vessel(profile, wall, 6)]
    foot = rng.uniform(0.028, 0.04)
    pieces = (
        *bowl,
        draft.cylinder((0, 0, 0.004), (0, 0, stem), rng.uniform(0.004, 0.007), part=1),
        draft.cylinder((0, 0, -0.003), (0, 0, 0.004), foot, part=1),
    )
    return Draft(pieces, ("bowl", "stem"), draft.either(rng), (), _CERAMIC)


@_family
def vase(rng: Rng) -> Draft:
    """A hollow vessel under a random smooth profile."""
    height, wall = rng.uniform(0.08, 0.2), rng.uniform(0.004, 0.007)
    profile = smooth(rng, 3, rng.uniform(0.022, 0.035), rng.uniform(0.035, 0.055))
    body = vessel(
        list(zip(np.linspace(0, height, 3), profile, strict=True)),
        wall,
        6,
        squash=rng.uniform(0.7, 1.0),
    )
    return Draft(tuple(body), density=_CERAMIC)


@_family
def tray(rng: Rng) -> Draft:
    """An open box of a floor and four walls, which may lean outwards."""
    x, y, height = rng.uniform(0.035, 0.06), rng.uniform(0.05, 0.11), rng.uniform(0.025, 0.09)
    wall, lean = rng.uniform(0.004, 0.007), rng.uniform(0.0, 0.25) * height
    levels = ((0.0, 0.0), (height, lean))

    def corners(inset: float, levels: tuple[tuple[float, float], ...] = levels) -> np.ndarray:
        """Corners (2, 4, 3) of the outside of the walls, or of their inside."""
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return np.array(
            [[(s * (x + o - inset), t * (y + o - inset), z) for s, t in signs] for z, o in levels]
        )

    outside, inside = corners(0.0), corners(wall)
    walls = [
        hull(
            outside[:, [i, (i + 1) % 4]].reshape(-1, 3), inside[:, [i, (i + 1) % 4]].reshape(-1, 3)
        )
        for i in range(4)
    ]
    floor = hull(corners(wall, ((0.0, 0.0), (wall, wall / height * lean))).reshape(-1, 3))
    return Draft((floor, *walls), density=_PLASTIC)


@_family
def roll(rng: Rng) -> Draft:
    """A thick ring, like a roll of tape or paper."""
    inner = rng.uniform(0.012, 0.035)
    outer, half = inner + rng.uniform(0.008, 0.03), rng.uniform(0.01, 0.055)
    return Draft(
        tuple(shell([(-half, outer, inner), (half, outer, inner)], 8)), density=(150.0, 900.0)
    )


@_family
def can(rng: Rng) -> Draft:
    """A tin, from tuna to coffee."""
    half = rng.uniform(0.016, 0.085)
    return Draft(
        (draft.cylinder((0, 0, -half), (0, 0, half), rng.uniform(0.025, 0.051)),), density=_FILLED
    )


@_family
def jar(rng: Rng) -> Draft:
    """A glass with a lid."""
    radius, height, lid = (
        rng.uniform(0.028, 0.048),
        rng.uniform(0.05, 0.13),
        rng.uniform(0.012, 0.025),
    )
    pieces = (
        draft.cylinder((0, 0, 0), (0, 0, height), radius),
        draft.cylinder(
            (0, 0, height), (0, 0, height + lid), radius * rng.uniform(0.8, 1.06), part=1
        ),
    )
    return Draft(
        pieces, ("jar", "lid"), (True, False) if rng.random() < 0.75 else (False, True), (), _FILLED
    )


@_family
def flask(rng: Rng) -> Draft:
    """A closed bottle with shoulders and a cap, round or oval."""
    radius, height, squash = (
        rng.uniform(0.025, 0.046),
        rng.uniform(0.1, 0.24),
        rng.choice([1.0, rng.uniform(0.5, 0.9)]),
    )
    neck, shoulder = radius * squash * rng.uniform(0.35, 0.7), rng.uniform(0.55, 0.78) * height
    waist = radius * rng.uniform(0.85, 1.02)
    body = [
        (0, 0.94 * radius),
        (0.04 * height, radius),
        (0.5 * shoulder, waist),
        (shoulder, radius),
    ]
    body += [(0.5 * shoulder + 0.42 * height, 0.55 * radius + 0.45 * neck), (0.87 * height, neck)]
    pieces = lathe(body, squash=squash)
    pieces.append(draft.cylinder((0, 0, 0.87 * height), (0, 0, height), 1.1 * neck, part=1))
    return Draft(tuple(pieces), ("body", "cap"), (True, False), (), _FILLED)


@_family
def spray_bottle(rng: Rng) -> Draft:
    """A bottle with a pistol head and a trigger."""
    radius, height, squash = (
        rng.uniform(0.028, 0.042),
        rng.uniform(0.1, 0.16),
        rng.uniform(0.65, 1.0),
    )
    neck, top = 0.4 * radius, height + rng.uniform(0.02, 0.035)
    length, half = rng.uniform(0.03, 0.05), rng.uniform(0.01, 0.015)
    head = [(-0.03, y, top + z) for y in (-half, half) for z in (0.0, 0.022)]
    nose = [(length, 0.7 * y, top + z) for y in (-half, half) for z in (0.006, 0.024)]
    trigger = (0.5 * length, 0, top + 0.01), (0.8 * length, 0, top - rng.uniform(0.025, 0.04))
    pieces = (
        *lathe(
            [(0, 0.95 * radius), (0.05 * height, radius), (0.6 * height, radius), (height, neck)],
            squash=squash,
        ),
        draft.cylinder((0, 0, height), (0, 0, top + 0.006), neck, part=1),
        hull(head, nose, part=1),
        draft.capsule(*trigger, 0.005, part=1),
    )
    return Draft(
        pieces,
        ("bottle", "head"),
        (True, False) if rng.random() < 0.7 else (False, True),
        (),
        _FILLED,
    )


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
    ]
    corners.append((root, 0, middle + half))
    return [draft.capsule(a, b, thick, part=1) for a, b in itertools.pairwise(corners)]


def _grip(
    rng: Rng, start: tuple[float, float], end: tuple[float, float], thick: float
) -> list[Piece]:
    """A long handle from one place (x, z) to another, thicker at its end, as part 1."""
    (x0, z0), (x1, z1) = start, end
    if rng.random() < 0.4:
        return [draft.capsule((x0, 0, z0), (x1, 0, z1), thick / 2, part=1)]
    path = np.array([(x0, 0, z0), (x0 + 0.4 * (x1 - x0), 0, z0 + 0.3 * (z1 - z0)), (x1, 0, z1)])
    return sweep(
        path,
        (0, 1, 0),
        thick * np.array([0.5, 0.9, 1.0]),
        thick * np.array([0.9, 1.2, 1.2]),
        rounded=True,
        part=1,
    )
