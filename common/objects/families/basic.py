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
    radius = rng.uniform(0.012, 0.042)
    return Draft((draft.cylinder((0, 0, -half), (0, 0, half), radius),))


@_family
def capsule(rng: Rng) -> Draft:
    """A rod with round ends."""
    half = rng.uniform(0.01, 0.08)
    radius = rng.uniform(0.012, 0.04)
    return Draft((draft.capsule((0, 0, -half), (0, 0, half), radius),))


@_family
def ellipsoid(rng: Rng) -> Draft:
    """An ellipsoid, from a pebble to a rugby ball."""
    radii = [rng.uniform(0.015, 0.04), rng.uniform(0.02, 0.045), rng.uniform(0.025, 0.1)]
    return Draft((draft.ellipsoid(tuple(rng.permutation(radii))),))


@_family
def ball(rng: Rng) -> Draft:
    """A near-sphere, such as a fruit."""
    radii = rng.uniform(0.02, 0.043) * rng.uniform(0.95, 1.05, 3)
    return Draft((draft.ellipsoid(tuple(radii)),))


@_family
def bottle(rng: Rng) -> Draft:
    """A body, round shoulders and a neck."""
    radius = rng.uniform(0.022, 0.038)
    half = rng.uniform(0.03, 0.065)
    shoulder = radius * rng.uniform(0.5, 1.0)
    neck = rng.uniform(0.025, 0.05)
    neck_radius = radius * rng.uniform(0.35, 0.55)
    top = half + shoulder + neck
    pieces = (
        draft.cylinder((0, 0, -half), (0, 0, half), radius),
        draft.ellipsoid((radius, radius, shoulder), (0, 0, half)),
        draft.cylinder((0, 0, half), (0, 0, top), neck_radius, part=1),
    )
    grasp_body = bool(rng.random() < 0.75)
    return Draft(pieces, ("body", "neck"), (grasp_body, not grasp_body))


@_family
def mug(rng: Rng) -> Draft:
    """A body with a handle of three rods at its side."""
    radius = rng.uniform(0.028, 0.04)
    half = rng.uniform(0.035, 0.055)
    thick = rng.uniform(0.006, 0.009)
    high = half * rng.uniform(0.5, 0.75)
    reach = radius + rng.uniform(0.024, 0.038)
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
    radius = rng.uniform(0.034, 0.043)
    height = rng.uniform(0.03, 0.042)
    thick = rng.uniform(0.007, 0.009)
    ear = radius + rng.uniform(0.028, 0.04)
    rise = height * rng.uniform(0.5, 0.75)
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
    radius = rng.uniform(0.026, 0.036)
    high = rng.uniform(0.032, 0.045)
    stem = rng.uniform(0.06, 0.09)
    pieces = (
        draft.ellipsoid((radius, radius, high), (0, 0, stem + 0.9 * high)),
        draft.capsule((0, 0, 0), (0, 0, stem), rng.uniform(0.006, 0.009), part=1),
        draft.cylinder((0, 0, -0.004), (0, 0, 0.004), rng.uniform(0.028, 0.036), part=1),
    )
    return Draft(pieces, ("bowl", "stem"), draft.either(rng))


@_family
def knife(rng: Rng) -> Draft:
    """A handle and a thin blade."""
    grip = rng.uniform(0.045, 0.06)
    blade = rng.uniform(0.045, 0.06)
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
    length = rng.uniform(0.12, 0.2)
    radius = rng.uniform(0.009, 0.014)
    half = (rng.uniform(0.012, 0.018), rng.uniform(0.03, 0.05), rng.uniform(0.012, 0.018))
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), radius),
        draft.box(half, (length, rng.uniform(-0.01, 0.01), 0), part=1),
    )
    return Draft(pieces, ("handle", "head"), (True, False), weight=(1, 3), heavier=2.2)


@_family
def screwdriver(rng: Rng) -> Draft:
    """A thick handle and a thin shaft."""
    half = rng.uniform(0.038, 0.055)
    shaft = rng.uniform(0.06, 0.1)
    pieces = (
        draft.cylinder((-half, 0, 0), (half, 0, 0), rng.uniform(0.012, 0.018)),
        draft.capsule((half, 0, 0), (half + shaft, 0, 0), rng.uniform(0.0035, 0.0055), part=1),
    )
    return Draft(pieces, ("handle", "shaft"), (True, False), weight=(1, 3))


