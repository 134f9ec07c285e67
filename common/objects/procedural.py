"""Procedural objects from seeds, with part labels and resting poses."""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.families import BASIC, BUILDERS, HOUSEHOLD, SCANS, Draft
from congrasp.common.objects.families.draft import moved
from congrasp.common.objects.resting import rest_poses
from congrasp.common.objects.shapes import DENSE, balanced, halves, mass_properties, sample_union
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject, Piece
from congrasp.common.runtime.parallel import parallel_map

FAMILIES: tuple[str, ...] = tuple(BUILDERS)
BASIC_FAMILIES = tuple(BASIC)
HOUSEHOLD_FAMILIES = tuple(HOUSEHOLD)
GROUPS = {
    "basic": BASIC_FAMILIES,
    "household": HOUSEHOLD_FAMILIES,
    "all": (*BASIC_FAMILIES, *HOUSEHOLD_FAMILIES),
    "scans": tuple(SCANS),
}
"""Names of groups of families; shapes of scans are a separate group, so that pools of `all` do not
change.
"""
MASS_RANGE = (0.02, 0.6)
"""Kilograms."""
_SETTLING_MASS_RANGE = (0.05, 0.5)
_HOUSEHOLD_SETTLING_MASS_RANGE = (0.02, 0.5)
"""Ranges in kilograms to which the mass is clipped while an object settles into its resting poses:
of basic families, and of the others. They are fixed so that a change of `MASS_RANGE` does not move
resting poses by rounding errors."""
_SIZE_RANGE = (0.03, 0.25)
"""Metres; the largest side of a basic object."""
_HOUSEHOLD_SIZE_RANGE = (0.03, 0.3)
"""Metres; the largest side of any other object."""
_MIN_SHARE = 0.1
"""Smallest share of the surface points in the graspable region, and in the avoid region."""
_MAX_ATTEMPTS = 100
"""Drafts of a family before a seed is given up."""


def generate(seed: int, family: str | None = None) -> GraspObject:
    """Generates a random object, the same for the same seed and family.

    Its largest side is between 3 and 25 cm (30 cm in household families) and its mass between 0.02
    and 0.6 kg. Both its graspable and its avoid region have at least a tenth of its surface points.
    Mass and inertia are those of the sum of its pieces (overlaps count twice), scaled together if
    the mass is out of range.

    Args:
      seed: not negative; seeds from one million upward are reserved for evaluation.
      family: one of `FAMILIES`; by default a basic one chosen by the seed.

    Raises:
      CongraspError: the family is unknown or the seed negative.
    """
    if family is None:
        _check(seed, ())
        choice = np.random.default_rng((seed, len(BASIC))).integers(len(BASIC))
        family = BASIC_FAMILIES[choice]
    else:
        _check(seed, (family,))
    # Seeded by name, so that adding families does not change the objects of others; basic ones keep
    # their first numbers.
    stream = BASIC_FAMILIES.index(family) if family in BASIC else zlib.crc32(family.encode())
    rng = np.random.default_rng((seed, stream))
    for _ in range(_MAX_ATTEMPTS):
        obj = build_object(f"{family}_{seed}", family, BUILDERS[family](rng), rng)
        if obj is not None:
            return obj
    raise RuntimeError(f"family {family} produced no valid object for seed {seed}")


def generate_many(count: int, seed: int, families: Sequence[str] = ()) -> list[GraspObject]:
    """Generates `count` objects with the seeds `seed`, `seed` + 1, ..., cycling through the
    families.

    Args:
      count: number of objects.
      seed: the first seed.
      families: names of `FAMILIES` or `GROUPS`; empty means the basic ones.

    Raises:
      CongraspError: a family is unknown or the seed negative.
    """
    return parallel_map(generate, range(seed, seed + count), family_turns(count, seed, families))


def family_turns(count: int, seed: int, families: Sequence[str] = ()) -> list[str]:
    """Families of the objects of `generate_many`, in order."""
    names: list[str] = []
    for entry in families or ("basic",):
        names += GROUPS.get(entry, (entry,))
    _check(seed, names)
    return [names[(seed + i) % len(names)] for i in range(count)]


def _check(seed: int, families: Sequence[str]) -> None:
    """Raises a CongraspError for a negative seed or an unknown family."""
    if seed < 0:
        raise CongraspError(f"The seed {seed} is negative.", "Pass a seed of at least 0.")
    for family in families:
        if family not in BUILDERS:
            raise CongraspError(
                f"There is no object family '{family}'.",
                f"Choose from the families {', '.join((*FAMILIES, *GROUPS))}.",
            )


