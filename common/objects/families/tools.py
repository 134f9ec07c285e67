"""Household tools with handles."""

import functools

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
    slab,
    sweep,
    thickened,
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
    radius = rng.uniform(0.018, 0.032)
    length = rng.uniform(0.07, 0.12)
    grip = rng.uniform(0.075, 0.11)
    lean = rng.uniform(0.05, 0.35)
    half_width = rng.uniform(0.012, 0.017)
    half_depth = rng.uniform(0.015, 0.022)
    root = np.array((0.0, 0.0, -0.4 * radius))
    foot = np.array((-lean * grip, 0.0, -0.6 * radius - grip))
    middle = 0.5 * (root + foot) + [0.004, 0, 0]
    depths = 2 * half_depth * np.array([1.1, 1.0, 0.95])
    handle = sweep(np.array([root, middle, foot]), (0, 1, 0), depths, 2 * half_width, rounded=True)
    nose_profile = [(0, 0.75 * radius), (rng.uniform(0.02, 0.04), rng.uniform(0.3, 0.7) * radius)]
    motor_profile = [
        (-length, 0.8 * radius),
        (-0.9 * length, radius),
        (0, radius),
        (0.01, 0.75 * radius),
    ]
    front = length * rng.uniform(0.55, 0.75)
    top = [_along_x(piece, front) for piece in lathe(motor_profile, part=1, sides=12)]
    top += [_along_x(piece, front + 0.01) for piece in lathe(nose_profile, part=1, sides=12)]
    if rng.random() < 0.6:
        half = (rng.uniform(0.025, 0.04), rng.uniform(0.018, 0.03), rng.uniform(0.01, 0.02))
        top.append(draft.box(half, (foot[0] + 0.006, 0, foot[2] - 0.8 * half[2]), part=1))
    return Draft(
        (*handle, *top),
        ("grip", "machine"),
        (True, False),
        weight=(1.0, rng.uniform(1.0, 2.0)),
        density=(400.0, 1200.0),
    )


@_family
def scissors(rng: Rng) -> Draft:
    """Two blades that cross, with a ring on each handle."""
    thick = rng.uniform(0.0115, 0.016)
    blade = rng.uniform(0.06, 0.1)
    opening = rng.uniform(0.05, 0.2)
    bow = rng.uniform(0.016, 0.024)
    reach = rng.uniform(0.035, 0.055)
    turns = 2 * np.pi / 5 * np.arange(5)
    pieces = []
    for side in (-1, 1):
        x = -reach - 0.5 * bow + 1.3 * bow * np.cos(turns)
        y = 1.15 * side * bow + bow * np.sin(turns)
        loop = np.stack([x, y, 0 * turns], -1)
        pieces += sweep(loop, (0, 0, 1), rng.uniform(0.006, 0.008), thick, closed=True)
        tip = (blade, -side * opening * blade)
        root = (-reach + 0.8 * bow, 1.15 * side * bow)
        z = 0.002 * side
        corners = [
            (*root, z),
            (root[0], root[1] + 0.006 * side, z),
            (0, 0.007, z),
            (0, -0.007, z),
            (*tip, z),
        ]
        pieces.append(thickened(corners, 2, 0.002, part=1))
    return Draft(
        tuple(pieces), ("handles", "blades"), (True, False), weight=(1, 4), density=(700.0, 1300.0)
    )


@_family
def cutlery(rng: Rng) -> Draft:
    """A fork, a spoon or a table knife with an arched handle."""
    length = rng.uniform(0.09, 0.13)
    arch = rng.uniform(0.015, 0.022)
    thick = rng.uniform(0.0035, 0.006)
    x = np.linspace(0, length, 5)
    path = np.stack([x, 0 * x, arch * np.sin(np.pi * x / length)], -1)
    widths = rng.uniform(0.012, 0.02) * np.array([1.0, 0.9, 0.75, 0.6, 0.5])
    handle = sweep(path, (0, 1, 0), thick, widths)
    kind = rng.integers(3)
    head = rng.uniform(0.05, 0.07)
    wide = rng.uniform(0.02, 0.028)
    if kind == 0:  # a knife's blade is upright
        outline = [
            (length - 0.01, 0, -0.3 * wide),
            (length - 0.01, 0, 0.3 * wide),
            (length + head, 0, -0.1 * wide),
            (length + head, 0, 0.3 * wide),
        ]
        top = [thickened(outline, 1, 0.0015, part=1)]
    elif kind == 1:
        half = (head / 2, wide / 2, 0.004)
        top = [draft.ellipsoid(half, (length + 0.4 * head, 0, -0.002), part=1)]
    else:
        tine_root = length + 0.4 * head
        neck = grid((length - 0.005,), (-wide / 5, wide / 5), (-thick / 2, thick / 2))
        edge = grid((tine_root,), (-wide / 2, wide / 2), (-0.002 - 0.004, 0.002 - 0.004))
        top = [hull(neck, edge, part=1)]
        for y in np.linspace(-0.4, 0.4, 4) * wide:
            tine = np.array([(tine_root, y, -0.004), (length + head, y, 0.004)])
            top += sweep(tine, (0, 1, 0), 0.003, 0.003, part=1)
    return Draft((*handle, *top), ("handle", "head"), (True, False), density=(3000.0, 6000.0))


