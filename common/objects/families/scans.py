"""Shapes found in scans that other families lack: wire frames, large hollow bodies, wide boxes, thin boards."""

import functools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import Builder, Draft, Rng
from congrasp.common.objects.families.profiles import slab, sweep, vessel

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)


@_family
def wire_frame(rng: Rng) -> Draft:
    """Two rectangles of wire and four uprights: a basket, a rack, a cage."""
    x, y, height = rng.uniform(0.03, 0.07), rng.uniform(0.03, 0.09), rng.uniform(0.04, 0.14)
    wire, flare = rng.uniform(0.004, 0.008), rng.uniform(0.8, 1.0)
    corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    low, high = (np.c_[scale * corners, np.full(4, z)] for scale, z in ((flare, 0.0), (1.0, height)))
    pieces = [piece for loop in (low, high) for piece in sweep(loop, (0, 0, 1), wire, wire, closed=True)]
    for bottom, top in zip(low, high, strict=True):
        normal = np.cross(top - bottom, (1.0, 0, 0))
        pieces += sweep(np.array([bottom, top]), normal / np.linalg.norm(normal), wire, wire)
    return Draft(tuple(pieces), density=(1500.0, 5000.0))


@_family
def bucket(rng: Rng) -> Draft:
    """A vessel wider than a hand, under a bow of three bars."""
    radius, height, wall = rng.uniform(0.06, 0.085), rng.uniform(0.09, 0.16), rng.uniform(0.004, 0.006)
    body = vessel([(0, radius * rng.uniform(0.7, 1.0)), (height, radius)], wall, 9)
    reach, rise, bar = radius - wall, rng.uniform(0.05, 0.08), rng.uniform(0.008, 0.014)
    bow = np.array(
        [(-reach, height - 0.02), (-0.7 * reach, height + rise), (0.7 * reach, height + rise), (reach, height - 0.02)]
    )
    path = np.c_[bow[:, 0], np.zeros(4), bow[:, 1]]
    handle = sweep(path, (0, 1, 0), bar, bar, rounded=True, part=1)
    return Draft((*body, *handle), ("body", "handle"), draft.either(rng), density=(200.0, 800.0))


@_family
def crate(rng: Rng) -> Draft:
    """A box with two sides nearly as long as a hand's opening."""
    half = rng.uniform(0.042, 0.058), rng.uniform(0.042, 0.058), rng.uniform(0.03, 0.1)
    return Draft((draft.box(tuple(rng.permutation(half))),), density=(80.0, 400.0))


@_family
def board(rng: Rng) -> Draft:
    """A thin plate with round corners: a cutting board, a tile, a clipboard."""
    half = rng.uniform(0.05, 0.09), rng.uniform(0.09, 0.14), rng.uniform(0.004, 0.008)
    return Draft((slab(half, rng.uniform(0.005, 0.03)),), density=(500.0, 1200.0))