def build_object(
    name: str, family: str, draft: Draft, rng: np.random.Generator
) -> GraspObject | None:
    """Builds the object of a draft; returns None if its size or its parts are out of range.

    Args:
      name: name of the object.
      family: name of its family, which determines the ranges of size and mass.
      draft: pieces and parts.
      rng: generator of densities, surface points and halves.
    """
    mass, center, inertia = mass_properties(draft.pieces, _densities(draft, rng))
    pieces = tuple(moved(piece, -center) for piece in draft.pieces)
    points, normals, owner = _surface(draft, pieces, rng)
    if draft.part_names:
        part_names = draft.part_names
        graspable = np.array(draft.graspable)
        labels = _parts(pieces)[owner]
    else:
        part_names = ("near half", "far half")
        near_is_graspable = rng.random() < 0.5
        graspable = np.array([near_is_graspable, not near_is_graspable])
        labels = halves(points, rng.uniform(0.35, 0.65))
    min_size, max_size = _SIZE_RANGE if family in BASIC else _HOUSEHOLD_SIZE_RANGE
    if not min_size <= _largest_side(pieces) <= max_size:
        return None
    if not _MIN_SHARE <= graspable[labels].mean() <= 1 - _MIN_SHARE:
        return None
    settling_range = _SETTLING_MASS_RANGE
    if family not in BASIC:
        settling_range = _HOUSEHOLD_SETTLING_MASS_RANGE
    settling_mass = np.clip(mass, *settling_range)
    final_mass = np.clip(draft.heavier * mass, *MASS_RANGE)
    vertices, faces = shapes.mesh_of(pieces)
    settling = GraspObject(
        name=name,
        family=family,
        pieces=pieces,
        part_names=part_names,
        graspable=graspable,
        mass=float(settling_mass),
        inertia=inertia * settling_mass / mass,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=labels,
        rest_poses=np.zeros((0, 7)),
        visual_vertices=vertices,
        visual_faces=faces,
    )
    return dataclasses.replace(
        settling,
        mass=float(final_mass),
        inertia=inertia * final_mass / mass,
        rest_poses=rest_poses(settling),
    )


def _densities(draft: Draft, rng: np.random.Generator) -> np.ndarray:
    """Density (pieces,) of each piece, kg/m^3: a random one, weighted by the piece's part."""
    weights = np.array(draft.weight or [1.0] * max(1, len(draft.part_names)))
    return rng.uniform(*draft.density) * weights[[piece.part for piece in draft.pieces]]


def _parts(pieces: Sequence[Piece]) -> np.ndarray:
    """Part (pieces,) int32 of each piece."""
    return np.array([piece.part for piece in pieces], np.int32)


def _largest_side(pieces: Sequence[Piece]) -> float:
    """Largest side of the pieces' bounding box, m."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    reach = np.max([shapes.support(piece, axes) for piece in pieces], axis=0)
    return float((reach[:3] + reach[3:]).max())


def _surface(
    draft: Draft, pieces: tuple[Piece, ...], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (512, 3), normals (512, 3) and owning pieces (512,) of the object's surface.

    Half of the points of a thin draft lie in its graspable region.
    """
    if not draft.thin:
        return sample_union(pieces, rng, SURFACE_POINTS)
    points, normals, owner = sample_union(pieces, rng, DENSE)
    is_graspable = np.array(draft.graspable)[_parts(pieces)[owner]]
    chosen = balanced(is_graspable)
    return points[chosen], normals[chosen], owner[chosen]


def plain_object(name: str, pieces: tuple[Piece, ...], density: float) -> GraspObject:
    """Returns an object of convex pieces.

    Args:
      name: name of the object.
      pieces: convex pieces in the object frame; its origin is assumed to be the centre of mass.
      density: density, kg/m^3.
    """
    mass, _, inertia = mass_properties(pieces, np.full(len(pieces), density))
    points, normals, _ = sample_union(pieces, np.random.default_rng(0))
    vertices, faces = shapes.mesh_of(pieces)
    return GraspObject(
        name=name,
        family=name,
        pieces=pieces,
        part_names=("all",),
        graspable=np.array([True]),
        mass=mass,
        inertia=inertia,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=np.zeros(len(points), np.int32),
        rest_poses=np.zeros((0, 7)),
        visual_vertices=vertices,
        visual_faces=faces,
    )