@_family
def utensil(rng: Rng) -> Draft:
    """A spatula, a ladle or a masher: a long handle and a broad head."""
    length = rng.uniform(0.13, 0.19)
    thick = rng.uniform(0.007, 0.012)
    bend = rng.uniform(0.015, 0.04)
    kind = rng.integers(3)
    handle = [draft.capsule((0, 0, bend), (length, 0, 0), thick)]
    if kind == 0:
        half = (rng.uniform(0.03, 0.045), rng.uniform(0.025, 0.04), 0.002)
        head = [slab(half, 0.012, (length + half[0] - 0.004, 0, -0.002), part=1)]
    elif kind == 1:
        radius = rng.uniform(0.025, 0.038)
        deep = rng.uniform(0.02, 0.03)
        cup = vessel([(0, 0.6 * radius), (deep, radius)], 0.004, 8, part=1)
        shift = (length + 0.9 * radius, 0, -0.7 * deep)
        head = [moved(piece, shift) for piece in cup]
    else:
        radius = rng.uniform(0.02, 0.035)
        end = length + rng.uniform(0.01, 0.05)
        head = [draft.cylinder((length, 0, 0), (end, 0, 0), radius, part=1)]
    return Draft((*handle, *head), ("handle", "head"), (True, False), density=(500.0, 1500.0))


@_family
def wrench(rng: Rng) -> Draft:
    """A flat bar with an open jaw at one end, and a ring or nothing at the other."""
    length = rng.uniform(0.08, 0.15)
    thick = rng.uniform(0.011, 0.016)
    wide = rng.uniform(0.014, 0.022)
    shaft = sweep(np.array([(0.0, 0, 0), (length, 0, 0)]), (0, 0, 1), wide, 0.9 * thick)
    radius = rng.uniform(0.013, 0.02)
    bar = rng.uniform(0.009, 0.013)
    gap = rng.uniform(0.5, 0.8)
    jaw = arc(-np.pi + gap, np.pi - gap, 6, (radius, radius), (0, 0, 0))[:, [0, 2, 1]] * [-1, 1, 1]
    head = sweep(np.add(jaw, (length + radius, 0, 0)), (0, 0, 1), bar, thick, part=1)
    if rng.random() < 0.5:
        loop = arc(0, 2 * np.pi, 7, (radius, radius), (0, 0, 0))[:-1, [0, 2, 1]]
        head += sweep(loop - (radius, 0, 0), (0, 0, 1), bar, thick, closed=True, part=1)
    return Draft((*shaft, *head), ("shaft", "head"), (True, False), density=(1500.0, 5000.0))


@_family
def clothes_iron(rng: Rng) -> Draft:
    """A wedge with a bow-shaped handle on top."""
    length = rng.uniform(0.11, 0.18)
    wide = rng.uniform(0.035, 0.05)
    high = rng.uniform(0.025, 0.045)
    sole = np.concatenate(
        [grid((-length / 2, length / 4), (-wide, wide), (0,)), [(length / 2, 0, 0)]]
    )
    top = sole * [0.85, 0.6, 1] + [0, 0, high]
    base = hull(sole, top, part=1)
    path = arc(np.pi, 0, 5, (0.36 * length, rng.uniform(0.045, 0.06)), (0, 0, 0.85 * high))
    width = rng.uniform(0.014, 0.02)
    thickness = rng.uniform(0.02, 0.028)
    handle = sweep(path, (0, 1, 0), width, thickness, rounded=True)
    return Draft((*handle, base), ("handle", "base"), (True, False), heavier=2.5)


@_family
def headset(rng: Rng) -> Draft:
    """A bow between two cushions."""
    radius = rng.uniform(0.06, 0.08)
    cup = rng.uniform(0.025, 0.036)
    path = arc(np.pi, 0, 8, (radius, radius * rng.uniform(1.0, 1.25)), (0, 0, 0))
    bow = sweep(path, (0, 1, 0), rng.uniform(0.006, 0.01), rng.uniform(0.012, 0.025))
    thick = rng.uniform(0.02, 0.032)
    cups = []
    for side in (-1, 1):
        outside = side * radius
        inside = outside - side * thick
        cups.append(draft.cylinder((outside, 0, 0), (inside, 0, 0), cup, part=1))
    return Draft((*bow, *cups), ("bow", "cushions"), draft.either(rng), density=(300.0, 900.0))


@_family
def pen(rng: Rng) -> Draft:
    """A marker, a candle or a stick: a thin rod, some with a cap."""
    radius = rng.uniform(0.0055, 0.012)
    half = rng.uniform(0.05, 0.1)
    rod = draft.cylinder((-half, 0, 0), (half, 0, 0), radius)
    if rng.random() < 0.5:
        return Draft((rod,), density=(600.0, 2500.0))
    cap_start = half * rng.uniform(0.3, 0.6)
    cap_radius = radius * rng.uniform(1.1, 1.3)
    cap = draft.cylinder((cap_start, 0, 0), (half + 0.004, 0, 0), cap_radius, part=1)
    return Draft((rod, cap), ("shaft", "cap"), (True, False), density=(600.0, 2500.0))


def _along_x(piece: Piece, shift: float) -> Piece:
    """Returns a mesh piece along z, rotated to x and moved along it."""
    assert piece.vertices is not None
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    return hull((piece.vertices + piece.pos) @ turn.T + [shift, 0, 0], part=piece.part)
