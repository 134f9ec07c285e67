"""Household tools with handles."""

import functools

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
    slab,
    sweep,
    vessel,
)
from congrasp.common.objects.spec import Piece

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)


@_family
def drill(rng: Rng) -> Draft:
    """A pistol grip under a motor with a chuck, some with a battery: drills, glue guns, hair
    dryers.
    """
    radius, length = rng.uniform(0.018, 0.032), rng.uniform(0.07, 0.12)
    grip, lean = rng.uniform(0.075, 0.11), rng.uniform(0.05, 0.35)
    w, d = rng.uniform(0.012, 0.017), rng.uniform(0.015, 0.022)
    root, foot = (0.0, 0.0, -0.4 * radius), np.array((-lean * grip, 0.0, -0.6 * radius - grip))
    path = np.array([root, 0.5 * (np.array(root) + foot) + [0.004, 0, 0], foot])
    handle = sweep(path, (0, 1, 0), 2 * d * np.array([1.1, 1.0, 0.95]), 2 * w, rounded=True)
    nose = lathe(
        [(0, 0.75 * radius), (rng.uniform(0.02, 0.04), rng.uniform(0.3, 0.7) * radius)],
        part=1,
        sides=12,
    )
    motor = lathe(
        [(-length, 0.8 * radius), (-0.9 * length, radius), (0, radius), (0.01, 0.75 * radius)],
        part=1,
        sides=12,
    )
    front = length * rng.uniform(0.55, 0.75)
    top = [_along_x(piece, front) for piece in motor] + [
        _along_x(piece, front + 0.01) for piece in nose
    ]
    if rng.random() < 0.6:
        half = (rng.uniform(0.025, 0.04), rng.uniform(0.018, 0.03), rng.uniform(0.01, 0.02))
        top.append(draft.box(half, (foot[0] + 0.006, 0, foot[2] - 0.8 * half[2]), part=1))
    return Draft(
        (*handle, *top),
        ("grip", "machine"),
        (True, False),
        (1.0, rng.uniform(1.0, 2.0)),
        (400.0, 1200.0),
    )


@_family
def scissors(rng: Rng) -> Draft:
    """Two blades that cross, with a ring on each handle."""
    thick, blade, open_ = rng.uniform(0.0115, 0.016), rng.uniform(0.06, 0.1), rng.uniform(0.05, 0.2)
    bow, reach = rng.uniform(0.016, 0.024), rng.uniform(0.035, 0.055)
    pieces = []
    for side in (-1, 1):
        center = (-reach - 0.5 * bow, 1.15 * side * bow)
        turns = 2 * np.pi / 5 * np.arange(5)
        loop = np.array(
            [(center[0] + 1.3 * bow * np.cos(t), center[1] + bow * np.sin(t), 0) for t in turns]
        )
        pieces += sweep(loop, (0, 0, 1), rng.uniform(0.006, 0.008), thick, closed=True)
        tip = (blade, -side * open_ * blade)
        root, z = (-reach + 0.8 * bow, 1.15 * side * bow), 0.002 * side
        corners = [
            (*root, z),
            (root[0], root[1] + 0.006 * side, z),
            (0, 0.007, z),
            (0, -0.007, z),
            (*tip, z),
        ]
        pieces.append(hull(*(np.add(corners, (0, 0, dz)) for dz in (-0.002, 0.002)), part=1))
    return Draft(tuple(pieces), ("handles", "blades"), (True, False), (1, 4), (700.0, 1300.0))


@_family
def cutlery(rng: Rng) -> Draft:
    """A fork, a spoon or a table knife with an arched handle."""
    length, arch, thick = (
        rng.uniform(0.09, 0.13),
        rng.uniform(0.015, 0.022),
        rng.uniform(0.0035, 0.006),
    )
    x = np.linspace(0, length, 5)
    path = np.stack([x, 0 * x, arch * np.sin(np.pi * x / length)], -1)
    handle = sweep(
        path, (0, 1, 0), thick, rng.uniform(0.012, 0.02) * np.array([1.0, 0.9, 0.75, 0.6, 0.5])
    )
    kind, head = rng.integers(3), rng.uniform(0.05, 0.07)
    wide = rng.uniform(0.02, 0.028)
    if kind == 0:  # a knife's blade is upright
        end = [(length + head, 0, z) for z in (-0.1 * wide, 0.3 * wide)]
        top = [
            hull(
                *(
                    np.add(
                        [(length - 0.01, 0, -0.3 * wide), (length - 0.01, 0, 0.3 * wide), *end],
                        (0, y, 0),
                    )
                    for y in (-0.0015, 0.0015)
                ),
                part=1,
            )
        ]
    elif kind == 1:
        half = (head / 2, wide / 2, 0.004)
        top = [draft.ellipsoid(half, (length + 0.4 * head, 0, -0.002), part=1)]
    else:
        palm = length + 0.4 * head
        top = [
            hull(
                [
                    (length - 0.005, y * wide / 5, z)
                    for y in (-1, 1)
                    for z in (-thick / 2, thick / 2)
                ],
                [(palm, y * wide / 2, z - 0.004) for y in (-1, 1) for z in (-0.002, 0.002)],
                part=1,
            )
        ]
        for y in np.linspace(-0.4, 0.4, 4) * wide:
            tine = np.array([(palm, y, -0.004), (length + head, y, 0.004)])
            top += sweep(tine, (0, 1, 0), 0.003, 0.003, part=1)
    return Draft((*handle, *top), ("handle", "head"), (True, False), (), (3000.0, 6000.0))


