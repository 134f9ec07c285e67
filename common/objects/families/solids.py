"""Flat and solid household objects: cartons, books, frames; lathed and extruded profiles, blobs,
animals, clusters.
"""

import functools
import itertools

import numpy as np

from congrasp.common.objects.families import draft
from congrasp.common.objects.families.draft import (
    Builder,
    Draft,
    Rng,
    extrude,
    grid,
    hull,
    lathe,
    ring,
    slab,
    smooth,
    sweep,
    thickened,
)
from congrasp.common.objects.spec import Piece

BUILDERS: dict[str, Builder] = {}
_family = functools.partial(draft.enter, BUILDERS)
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
"""Turn in rad between consecutive points of a spiral that covers a sphere evenly."""
_CORNERS = 60
"""Points on the surface of a blob."""


@_family
def carton(rng: Rng) -> Draft:
    """A packet, up to 7 x 17 x 22 cm: cereal, crackers, tea."""
    half = (rng.uniform(0.01, 0.035), rng.uniform(0.025, 0.085), rng.uniform(0.04, 0.11))
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
    half = (rng.uniform(0.032, 0.041), rng.uniform(0.065, 0.085), rng.uniform(0.0055, 0.0075))
    camera_half = (rng.uniform(0.01, 0.02), rng.uniform(0.01, 0.02), rng.uniform(0.001, 0.002))
    center = (
        half[0] - camera_half[0] - 0.005,
        half[1] - camera_half[1] - 0.005,
        half[2] + camera_half[2],
    )
    case = slab(half, rng.uniform(0.006, 0.012))
    camera = slab(camera_half, 0.004, center)
    return Draft((case, camera), density=(1000.0, 2000.0))


@_family
def remote_control(rng: Rng) -> Draft:
    """A long bar whose ends differ, with a curved back."""
    length = rng.uniform(0.13, 0.22)
    wide = rng.uniform(0.017, 0.027)
    thick = rng.uniform(0.007, 0.014)
    places = np.linspace(-length / 2, length / 2, 4)
    scales = 1 + rng.uniform(-0.25, 0.25) * np.array([-1, -0.3, 0.3, 1])
    depths = thick * (1 + rng.uniform(0, 0.8) * np.array([0, 1, 0.6, 0]))
    sections = []
    for x, scale, depth in zip(places, scales, depths, strict=True):
        front_half = wide * scale
        back_half = 0.7 * wide * scale
        front = grid((x,), (-front_half, front_half), (thick,))
        back = grid((x,), (-back_half, back_half), (-depth,))
        sections.append(np.concatenate([front, back]))
    pieces = [hull(*pair) for pair in itertools.pairwise(sections)]
    return Draft(tuple(pieces), density=(500.0, 1200.0))


@_family
def eyeglasses(rng: Rng) -> Draft:
    """Two lenses, a bridge and two temples, folded or not."""
    wide = rng.uniform(0.021, 0.028)
    high = rng.uniform(0.015, 0.023)
    gap = rng.uniform(0.007, 0.011)
    temple = rng.uniform(0.1, 0.14)
    thick = rng.uniform(0.0025, 0.004)
    middle = gap + wide
    opening = rng.uniform(0.05, 1.0) * np.pi / 2
    is_solid = bool(rng.random() < 0.5)
    rim = rng.uniform(0.003, 0.005)
    # One corner is on the bridge's side, one at the temple.
    corner_count = 10 if is_solid else 5
    turns = np.pi + np.linspace(0, 2 * np.pi, corner_count, endpoint=False)
    outside = wide * np.cos(0.2 * np.pi)
    above = high * np.sin(0.2 * np.pi)
    pieces = []
    for side in (-1, 1):
        loop = np.array([(side * (middle + wide * np.cos(t)), 0, high * np.sin(t)) for t in turns])
        if is_solid:
            pieces.append(thickened(loop, 1, 0.0015))
        else:
            pieces += sweep(loop, (0, -1, 0), rim, 0.005, closed=True)
        hinge = np.array((side * (middle + outside), 0, above))
        direction = np.array((-side * np.cos(opening), -np.sin(opening), 0))
        ear = hinge + 0.75 * temple * direction
        tip = hinge + temple * direction - [0, 0, 0.015]
        pieces.append(draft.capsule(tuple(hinge), tuple(ear), thick, part=1))
        across = np.cross(direction, [0, 0, 1])
        pieces += sweep(np.array([ear, tip]), across, 2 * thick, 2 * thick, part=1)
    pieces.append(draft.capsule((-gap, 0, 0), (gap, 0, 0), 0.0025))
    return Draft(tuple(pieces), ("front", "temples"), draft.either(rng), density=(1200.0, 2500.0))


