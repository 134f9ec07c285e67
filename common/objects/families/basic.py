"""Simple objects: shapes, tools and vessels in outline.

Do not change their draws: evaluation's held-out objects come from them.
"""

import functools
import itertools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import Builder, Draft, Rng
from congrasp.common.objects.spec import Piece

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)


@_family
def box(rng: Rng) -> Draft:
    """A cuboid with at least one side under 8 cm."""
    half = [rng.uniform(0.012, 0.04), rng.uniform(0.015, 0.045), rng.uniform(0.02, 0.11)]
    return Draft((draft.box(tuple(rng.permutation(half))),))


@_family
def cylinder(rng: Rng) -> Draft:
    """A cylinder, from a flat tin to a long rod."""
    half = rng.uniform(0.015, 0.11)
    return Draft((draft.cylinder((0, 0, -half), (0, 0, half), rng.uniform(0.012, 0.042)),))


@_family
def capsule(rng: Rng) -> Draft:
    """A rod with round ends."""
    half = rng.uniform(0.01, 0.08)
    return Draft((draft.capsule((0, 0, -half), (0, 0, half), rng.uniform(0.012, 0.04)),))


@_family
def ellipsoid(rng: Rng) -> Draft:
    """An ellipsoid, from a pebble to a rugby ball."""
    radii = [rng.uniform(0.015, 0.04), rng.uniform(0.02, 0.045), rng.uniform(0.025, 0.1)]
    return Draft((draft.ellipsoid(tuple(rng.permutation(radii))),))


@_family
def ball(rng: Rng) -> Draft:
    """A near-sphere, such as a fruit."""
    return Draft((draft.ellipsoid(tuple(rng.uniform(0.02, 0.043) * rng.uniform(0.95, 1.05, 3))),))


@_family
def bottle(rng: Rng) -> Draft:
    """A body, round shoulders and a neck."""
    radius, half = rng.uniform(0.022, 0.038), rng.uniform(0.03, 0.065)
    shoulder, neck = radius * rng.uniform(0.5, 1.0), rng.uniform(0.025, 0.05)
    pieces = (
        draft.cylinder((0, 0, -half), (0, 0, half), radius),
        draft.ellipsoid((radius, radius, shoulder), (0, 0, half)),
        draft.cylinder(
            (0, 0, half), (0, 0, half + shoulder + neck), radius * rng.uniform(0.35, 0.55), part=1
        ),
    )
    grasp_body = bool(rng.random() < 0.75)
    return Draft(pieces, ("body", "neck"), (grasp_body, not grasp_body))


@_family
def mug(rng: Rng) -> Draft:
    """A body with a handle of three rods at its side."""
    radius, half, thick = (
        rng.uniform(0.028, 0.04),
        rng.uniform(0.035, 0.055),
        rng.uniform(0.006, 0.009),
    )
    high, reach = half * rng.uniform(0.5, 0.75), radius + rng.uniform(0.024, 0.038)
    pieces = (
        draft.cylinder((0, 0, -half), (0, 0, half), radius),
        draft.capsule((radius, 0, high), (reach, 0, high), thick, part=1),
        draft.capsule((radius, 0, -high), (reach, 0, -high), thick, part=1),
        draft.capsule((reach, 0, -high), (reach, 0, high), thick, part=1),
    )
    return Draft(pieces, ("body", "handle"), draft.either(rng))


@_family
def teapot(rng: Rng) -> Draft:
    """A round body with a spout and a handle of two rods."""
    radius, height, thick = (
        rng.uniform(0.034, 0.043),
        rng.uniform(0.03, 0.042),
        rng.uniform(0.007, 0.009),
    )
    ear, rise = radius + rng.uniform(0.028, 0.04), height * rng.uniform(0.5, 0.75)
    tip = (-radius - rng.uniform(0.015, 0.035), 0, height * rng.uniform(0.2, 0.8))
    pieces = (
        draft.ellipsoid((radius, radius, height)),
        draft.capsule((-0.7 * radius, 0, -0.2 * height), tip, rng.uniform(0.007, 0.01)),
        draft.capsule((0.6 * radius, 0, rise), (ear, 0, 0.4 * rise), thick, part=1),
        draft.capsule((ear, 0, 0.4 * rise), (0.75 * radius, 0, -0.6 * rise), thick, part=1),
    )
    return Draft(pieces, ("body", "handle"), (False, True), heavier=2.0)


@_family
def wineglass(rng: Rng) -> Draft:
    """A bowl on a stem on a foot."""
    radius, high, stem = (
        rng.uniform(0.026, 0.036),
        rng.uniform(0.032, 0.045),
        rng.uniform(0.06, 0.09),
    )
    pieces = (
        draft.ellipsoid((radius, radius, high), (0, 0, stem + 0.9 * high)),
        draft.capsule((0, 0, 0), (0, 0, stem), rng.uniform(0.006, 0.009), part=1),
        draft.cylinder((0, 0, -0.004), (0, 0, 0.004), rng.uniform(0.028, 0.036), part=1),
    )
    return Draft(pieces, ("bowl", "stem"), draft.either(rng))


