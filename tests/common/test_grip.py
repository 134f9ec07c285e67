"""Resistance of contacts to an object's weight, worked out by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.task.grip import ObjectLoad, resistance
from congrasp.common.task.types import CONTACTS_PER_LINK
from tests.scenes import L, scene

STATE, _, _ = scene(0, batch=1)
EVERY_LINK = jnp.ones((1, L), bool)


def two_contacts(force: float, half_distance: float, center: float = 0.0):
    """Two opposite contacts on the x axis, with the object's centre of mass at the origin."""
    contact_found = np.zeros((1, L, CONTACTS_PER_LINK), bool)
    forces = np.zeros((1, L, CONTACTS_PER_LINK, 3), np.float32)
    positions = np.full((1, L, CONTACTS_PER_LINK, 3), np.nan, np.float32)
    for link, side in ((0, -1.0), (1, 1.0)):
        contact_found[0, link, 0] = True
        forces[0, link, 0] = (-side * force, 0.0, 0.0)
        positions[0, link, 0] = (center + side * half_distance, 0.0, 0.0)
    return STATE._replace(
        contact_found=jnp.asarray(contact_found),
        contact_force=jnp.asarray(forces),
        contact_position=jnp.asarray(positions),
        object_position=jnp.zeros((1, 3)),
    )


def load(weight: float, friction: float = 1.0) -> ObjectLoad:
    return ObjectLoad(jnp.array([weight]), jnp.array([friction]))


def test_no_contact_resists_nothing():
    state = two_contacts(5.0, 0.02)._replace(contact_found=jnp.zeros((1, L, 3), bool))
    assert resistance(state, load(2.0), EVERY_LINK) == pytest.approx(0.0)


def test_strong_contacts_resist_everything():
    # 10 N of friction for twice 2 N; 0.2 N.m for twice 2 N at the least lever of 1 cm, 0.04 N.m.
    assert resistance(two_contacts(5.0, 0.02), load(2.0), EVERY_LINK) == pytest.approx(1.0)


def test_heavy_object_needs_more_force():
    # 10 N of friction for twice 10 N: a half. 0.2 N.m for 0.2 N.m: all.
    assert resistance(two_contacts(5.0, 0.02), load(10.0), EVERY_LINK) == pytest.approx(0.75)


def test_lever_of_the_weight_counts():
    # 10 N for 8 N: all. 0.2 N.m for twice 4 N at 10 cm: a quarter.
    state = two_contacts(5.0, 0.02, center=0.1)
    assert resistance(state, load(4.0), EVERY_LINK) == pytest.approx((1.0 + 0.25) / 2)


def test_contacts_at_one_spot_resist_no_torque():
    assert resistance(two_contacts(5.0, 0.0), load(2.0), EVERY_LINK) == pytest.approx(0.5)


def test_links_that_do_not_count_are_left_out():
    only_first = jnp.asarray(np.arange(L)[None] == 0)
    # 5 N for 4 N; a single contact has no distance from itself.
    assert resistance(two_contacts(5.0, 0.02), load(2.0), only_first) == pytest.approx(0.5)