@_family
def picture_frame(rng: Rng) -> Draft:
    """Four bars around a picture, some with a strut behind it."""
    x = rng.uniform(0.035, 0.065)
    z = rng.uniform(0.045, 0.1)
    bar = rng.uniform(0.012, 0.022)
    thick = rng.uniform(0.01, 0.018)
    loop = np.array([(-x, 0, -z), (x, 0, -z), (x, 0, z), (-x, 0, z)])
    pieces = sweep(loop, (0, -1, 0), bar, thick, closed=True)
    if rng.random() < 0.8:
        half = (x - 0.5 * bar, 0.0015, z - 0.5 * bar)
        pieces.append(draft.box(half, (0, 0.2 * thick, 0), part=1))
        if rng.random() < 0.6:
            foot = rng.uniform(0.04, 0.07)
            wide = rng.uniform(0.01, 0.02)
            back = 0.2 * thick
            top = grid((-wide, wide), (back, back + 0.004), (0.4 * z,))
            bottom = grid((-wide, wide), (foot, foot + 0.004), (-z - 0.5 * bar,))
            pieces.append(hull(top, bottom, part=1))
        return Draft(tuple(pieces), ("frame", "picture"), (True, False), density=(300.0, 900.0))
    return Draft(tuple(pieces), density=(300.0, 900.0))


@_family
def hanger(rng: Rng) -> Draft:
    """A triangle of bars with a hook."""
    half = rng.uniform(0.08, 0.125)
    high = rng.uniform(0.05, 0.08)
    bar = rng.uniform(0.011, 0.016)
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
    return Draft(tuple(pieces), ("body", "hook"), (True, False), density=(400.0, 900.0))


@_family
def lathed(rng: Rng) -> Draft:
    """A random smooth profile turned around an axis."""
    height = rng.uniform(0.06, 0.22)
    count = 9
    radii = smooth(rng, count, rng.uniform(0.012, 0.025), rng.uniform(0.028, 0.048))
    profile = list(zip(np.linspace(0, height, count), radii, strict=True))
    squash = rng.choice([1.0, rng.uniform(0.6, 1.0)])
    return Draft(tuple(lathe(profile, squash=squash)))


@_family
def extruded(rng: Rng) -> Draft:
    """An extruded random outline, convex or not, some with a taper."""
    count = rng.integers(5, 13)
    turns = 2 * np.pi / count * (np.arange(count) + rng.uniform(-0.3, 0.3, count))
    radii = rng.uniform(0.02, 0.045) * (1 + rng.uniform(0, 0.8) * rng.uniform(-0.7, 1, count))
    directions = np.stack([np.cos(turns), np.sin(turns)], -1)
    squash = rng.uniform(0.5, 1)
    outline = radii[:, None] * directions * [1, squash]
    taper = rng.choice([1.0, rng.uniform(0.5, 1.0)])
    height = rng.uniform(0.02, 0.18)
    return Draft(tuple(extrude(outline, 0.0, height, taper=taper)))