@_family
def knife(rng: Rng) -> Draft:
    """A handle and a thin blade."""
    grip, blade = rng.uniform(0.045, 0.06), rng.uniform(0.045, 0.06)
    half = (grip, rng.uniform(0.012, 0.017), rng.uniform(0.009, 0.014))
    edge = (blade, half[1] * rng.uniform(0.8, 1.4), rng.uniform(0.002, 0.0035))
    offset = (grip + blade, half[1] * rng.uniform(-0.3, 0.3), 0)
    return Draft(
        (draft.box(half), draft.box(edge, offset, part=1)),
        ("handle", "blade"),
        (True, False),
        (1, 3),
    )


@_family
def hammer(rng: Rng) -> Draft:
    """A handle and a heavy head across it."""
    length, radius = rng.uniform(0.12, 0.2), rng.uniform(0.009, 0.014)
    half = (rng.uniform(0.012, 0.018), rng.uniform(0.03, 0.05), rng.uniform(0.012, 0.018))
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), radius),
        draft.box(half, (length, rng.uniform(-0.01, 0.01), 0), part=1),
    )
    return Draft(pieces, ("handle", "head"), (True, False), (1, 3), heavier=2.2)


@_family
def screwdriver(rng: Rng) -> Draft:
    """A thick handle and a thin shaft."""
    half, shaft = rng.uniform(0.038, 0.055), rng.uniform(0.06, 0.1)
    pieces = (
        draft.cylinder((-half, 0, 0), (half, 0, 0), rng.uniform(0.012, 0.018)),
        draft.capsule((half, 0, 0), (half + shaft, 0, 0), rng.uniform(0.0035, 0.0055), part=1),
    )
    return Draft(pieces, ("handle", "shaft"), (True, False), (1, 3))


@_family
def flashlight(rng: Rng) -> Draft:
    """A tube with a wider head."""
    half, head = rng.uniform(0.04, 0.065), rng.uniform(0.024, 0.04)
    pieces = (
        draft.cylinder((0, 0, -half), (0, 0, half), rng.uniform(0.011, 0.017)),
        draft.cylinder((0, 0, half), (0, 0, half + head), rng.uniform(0.02, 0.029), part=1),
    )
    return Draft(pieces, ("body", "head"), (True, False))


@_family
def lightbulb(rng: Rng) -> Draft:
    """A round head and a socket."""
    radius, high, socket = (
        rng.uniform(0.026, 0.037),
        rng.uniform(0.03, 0.042),
        rng.uniform(0.025, 0.04),
    )
    pieces = (
        draft.ellipsoid((radius, radius, high)),
        draft.cylinder(
            (0, 0, -high - socket), (0, 0, -0.8 * high), radius * rng.uniform(0.38, 0.5), part=1
        ),
    )
    return Draft(pieces, ("head", "socket"), (True, False))


@_family
def dumbbell(rng: Rng) -> Draft:
    """A bar between two balls, discs or blocks."""
    half, radius = rng.uniform(0.035, 0.055), rng.uniform(0.01, 0.016)
    end, thick = rng.uniform(0.022, 0.037), rng.uniform(0.012, 0.025)
    shape = rng.integers(3)
    ends = []
    for side in (-1, 1):
        center = (0, 0, side * (half + thick))
        if shape == 0:
            ends.append(draft.ellipsoid((end, end, 1.5 * thick), center, part=1))
        elif shape == 1:
            ends.append(
                draft.cylinder((0, 0, side * half), (0, 0, side * (half + 2 * thick)), end, part=1)
            )
        else:
            ends.append(draft.box((end, end, thick), center, part=1))
    bar = draft.capsule((0, 0, -half - thick), (0, 0, half + thick), radius)
    return Draft((bar, *ends), ("bar", "ends"), (True, False), (1, 2))


@_family
def pan(rng: Rng) -> Draft:
    """A flat disc with a handle."""
    radius, half, handle = (
        rng.uniform(0.035, 0.055),
        rng.uniform(0.009, 0.016),
        rng.uniform(0.07, 0.11),
    )
    grip, rise = rng.uniform(0.009, 0.013), rng.uniform(0.0, 0.02)
    pieces = (
        draft.capsule((0.9 * radius, 0, 0), (radius + handle, 0, rise), grip),
        draft.cylinder((0, 0, -half), (0, 0, half), radius, part=1),
    )
    return Draft(pieces, ("handle", "disc"), (True, False), heavier=3.0)


@_family
def spoon(rng: Rng) -> Draft:
    """A rod with a flattened scoop."""
    length, scoop = rng.uniform(0.1, 0.145), rng.uniform(0.026, 0.038)
    radii = (scoop, scoop * rng.uniform(0.7, 1.0), rng.uniform(0.01, 0.015))
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), rng.uniform(0.008, 0.012)),
        draft.ellipsoid(radii, (length + 0.8 * scoop, 0, 0), part=1),
    )
    return Draft(pieces, ("handle", "scoop"), (True, False))


