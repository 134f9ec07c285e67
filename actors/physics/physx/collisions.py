"""Pairs of bodies that collide, as bit masks, and the frictions of their materials."""

from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.mjcf import HAND_CONTYPE
from congrasp.common.runtime.physics_library import mujoco

_BITS = 32
"""Bits of a mask: the greatest number of bodies with shapes."""


class Collisions(NamedTuple):
    """Pairs of bodies of a compiled scene that collide."""

    own_bit: dict[int, int]
    """Mask with one bit for each body with shapes, the table excluded."""
    others: dict[int, int]
    """Mask of the bodies that each of them collides with."""
    table: int
    """Mask of the bodies that the table collides with."""


class Frictions(NamedTuple):
    """Friction of each material. PhysX uses the mean of two materials, MuJoCo the greater friction
    of two geoms; these means equal those maxima.
    """

    link: float
    object: float
    table_to_object: float
    table_to_link: float


def collisions(model: mujoco.MjModel) -> Collisions:
    """Returns the pairs of a compiled scene, by MuJoCo's rules.

    Raises:
      CongraspError: the hand has too many links.
    """
    table = model.body("table").id
    bodies = [body for body in np.unique(model.geom_bodyid).tolist() if body != table]
    if len(bodies) > _BITS:
        raise CongraspError(
            f"The 'physx' engine collides at most {_BITS - 1} links, but the hand has "
            f"{len(bodies) - 1}.",
            "Pass --physics native.",
        )
    own_bit = {body: 1 << index for index, body in enumerate(bodies)}
    others = {}
    for body in bodies:
        partners = [other for other in bodies if _collide(model, body, other)]
        others[body] = sum(own_bit[other] for other in partners)
    on_table = [body for body in bodies if _collide(model, body, table)]
    return Collisions(own_bit, others, sum(own_bit[body] for body in on_table))


def frictions(model: mujoco.MjModel, object_friction: float) -> Frictions:
    """Returns the frictions of the materials in a compiled scene; the object's is
    `object_friction`. Links slide on one another without friction.
    """
    of_table = float(model.geom("table").friction[0])
    of_link = float(model.geom_friction[model.geom_contype == HAND_CONTYPE, 0].max())
    between_object_and_link = max(object_friction, of_link)
    of_object = 2 * between_object_and_link
    return Frictions(
        link=0.0,
        object=of_object,
        table_to_object=2 * max(object_friction, of_table) - of_object,
        table_to_link=2 * max(of_link, of_table),
    )


def _collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    """True if shapes of two bodies may touch: by their masks, not as parent and child, and not
    excluded.
    """
    rigid_first = model.body_weldid[first]
    rigid_second = model.body_weldid[second]
    if rigid_first == rigid_second:
        return False
    parent_of_first = model.body_weldid[model.body_parentid[rigid_first]]
    parent_of_second = model.body_weldid[model.body_parentid[rigid_second]]
    if rigid_first and rigid_second and rigid_second == parent_of_first:
        return False
    if rigid_first and rigid_second and rigid_first == parent_of_second:
        return False
    signatures = ((first << 16) + second, (second << 16) + first)
    if np.isin(signatures, model.exclude_signature).any():
        return False
    contypes = model.geom_contype
    conaffinities = model.geom_conaffinity
    geoms_of_first = model.geom_bodyid == first
    geoms_of_second = model.geom_bodyid == second
    forward = contypes[geoms_of_first][:, None] & conaffinities[geoms_of_second]
    backward = conaffinities[geoms_of_first][:, None] & contypes[geoms_of_second]
    return bool((forward | backward).any())