@_family
def prism(rng: Rng) -> Draft:
    """A prism, a frustum or a pyramid of three to eight sides."""
    count = rng.integers(3, 9)
    taper = rng.choice([1.0, rng.uniform(0.05, 1.0)])
    outline = ring(rng.uniform(0.025, 0.055), 0.0, int(count), rng.uniform(0.6, 1.0))[:, :2]
    height = rng.uniform(0.03, 0.15)
    return Draft(tuple(extrude(outline, 0.0, height, taper=taper)))


@_family
def bracket(rng: Rng) -> Draft:
    """Bars in the shape of an L, T, U, Z or H."""
    a = rng.uniform(0.03, 0.075)
    b = rng.uniform(0.03, 0.07)
    c = rng.uniform(0.03, 0.07)
    bar = rng.uniform(0.014, 0.028)
    thick = rng.uniform(0.014, 0.045)
    strokes: dict[str, list[list[tuple[float, float]]]] = {
        "L": [[(b, 0), (0, 0), (0, 2 * a)]],
        "T": [[(0, 0), (0, 2 * a)], [(-b, 2 * a), (c, 2 * a)]],
        "U": [[(-b, 2 * a), (-b, 0), (b, 0), (b, 2 * c)]],
        "Z": [[(-b, 0), (0, 0), (0.3 * b, 2 * a), (b + c, 2 * a)]],
        "H": [[(-b, -a), (-b, a)], [(b, -c), (b, c)], [(-b, 0), (b, 0)]],
    }
    kind = str(rng.choice(list(strokes)))
    pieces = []
    for stroke in strokes[kind]:
        path = np.array([(x, y, 0.0) for x, y in stroke])
        pieces += sweep(path, (0, 0, 1), bar, thick)
    return Draft(tuple(pieces), density=(300.0, 1500.0))


@_family
def banana(rng: Rng) -> Draft:
    """A bent bar that is thinner at its ends."""
    bend = rng.uniform(0.5, 2.2)
    length = rng.uniform(0.1, 0.19)
    turns = np.linspace(-bend / 2, bend / 2, 7)
    radius = length / bend
    path = radius * np.stack([np.sin(turns), np.cos(turns), 0 * turns], -1)
    thick = rng.uniform(0.024, 0.042) * np.array([0.3, 0.75, 0.95, 1.0, 0.95, 0.75, 0.35])
    depth = thick * rng.uniform(0.7, 1.1)
    return Draft(tuple(sweep(path, (0, 0, 1), thick, depth, rounded=True)))


@_family
def blob(rng: Rng) -> Draft:
    """A potato, a stone, or two of them merged."""
    radii = rng.uniform(0.02, 0.04), rng.uniform(0.025, 0.045), rng.uniform(0.028, 0.06)
    pieces = [_blob(rng, radii, (0, 0, 0))]
    if rng.random() < 0.4:
        center = (0.7 * radii[0], 0, 0.7 * radii[2])
        smaller = rng.uniform(0.5, 0.8) * np.array(radii)
        pieces.append(_blob(rng, tuple(smaller), center))
    return Draft(tuple(pieces))


@_family
def dome(rng: Rng) -> Draft:
    """The upper half of an egg: a computer mouse, a bun, a piece of soap."""
    x = rng.uniform(0.024, 0.04)
    y = rng.uniform(0.03, 0.065)
    z = rng.uniform(0.018, 0.045)
    lean = rng.uniform(-0.3, 0.3)
    heights = np.array([0.0, 0.35, 0.65, 0.85, 0.97])
    rings = []
    for height, width in zip(heights, np.sqrt(1 - heights**2), strict=True):
        circle = ring(x, height * z, 12)
        rings.append(circle * [width, width * y / x, 1] + [0, lean * height * y, 0])
    return Draft((hull(*rings),))


