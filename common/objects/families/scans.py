"""Shapes found in scans that other families lack: wire frames, wide bodies, thin boards, and thin
handles and knobs.
"""

import functools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import Builder, Draft, Rng, arc, slab, sweep, vessel
from congrasp.common.objects.spec import Piece

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)


@_family
def wire_frame(rng: Rng) -> Draft:
    """Two rectangles of wire and four uprights: a basket, a rack, a cage."""
    x = rng.uniform(0.03, 0.07)
    y = rng.uniform(0.03, 0.09)
    height = rng.uniform(0.04, 0.14)
    wire = rng.uniform(0.004, 0.008)
    flare = rng.uniform(0.8, 1.0)
    corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    bottoms = np.c_[flare * corners, np.zeros(4)]
    tops = np.c_[corners, np.full(4, height)]
    pieces = sweep(bottoms, (0, 0, 1), wire, wire, closed=True)
    pieces += sweep(tops, (0, 0, 1), wire, wire, closed=True)
    for bottom, top in zip(bottoms, tops, strict=True):
        normal = np.cross(top - bottom, (1.0, 0, 0))
        pieces += sweep(np.array([bottom, top]), normal / np.linalg.norm(normal), wire, wire)
    return Draft(tuple(pieces), density=(1500.0, 5000.0))


@_family
def bucket(rng: Rng) -> Draft:
    """A vessel wider than a hand, under a bow of three bars."""
    radius = rng.uniform(0.06, 0.085)
    height = rng.uniform(0.09, 0.16)
    wall = rng.uniform(0.004, 0.006)
    body = vessel([(0, radius * rng.uniform(0.7, 1.0)), (height, radius)], wall, 9)
    reach = radius - wall
    rise = rng.uniform(0.05, 0.08)
    bar = rng.uniform(0.008, 0.014)
    path = np.array(
        [
            (-reach, 0, height - 0.02),
            (-0.7 * reach, 0, height + rise),
            (0.7 * reach, 0, height + rise),
            (reach, 0, height - 0.02),
        ]
    )
    handle = sweep(path, (0, 1, 0), bar, bar, rounded=True, part=1)
    return Draft((*body, *handle), ("body", "handle"), draft.either(rng), density=(200.0, 800.0))


@_family
def crate(rng: Rng) -> Draft:
    """A box with two sides nearly as long as a hand's opening."""
    half = (rng.uniform(0.042, 0.058), rng.uniform(0.042, 0.058), rng.uniform(0.03, 0.1))
    return Draft((draft.box(tuple(rng.permutation(half))),), density=(80.0, 400.0))


@_family
def board(rng: Rng) -> Draft:
    """A thin plate with round corners: a cutting board, a tile, a clipboard."""
    half = (rng.uniform(0.05, 0.09), rng.uniform(0.09, 0.14), rng.uniform(0.004, 0.008))
    return Draft((slab(half, rng.uniform(0.005, 0.03)),), density=(500.0, 1200.0))


@_family
def teacup(rng: Rng) -> Draft:
    """A vessel held by a thin handle at its side, as wide as one or two fingers."""
    radius = rng.uniform(0.03, 0.05)
    height = rng.uniform(0.05, 0.12)
    wall = rng.uniform(0.003, 0.005)
    bottom = radius * rng.uniform(0.6, 1.0)
    body = vessel([(0, bottom), (height, radius)], wall, 7)
    thick = rng.uniform(0.004, 0.009)
    breadth = rng.uniform(0.006, 0.018)
    half = rng.uniform(0.018, 0.4 * height)
    reach = rng.uniform(0.02, 0.035)
    path = arc(-0.5 * np.pi, 0.5 * np.pi, 5, (reach, half), (radius, 0, 0.55 * height))
    ends = [0, -1]
    outer_radii = np.interp(path[ends, 2], (0, height), (bottom, radius))
    path[ends, 0] = outer_radii - wall / 2
    handle = sweep(path, (0, 1, 0), thick, breadth, rounded=True, part=1)
    return _held((*body, *handle), (400.0, 1500.0))


@_family
def basket(rng: Rng) -> Draft:
    """A body of any width under a thin bow: a basket, a lunch box, a kettle."""
    width = rng.uniform(0.035, 0.085)
    depth = rng.uniform(0.03, 0.06)
    height = rng.uniform(0.02, 0.045)
    thick = rng.uniform(0.005, 0.011)
    rise = rng.uniform(0.04, 0.09)
    path = arc(np.pi, 0, 6, (0.9 * width, rise), (0, 0, height))
    handle = sweep(path, (0, 1, 0), thick, thick * rng.uniform(1.0, 2.0), rounded=True, part=1)
    body = slab((width, depth, height), rng.uniform(0.005, 0.95 * min(width, depth)))
    return _held((body, *handle), (80.0, 400.0))


@_family
def lidded(rng: Rng) -> Draft:
    """A wide round body with a knob on its top: a lid, a jar, a sugar bowl."""
    radius = rng.uniform(0.04, 0.09)
    height = rng.uniform(0.01, 0.09)
    neck = rng.uniform(0.006, 0.012)
    knob = rng.uniform(0.012, 0.02)
    length = rng.uniform(0.02, 0.04)
    top = (0, 0, height + length)
    pieces = (
        draft.cylinder((0, 0, 0), (0, 0, height), radius),
        draft.cylinder((0, 0, height), top, neck, part=1),
        draft.ellipsoid((knob, knob, 0.7 * knob), top, part=1),
    )
    return _held(pieces, (100.0, 500.0))


@_family
def sieve(rng: Rng) -> Draft:
    """A ball, a disc or a block at the end of a thin rod: a lollipop, a sieve, a broom."""
    half = rng.uniform(0.02, 0.055, 3)
    thick = rng.uniform(0.003, 0.006)
    length = rng.uniform(0.08, 0.16)
    start = np.array((0.95 * half[0], 0, 0))
    rise = rng.uniform(-0.3, 0.6)
    end = start + length * np.array((np.cos(rise), 0, np.sin(rise)))
    build_head = draft.ellipsoid if rng.random() < 0.5 else draft.box
    head = build_head(tuple(half))
    rod = draft.capsule(tuple(start), tuple(end), thick, part=1)
    return _held((head, rod), (80.0, 500.0))


def _held(pieces: tuple[Piece, ...], density: tuple[float, float]) -> Draft:
    """An object that may be held by its thin handle alone, part 1."""
    return Draft(pieces, ("body", "handle"), (False, True), density=density, thin=True)