@_family
def brush(rng: Rng) -> Draft:
    """A rod with a block on its end."""
    length, half = rng.uniform(0.08, 0.12), rng.uniform(0.03, 0.045)
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), rng.uniform(0.009, 0.014)),
        draft.box(
            (half, rng.uniform(0.018, 0.03), rng.uniform(0.01, 0.016)),
            (length + half, 0, 0),
            part=1,
        ),
    )
    return Draft(pieces, ("handle", "head"), (True, False))


@_family
def camera(rng: Rng) -> Draft:
    """A block with a lens."""
    half = (rng.uniform(0.045, 0.065), rng.uniform(0.013, 0.022), rng.uniform(0.028, 0.04))
    lens, side = rng.uniform(0.02, 0.04), rng.uniform(-0.3, 0.3) * half[0]
    pieces = (
        draft.box(half),
        draft.cylinder(
            (side, half[1], 0), (side, half[1] + lens, 0), half[2] * rng.uniform(0.6, 0.85), part=1
        ),
    )
    return Draft(pieces, ("body", "lens"), (True, False))


@_family
def cross(rng: Rng) -> Draft:
    """Two or three bars through each other at right angles."""
    count = rng.integers(2, 4)
    as_box = rng.random() < 0.5
    axes = np.eye(3)[rng.permutation(3)]
    pieces = []
    for i in range(count):
        half, thick = (
            rng.uniform(0.06, 0.09) if i == 0 else rng.uniform(0.03, 0.055),
            rng.uniform(0.01, 0.016),
        )
        center = axes[0] * rng.uniform(-0.02, 0.02) * (i > 0)
        if as_box:
            size = tuple(np.where(axes[i] > 0, half, thick))
            pieces.append(draft.box(size, tuple(center), part=min(i, 1)))
        else:
            ends = tuple(center - half * axes[i]), tuple(center + half * axes[i])
            pieces.append(draft.capsule(*ends, thick, part=min(i, 1)))
    return Draft(tuple(pieces), ("long bar", "cross bars"), (True, False))


@_family
def compound(rng: Rng) -> Draft:
    """Two or three random pieces, the others attached to the first."""
    kinds = rng.choice(
        ["box", "box", "cylinder", "capsule", "capsule", "ellipsoid"],
        rng.integers(2, 4),
        replace=False,
    )
    pieces: list[Piece] = []
    for i, kind in enumerate(kinds):
        a, b, c = rng.uniform(0.014, 0.036, 3)
        size = {"box": (a, b, c), "ellipsoid": (a, b, c)}.get(kind, (min(a, b), c, 0.0))
        q = rng.normal(size=4) if i else np.array([1.0, 0.0, 0.0, 0.0])
        direction = rng.normal(size=3)
        center = (
            direction / np.linalg.norm(direction) * rng.uniform(0.03, 0.045) if i else np.zeros(3)
        )
        pieces.append(
            Piece(kind, size, tuple(center), tuple(q / np.linalg.norm(q)), part=min(i, 1))
        )
    return Draft(tuple(pieces), ("core", "growths"), draft.either(rng))


@_family
def ring(rng: Rng) -> Draft:
    """Eight wedges in a circle."""
    major, thick, high = (
        rng.uniform(0.028, 0.048),
        rng.uniform(0.009, 0.014),
        rng.uniform(0.009, 0.016),
    )
    rim = np.pi / 4 * (np.arange(8) + 0.5)
    profile = np.stack([major + thick * np.cos(rim), high * np.sin(rim)], -1)
    turns = 2 * np.pi / 8 * np.arange(9)
    ends = [np.array([draft.polar(r, turn, z) for r, z in profile]) for turn in turns]
    return Draft(tuple(draft.mesh(np.concatenate(pair)) for pair in itertools.pairwise(ends)))


@_family
def bowl(rng: Rng) -> Draft:
    """A flat floor and seven sloping staves."""
    top = rng.uniform(0.036, 0.046)
    return _vessel(
        top * rng.uniform(0.5, 0.75), top, rng.uniform(0.03, 0.05), rng.uniform(0.006, 0.009)
    )


@_family
def cup(rng: Rng) -> Draft:
    """A tall vessel without a handle."""
    top = rng.uniform(0.028, 0.042)
    return _vessel(
        top * rng.uniform(0.75, 1.0), top, rng.uniform(0.06, 0.1), rng.uniform(0.005, 0.008)
    )


def _vessel(bottom: float, top: float, height: float, wall: float) -> Draft:
    """A floor and a wall of seven sides; radii at bottom and top, height and thickness in m."""
    turns = 2 * np.pi / 7 * np.arange(8)
    floor = np.array([draft.polar(bottom, turn, z) for turn in turns[:-1] for z in (0.0, wall)])
    pieces = [draft.mesh(floor)]
    for pair in itertools.pairwise(turns):
        corners = [(bottom - wall, wall), (bottom, wall), (top - wall, height), (top, height)]
        pieces.append(
            draft.mesh(np.array([draft.polar(r, turn, z) for turn in pair for r, z in corners]))
        )
    return Draft(tuple(pieces), heavier=2.0)