@_family
def piggy(rng: Rng) -> Draft:
    """A round body on four legs with a snout and two ears."""
    length = rng.uniform(0.04, 0.07)
    wide = rng.uniform(0.03, 0.046)
    high = rng.uniform(0.03, 0.046)
    leg = rng.uniform(0.015, 0.03)
    thick = rng.uniform(0.008, 0.013)
    pieces: list[Piece] = [draft.ellipsoid((length, wide, high))]
    for x in (-0.5, 0.5):
        for y in (-0.5, 0.5):
            foot = np.array([x * length, y * wide, -0.8 * high])
            sole = ring(thick, -leg - 0.2 * high, 8) + foot
            top = ring(1.2 * thick, 0.3 * high, 8) + foot
            pieces.append(hull(sole, top, part=1))
    snout_end = length + rng.uniform(0.006, 0.02)
    snout = draft.cylinder((0.85 * length, 0, 0), (snout_end, 0, 0), 0.4 * high, part=1)
    for y in (-1, 1):
        root = np.array([0.55 * length, 0.45 * y * wide, 0.6 * high])
        base = root + np.array([(0.0, -0.008, 0), (0.0, 0.008, 0), (-0.01, 0, 0)])
        ear_tip = root + np.array((0.006, 0.006 * y, rng.uniform(0.02, 0.03)))
        pieces.append(hull(base, [ear_tip], part=1))
    return Draft((*pieces, snout), ("body", "limbs"), (True, False))


@_family
def animal(rng: Rng) -> Draft:
    """A body, a head on a neck, a tail, and four legs or a flat belly."""
    body = rng.uniform(0.035, 0.06), rng.uniform(0.022, 0.038), rng.uniform(0.022, 0.038)
    head = rng.uniform(0.016, 0.028)
    lift = rng.uniform(0.02, 0.06)
    crown = np.array([body[0] * rng.uniform(0.7, 1.0), 0, body[2] + lift])
    nose = crown + np.array((head + rng.uniform(0.01, 0.025), 0, -0.2 * head))
    half = 0.4 * head
    face = grid((crown[0],), (-half, half), (crown[2] - half, crown[2] + half))
    tail_root = (-0.7 * body[0], 0, 0.3 * body[2])
    tail_tip = (-body[0] - 0.02, 0, body[2] * rng.uniform(0, 1.2))
    pieces: list[Piece] = [
        draft.ellipsoid(body),
        draft.ellipsoid((1.1 * head, head, head), tuple(crown), part=1),
        draft.capsule((0.6 * body[0], 0, 0.3 * body[2]), tuple(crown), 0.55 * head, part=1),
        hull(face, [nose], part=1),
        draft.capsule(tail_root, tail_tip, 0.007, part=1),
    ]
    if rng.random() < 0.6:
        leg = rng.uniform(0.02, 0.05)
        thick = rng.uniform(0.006, 0.01)
        for x in (-0.55, 0.55):
            for y in (-0.6, 0.6):
                foot = np.array([x * body[0], y * body[1], -0.4 * body[2]])
                sole = ring(thick, -leg, 6) + foot
                top = ring(thick, 0.0, 6) + foot
                pieces.append(hull(sole, top, part=1))
    else:
        belly = ring(0.7 * body[1], -body[2], 12)
        flank = ring(0.9 * body[1], -0.3 * body[2], 12)
        pieces.append(hull(belly, flank))
    return Draft(tuple(pieces), ("body", "limbs"), draft.either(rng))


@_family
def car(rng: Rng) -> Draft:
    """A chassis, a cabin and four wheels."""
    x = rng.uniform(0.045, 0.08)
    y = rng.uniform(0.02, 0.032)
    z = rng.uniform(0.009, 0.016)
    wheel = rng.uniform(0.011, 0.018)
    cabin = rng.uniform(0.015, 0.03)
    base = grid((-0.55 * x, 0.55 * x), (-0.95 * y, 0.95 * y), (z,))
    roof = base * [0.7, 0.85, 1] + [0, 0, cabin]
    pieces = [draft.box((x, y, z)), hull(base, roof)]
    for axle in (-0.6, 0.6):
        disc = ring(wheel, 0, 12)[:, [0, 2, 1]] + [axle * x, 0, -z]
        for side in (-1, 1):
            inner = np.add(disc, (0, side * 0.8 * y, 0))
            outer = np.add(disc, (0, side * (y + 0.006), 0))
            pieces.append(hull(inner, outer, part=1))
    return Draft(tuple(pieces), ("body", "wheels"), (True, False))