@_family
def utensil(rng: Rng) -> Draft:
    """A spatula, a ladle or a masher: a long handle and a broad head."""
    length, thick = rng.uniform(0.13, 0.19), rng.uniform(0.007, 0.012)
    bend, kind = rng.uniform(0.015, 0.04), rng.integers(3)
    handle = [draft.capsule((0, 0, bend), (length, 0, 0), thick)]
    if kind == 0:
        half = (rng.uniform(0.03, 0.045), rng.uniform(0.025, 0.04), 0.002)
        head = [slab(half, 0.012, (length + half[0] - 0.004, 0, -0.002), part=1)]
    elif kind == 1:
        radius, deep, wall = rng.uniform(0.025, 0.038), rng.uniform(0.02, 0.03), 0.004
        cup = vessel([(0, 0.6 * radius), (deep, radius)], wall, 8, part=1)
        shift = (length + 0.9 * radius, 0, -0.7 * deep)
        head = [moved(piece, shift) for piece in cup]
    else:
        radius = rng.uniform(0.02, 0.035)
        head = [
            draft.cylinder((length, 0, 0), (length + rng.uniform(0.01, 0.05), 0, 0), radius, part=1)
        ]
    return Draft((*handle, *head), ("handle", "head"), (True, False), (), (500.0, 1500.0))


@_family
def wrench(rng: Rng) -> Draft:
    """A flat bar with an open jaw at one end, and a ring or nothing at the other."""
    length, thick, wide = (
        rng.uniform(0.08, 0.15),
        rng.uniform(0.011, 0.016),
        rng.uniform(0.014, 0.022),
    )
    shaft = sweep(np.array([(0.0, 0, 0), (length, 0, 0)]), (0, 0, 1), wide, 0.9 * thick)
    radius, bar = rng.uniform(0.013, 0.02), rng.uniform(0.009, 0.013)
    gap = rng.uniform(0.5, 0.8)
    jaw = arc(-np.pi + gap, np.pi - gap, 6, (radius, radius), (0, 0, 0))[:, [0, 2, 1]] * [-1, 1, 1]
    head = sweep(np.add(jaw, (length + radius, 0, 0)), (0, 0, 1), bar, thick, part=1)
    if rng.random() < 0.5:
        loop = arc(0, 2 * np.pi, 7, (radius, radius), (0, 0, 0))[:-1, [0, 2, 1]]
        head += sweep(loop - (radius, 0, 0), (0, 0, 1), bar, thick, closed=True, part=1)
    return Draft((*shaft, *head), ("shaft", "head"), (True, False), (), (1500.0, 5000.0))


@_family
def clothes_iron(rng: Rng) -> Draft:
    """A wedge with a bow-shaped handle on top."""
    length, wide, high = (
        rng.uniform(0.11, 0.18),
        rng.uniform(0.035, 0.05),
        rng.uniform(0.025, 0.045),
    )
    sole = (
        [(-length / 2, y * wide, 0) for y in (-1, 1)]
        + [(length / 4, y * wide, 0) for y in (-1, 1)]
        + [(length / 2, 0, 0)]
    )
    base = hull(sole, np.array(sole) * [0.85, 0.6, 1] + [0, 0, high], part=1)
    path = arc(np.pi, 0, 5, (0.36 * length, rng.uniform(0.045, 0.06)), (0, 0, 0.85 * high))
    handle = sweep(
        path, (0, 1, 0), rng.uniform(0.014, 0.02), rng.uniform(0.02, 0.028), rounded=True
    )
    return Draft((*handle, base), ("handle", "base"), (True, False), heavier=2.5)


@_family
def headset(rng: Rng) -> Draft:
    """A bow between two cushions."""
    radius, cup = rng.uniform(0.06, 0.08), rng.uniform(0.025, 0.036)
    path = arc(np.pi, 0, 8, (radius, radius * rng.uniform(1.0, 1.25)), (0, 0, 0))
    bow = sweep(path, (0, 1, 0), rng.uniform(0.006, 0.01), rng.uniform(0.012, 0.025))
    thick = rng.uniform(0.02, 0.032)
    cups = [
        draft.cylinder((x, 0, 0), (x - np.sign(x) * thick, 0, 0), cup, part=1)
        for x in (-radius, radius)
    ]
    return Draft((*bow, *cups), ("bow", "cushions"), draft.either(rng), (), (300.0, 900.0))


@_family
def pen(rng: Rng) -> Draft:
    """A marker, a candle or a stick: a thin rod, some with a cap."""
    radius, half = rng.uniform(0.0055, 0.012), rng.uniform(0.05, 0.1)
    rod = draft.cylinder((-half, 0, 0), (half, 0, 0), radius)
    if rng.random() < 0.5:
        return Draft((rod,), density=(600.0, 2500.0))
    cap = draft.cylinder(
        (half * rng.uniform(0.3, 0.6), 0, 0),
        (half + 0.004, 0, 0),
        radius * rng.uniform(1.1, 1.3),
        part=1,
    )
    return Draft((rod, cap), ("shaft", "cap"), (True, False), (), (600.0, 2500.0))


def _along_x(piece: Piece, shift: float) -> Piece:
    """Returns a mesh piece along z, rotated to x and moved along it."""
    assert piece.vertices is not None
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    return hull((piece.vertices + piece.pos) @ turn.T + [shift, 0, 0], part=piece.part)