@_family
def flashlight(rng: Rng) -> Draft:
    """A tube with a wider head."""
    half = rng.uniform(0.04, 0.065)
    head = rng.uniform(0.024, 0.04)
    pieces = (
        draft.cylinder((0, 0, -half), (0, 0, half), rng.uniform(0.011, 0.017)),
        draft.cylinder((0, 0, half), (0, 0, half + head), rng.uniform(0.02, 0.029), part=1),
    )
    return Draft(pieces, ("body", "head"), (True, False))


@_family
def lightbulb(rng: Rng) -> Draft:
    """A round head and a socket."""
    radius = rng.uniform(0.026, 0.037)
    high = rng.uniform(0.03, 0.042)
    socket = rng.uniform(0.025, 0.04)
    socket_radius = radius * rng.uniform(0.38, 0.5)
    pieces = (
        draft.ellipsoid((radius, radius, high)),
        draft.cylinder((0, 0, -high - socket), (0, 0, -0.8 * high), socket_radius, part=1),
    )
    return Draft(pieces, ("head", "socket"), (True, False))


@_family
def dumbbell(rng: Rng) -> Draft:
    """A bar between two balls, discs or blocks."""
    half = rng.uniform(0.035, 0.055)
    radius = rng.uniform(0.01, 0.016)
    end = rng.uniform(0.022, 0.037)
    thick = rng.uniform(0.012, 0.025)
    shape = rng.integers(3)
    ends = []
    for side in (-1, 1):
        center = (0, 0, side * (half + thick))
        if shape == 0:
            ends.append(draft.ellipsoid((end, end, 1.5 * thick), center, part=1))
        elif shape == 1:
            inside = (0, 0, side * half)
            outside = (0, 0, side * (half + 2 * thick))
            ends.append(draft.cylinder(inside, outside, end, part=1))
        else:
            ends.append(draft.box((end, end, thick), center, part=1))
    bar = draft.capsule((0, 0, -half - thick), (0, 0, half + thick), radius)
    return Draft((bar, *ends), ("bar", "ends"), (True, False), weight=(1, 2))


@_family
def pan(rng: Rng) -> Draft:
    """A flat disc with a handle."""
    radius = rng.uniform(0.035, 0.055)
    half = rng.uniform(0.009, 0.016)
    handle = rng.uniform(0.07, 0.11)
    grip = rng.uniform(0.009, 0.013)
    rise = rng.uniform(0.0, 0.02)
    pieces = (
        draft.capsule((0.9 * radius, 0, 0), (radius + handle, 0, rise), grip),
        draft.cylinder((0, 0, -half), (0, 0, half), radius, part=1),
    )
    return Draft(pieces, ("handle", "disc"), (True, False), heavier=3.0)


@_family
def spoon(rng: Rng) -> Draft:
    """A rod with a flattened scoop."""
    length = rng.uniform(0.1, 0.145)
    scoop = rng.uniform(0.026, 0.038)
    radii = (scoop, scoop * rng.uniform(0.7, 1.0), rng.uniform(0.01, 0.015))
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), rng.uniform(0.008, 0.012)),
        draft.ellipsoid(radii, (length + 0.8 * scoop, 0, 0), part=1),
    )
    return Draft(pieces, ("handle", "scoop"), (True, False))


@_family
def brush(rng: Rng) -> Draft:
    """A rod with a block on its end."""
    length = rng.uniform(0.08, 0.12)
    half = rng.uniform(0.03, 0.045)
    radius = rng.uniform(0.009, 0.014)
    head = (half, rng.uniform(0.018, 0.03), rng.uniform(0.01, 0.016))
    pieces = (
        draft.capsule((0, 0, 0), (length, 0, 0), radius),
        draft.box(head, (length + half, 0, 0), part=1),
    )
    return Draft(pieces, ("handle", "head"), (True, False))