@_family
def figure(rng: Rng) -> Draft:
    """A doll that stands on a foot: trunk, head and arms."""
    high = rng.uniform(0.06, 0.11)
    wide = rng.uniform(0.016, 0.026)
    deep = rng.uniform(0.014, 0.022)
    head = rng.uniform(0.015, 0.026)
    shoulder = np.array([0, wide, 0.85 * high])
    reach = rng.uniform(0.03, 0.05)
    turns = rng.uniform(-1.0, 1.0, 2)
    squash = deep / wide
    trunk = hull(
        ring(1.25 * wide, 0, 12, squash),
        ring(0.8 * wide, 0.55 * high, 12, squash),
        ring(wide, high, 12, squash),
    )
    pieces: list[Piece] = [
        trunk,
        draft.ellipsoid((head, head, 1.15 * head), (0, 0, high + 0.95 * head), part=1),
    ]
    for side, turn in zip((-1, 1), turns, strict=True):
        start = shoulder * [1, side * 0.8, 1]
        end = start + reach * np.array([0.3, side * np.cos(turn), np.sin(turn)])
        pieces.append(draft.capsule(tuple(start), tuple(end), 0.008, part=1))
    if rng.random() < 0.5:
        pieces.append(draft.cylinder((0, 0, -0.006), (0, 0, 0.002), 1.6 * wide))
    return Draft(tuple(pieces), ("trunk", "limbs"), (True, False))


@_family
def cluster(rng: Rng) -> Draft:
    """Four to eight random pieces, each attached to an earlier one."""
    centers = [np.zeros(3)]
    radii = [rng.uniform(0.02, 0.034)]
    pieces = [_chunk(rng, rng.uniform(0.02, 0.034), np.zeros(3))]
    for _ in range(rng.integers(3, 8)):
        parent = rng.integers(len(centers))
        radius = rng.uniform(0.011, 0.026)
        direction = rng.normal(size=3)
        distance = 0.75 * radii[parent] + 0.5 * radius
        center = centers[parent] + distance * direction / np.linalg.norm(direction)
        centers.append(center)
        radii.append(radius)
        pieces.append(_chunk(rng, radius, center, part=1))
    return Draft(tuple(pieces), ("core", "growths"), draft.either(rng))


def _chunk(rng: Rng, radius: float, center: np.ndarray, part: int = 0) -> Piece:
    """A random convex piece of about this radius: a block, a prism or a stone, with a random
    orientation.
    """
    stretch = rng.uniform(0.7, 1.5, 3)
    if rng.random() < 0.4:
        return _blob(rng, tuple(radius * stretch), tuple(center), part)
    outline = ring(radius, 0.0, int(rng.integers(3, 8)))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    bottom = outline - [0, 0, radius]
    top = rng.uniform(0.4, 1.0) * outline + [0, 0, radius]
    corners = np.concatenate([bottom, top]) * stretch
    return hull(corners @ turn.T + center, part=part)


def _blob(rng: Rng, radii: tuple[float, ...], center: tuple[float, ...], part: int = 0) -> Piece:
    """The hull of an egg whose surface is dented by waves."""
    i = np.arange(_CORNERS) + 0.5
    turns = _GOLDEN_ANGLE * i
    z = 1 - 2 * i / _CORNERS
    radius = np.sqrt(1 - z**2)
    unit = np.stack([radius * np.cos(turns), radius * np.sin(turns), z], -1)
    waves = rng.normal(size=(4, 3)) * 1.5
    phases = rng.uniform(0, 2 * np.pi, 4)
    distances = 1 + 0.07 * np.sin(unit @ waves.T + phases).sum(-1)
    dented = unit * distances[:, None]
    return hull(dented * radii + center, part=part)
