"""Household objects that are flat or thin, and frames."""

import functools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import Builder, Draft, Rng
from congrasp.common.objects.families.profiles import hull, slab, sweep

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)


@_family
def carton(rng: Rng) -> Draft:
    """A packet, up to 7 x 17 x 22 cm: cereal, crackers, tea."""
    half = rng.uniform(0.01, 0.035), rng.uniform(0.025, 0.085), rng.uniform(0.04, 0.11)
    return Draft((draft.box(half),), density=(100.0, 600.0))


@_family
def book(rng: Rng) -> Draft:
    """A book, thick or thin."""
    half = rng.uniform(0.045, 0.08), rng.uniform(0.07, 0.12), rng.uniform(0.007, 0.022)
    return Draft((draft.box(half),), density=(300.0, 900.0))


@_family
def card(rng: Rng) -> Draft:
    """A pack of cards, a wallet, a bar of soap: flat, with round corners."""
    half = rng.uniform(0.022, 0.04), rng.uniform(0.035, 0.065), rng.uniform(0.0055, 0.014)
    return Draft((slab(half, rng.uniform(0.003, 0.02)),), density=(400.0, 1200.0))


@_family
def phone(rng: Rng) -> Draft:
    """A telephone in its case, with a camera block."""
    half = rng.uniform(0.032, 0.041), rng.uniform(0.065, 0.085), rng.uniform(0.0055, 0.0075)
    block = rng.uniform(0.01, 0.02), rng.uniform(0.01, 0.02), rng.uniform(0.001, 0.002)
    place = half[0] - block[0] - 0.005, half[1] - block[1] - 0.005, half[2] + block[2]
    return Draft((slab(half, rng.uniform(0.006, 0.012)), slab(block, 0.004, place)), density=(1000.0, 2000.0))


@_family
def remote_control(rng: Rng) -> Draft:
    """A long bar whose ends differ, with a curved back."""
    length, wide = rng.uniform(0.13, 0.22), rng.uniform(0.017, 0.027)
    thick = rng.uniform(0.007, 0.014)
    pieces = []
    x = np.linspace(-length / 2, length / 2, 4)
    scale = 1 + rng.uniform(-0.25, 0.25) * np.array([-1, -0.3, 0.3, 1])
    deep = thick * (1 + rng.uniform(0, 0.8) * np.array([0, 1, 0.6, 0]))
    for i in range(3):
        ends = [
            [(x[j], y * wide * scale[j], thick) for y in (-1, 1)]
            + [(x[j], 0.7 * y * wide * scale[j], -deep[j]) for y in (-1, 1)]
            for j in (i, i + 1)
        ]
        pieces.append(hull(*ends))
    return Draft(tuple(pieces), density=(500.0, 1200.0))


@_family
def eyeglasses(rng: Rng) -> Draft:
    """Two lenses, a bridge and two temples, folded or not."""
    wide, high, gap = rng.uniform(0.021, 0.028), rng.uniform(0.015, 0.023), rng.uniform(0.007, 0.011)
    temple, thick = rng.uniform(0.1, 0.14), rng.uniform(0.0025, 0.004)
    middle, open_ = gap + wide, rng.uniform(0.05, 1.0) * np.pi / 2
    solid, rim = bool(rng.random() < 0.5), rng.uniform(0.003, 0.005)
    # One corner is on the bridge's side, one at the temple.
    turns = np.pi + np.linspace(0, 2 * np.pi, 10 if solid else 5, endpoint=False)
    outside, above = wide * np.cos(0.2 * np.pi), high * np.sin(0.2 * np.pi)
    pieces = []
    for side in (-1, 1):
        loop = np.array([(side * (middle + wide * np.cos(t)), 0, high * np.sin(t)) for t in turns])
        if solid:
            pieces.append(hull(*(np.add(loop, (0, y, 0)) for y in (-0.0015, 0.0015))))
        else:
            pieces += sweep(loop, (0, -1, 0), rim, 0.005, closed=True)
        hinge = np.array((side * (middle + outside), 0, above))
        way = np.array((-side * np.cos(open_), -np.sin(open_), 0))
        ear, tip = hinge + 0.75 * temple * way, hinge + temple * way - [0, 0, 0.015]
        pieces.append(draft.capsule(tuple(hinge), tuple(ear), thick, part=1))
        pieces += sweep(np.array([ear, tip]), np.cross(way, [0, 0, 1]), 2 * thick, 2 * thick, part=1)
    pieces.append(draft.capsule((-gap, 0, 0), (gap, 0, 0), 0.0025))
    return Draft(tuple(pieces), ("front", "temples"), draft.either(rng), (), (1200.0, 2500.0))


@_family
def picture_frame(rng: Rng) -> Draft:
    """Four bars around a picture, some with a strut behind it."""
    x, z = rng.uniform(0.035, 0.065), rng.uniform(0.045, 0.1)
    bar, thick = rng.uniform(0.012, 0.022), rng.uniform(0.01, 0.018)
    loop = np.array([(-x, 0, -z), (x, 0, -z), (x, 0, z), (-x, 0, z)])
    pieces = sweep(loop, (0, -1, 0), bar, thick, closed=True)
    if rng.random() < 0.8:
        half = (x - 0.5 * bar, 0.0015, z - 0.5 * bar)
        pieces.append(draft.box(half, (0, 0.2 * thick, 0), part=1))
        if rng.random() < 0.6:
            foot = (0, rng.uniform(0.04, 0.07), -z - 0.5 * bar)
            wide = rng.uniform(0.01, 0.02)
            ends = [
                [(side * wide, y, z0) for side in (-1, 1) for y in (y0, y0 + 0.004)]
                for y0, z0 in ((0.2 * thick, 0.4 * z), (foot[1], foot[2]))
            ]
            pieces.append(hull(*ends, part=1))
        return Draft(tuple(pieces), ("frame", "picture"), (True, False), (), (300.0, 900.0))
    return Draft(tuple(pieces), density=(300.0, 900.0))


@_family
def hanger(rng: Rng) -> Draft:
    """A triangle of bars with a hook."""
    half, high, bar = rng.uniform(0.08, 0.125), rng.uniform(0.05, 0.08), rng.uniform(0.011, 0.016)
    loop = np.array(
        [
            (-half, 0, 0),
            (-0.6 * half, 0, -0.012),
            (0.6 * half, 0, -0.012),
            (half, 0, 0),
            (0.15 * half, 0, high),
            (-0.15 * half, 0, high),
        ]
    )
    pieces = sweep(loop, (0, -1, 0), 0.9 * bar, bar, closed=True)
    turns = np.linspace(-0.5 * np.pi, 0.9 * np.pi, 5)
    hook = np.array([(0.02 * np.cos(t), 0, high + 0.028 + 0.02 * np.sin(t)) for t in turns])
    pieces += sweep(hook, (0, -1, 0), 0.009, 0.009, part=1)
    return Draft(tuple(pieces), ("body", "hook"), (True, False), (), (400.0, 900.0))