@_family
def camera(rng: Rng) -> Draft:
    """A block with a lens."""
    half = (rng.uniform(0.045, 0.065), rng.uniform(0.013, 0.022), rng.uniform(0.028, 0.04))
    lens = rng.uniform(0.02, 0.04)
    side = rng.uniform(-0.3, 0.3) * half[0]
    radius = half[2] * rng.uniform(0.6, 0.85)
    pieces = (
        draft.box(half),
        draft.cylinder((side, half[1], 0), (side, half[1] + lens, 0), radius, part=1),
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
        is_first = i == 0
        half = rng.uniform(0.06, 0.09) if is_first else rng.uniform(0.03, 0.055)
        thick = rng.uniform(0.01, 0.016)
        offset = rng.uniform(-0.02, 0.02)
        center = axes[0] * offset * (not is_first)
        part = 0 if is_first else 1
        if as_box:
            size = np.where(axes[i] > 0, half, thick)
            pieces.append(draft.box(tuple(size), tuple(center), part=part))
        else:
            start = center - half * axes[i]
            end = center + half * axes[i]
            pieces.append(draft.capsule(tuple(start), tuple(end), thick, part=part))
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
        size = (a, b, c) if kind in ("box", "ellipsoid") else (min(a, b), c, 0.0)
        is_first = i == 0
        quat = np.array([1.0, 0.0, 0.0, 0.0]) if is_first else rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        direction = rng.normal(size=3)
        if is_first:
            center = np.zeros(3)
        else:
            center = direction / np.linalg.norm(direction) * rng.uniform(0.03, 0.045)
        part = 0 if is_first else 1
        x, y, z = center.tolist()
        pieces.append(Piece(kind, size, (x, y, z), tuple(quat), part=part))
    return Draft(tuple(pieces), ("core", "growths"), draft.either(rng))


@_family
def ring(rng: Rng) -> Draft:
    """Eight wedges in a circle."""
    major = rng.uniform(0.028, 0.048)
    thick = rng.uniform(0.009, 0.014)
    high = rng.uniform(0.009, 0.016)
    rim = np.pi / 4 * (np.arange(8) + 0.5)
    profile = np.stack([major + thick * np.cos(rim), high * np.sin(rim)], -1)
    turns = 2 * np.pi / 8 * np.arange(9)
    sections = []
    for turn in turns:
        sections.append(np.array([draft.polar(radius, turn, z) for radius, z in profile]))
    pieces = [draft.mesh(np.concatenate(pair)) for pair in itertools.pairwise(sections)]
    return Draft(tuple(pieces))


@_family
def bowl(rng: Rng) -> Draft:
    """A flat floor and seven sloping staves."""
    top = rng.uniform(0.036, 0.046)
    bottom = top * rng.uniform(0.5, 0.75)
    height = rng.uniform(0.03, 0.05)
    wall = rng.uniform(0.006, 0.009)
    return _vessel(bottom, top, height, wall)


@_family
def cup(rng: Rng) -> Draft:
    """A tall vessel without a handle."""
    top = rng.uniform(0.028, 0.042)
    bottom = top * rng.uniform(0.75, 1.0)
    height = rng.uniform(0.06, 0.1)
    wall = rng.uniform(0.005, 0.008)
    return _vessel(bottom, top, height, wall)


def _vessel(bottom: float, top: float, height: float, wall: float) -> Draft:
    """A floor and a wall of seven sides; radii at bottom and top, height and thickness in m."""
    turns = 2 * np.pi / 7 * np.arange(8)
    floor = []
    for turn in turns[:-1]:
        floor.append(draft.polar(bottom, turn, 0.0))
        floor.append(draft.polar(bottom, turn, wall))
    pieces = [draft.mesh(np.array(floor))]
    profile = [(bottom - wall, wall), (bottom, wall), (top - wall, height), (top, height)]
    for start, end in itertools.pairwise(turns):
        corners = [draft.polar(radius, start, z) for radius, z in profile]
        corners += [draft.polar(radius, end, z) for radius, z in profile]
        pieces.append(draft.mesh(np.array(corners)))
    return Draft(tuple(pieces), heavier=2.0)
