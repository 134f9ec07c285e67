"""Contacts of the object with the links of the hand.

PhysX reports only the normal impulses of contacts. The friction on a link is what the forces in its
joints leave: a link with little inertia is in balance. A joint's force includes all contacts but
those between links of the hand.
"""

from typing import Any, NamedTuple

import numpy as np

from congrasp.actors.physics.physx.environment import Environment
from congrasp.actors.physics.physx.library import sapien
from congrasp.actors.physics.physx.units import LENGTH_SCALE
from congrasp.common.task.types import CONTACTS_PER_LINK

_LEAST_FORCE = 1e-4
"""Contacts with a smaller normal force are ignored, N."""
_DIAGONAL = np.sqrt(2.0)
"""Greatest friction over sliding friction times normal force: PhysX bounds two directions."""


class Contact(NamedTuple):
    """A contact point of the object with a link; world frame."""

    force: np.ndarray
    """(3,) normal force on the link, N."""
    size: float
    """Its norm."""
    position: np.ndarray
    """(3,) m."""


class ContactReader:
    """Reads the contacts of one environment after a physics step."""

    def __init__(self, environment: Environment):
        """Looks up the links of an environment."""
        self._environment = environment
        hand = environment.hand
        links = list(hand.articulation.links)
        self._links = [hand.bodies[body] for body in environment.scene.links]
        self._number = {link: number for number, link in enumerate(self._links)}
        self._rows = {link: row for row, link in enumerate(links)}

    def read(self, force: np.ndarray, position: np.ndarray, touches: np.ndarray) -> None:
        """Writes the strongest contacts of each link.

        Args:
          force: (L, C, 3) force of the object on the link, world frame, N.
          position: (L, C, 3) world frame, m.
          touches: (L, C) bool, True for a contact.
        """
        force[:] = 0.0
        position[:] = 0.0
        touches[:] = False
        contacts, on_table = self._contacts()
        if not contacts:
            return
        incoming = self._environment.hand.articulation.get_link_incoming_joint_forces()
        for number, of_link in contacts.items():
            outer = self._outer_force(self._links[number], incoming)
            outer -= on_table.get(number, np.zeros(3))
            normal = _sum(of_link)
            friction = outer - normal
            most = _DIAGONAL * self._environment.friction * sum(one.size for one in of_link)
            friction *= min(1.0, most / max(float(np.linalg.norm(friction)), 1e-9))
            of_link.sort(key=lambda contact: -contact.size)
            strongest = of_link[:CONTACTS_PER_LINK]
            # The strongest contacts carry the friction and the normal forces of the others.
            remainder = normal + friction - _sum(strongest)
            total = sum(contact.size for contact in strongest)
            for slot, contact in enumerate(strongest):
                force[number, slot] = contact.force + contact.size / total * remainder
                position[number, slot] = contact.position
                touches[number, slot] = True

    def _contacts(self) -> tuple[dict[int, list[Contact]], dict[int, np.ndarray]]:
        """Contacts with the object, and normal forces (3,) of the table, by the number of the
        link.
        """
        per_force = self._environment.system.timestep * LENGTH_SCALE
        body = self._environment.object
        with_object: dict[int, list[Contact]] = {}
        on_table: dict[int, np.ndarray] = {}
        for pair in self._environment.system.get_contacts():
            first, second = pair.bodies
            if first in self._number and second in self._number:
                continue
            # The impulse acts on the first body, and its opposite on the second
            number = self._number.get(first)
            other = second
            impulse_to_force = 1.0 / per_force
            if number is None:
                number = self._number.get(second)
                other = first
                impulse_to_force = -1.0 / per_force
            if number is None:
                continue
            for point in pair.points:
                force = point.impulse * impulse_to_force
                size = float(np.linalg.norm(force))
                if size < _LEAST_FORCE:
                    continue
                if other is body:
                    contact = Contact(force, size, point.position / LENGTH_SCALE)
                    with_object.setdefault(number, []).append(contact)
                else:
                    on_table[number] = on_table.get(number, np.zeros(3)) + force
        return with_object, on_table

    def _outer_force(self, link: Any, incoming: np.ndarray) -> np.ndarray:
        """Force (3,) on a link from outside the hand: what its joint does not balance."""
        outer = -self._joint_force(link, incoming)
        for child in link.children:
            outer += self._joint_force(child, incoming)
        return outer

    def _joint_force(self, link: Any, incoming: np.ndarray) -> np.ndarray:
        """Force (3,) of its parent on a link, world frame; PhysX gives it in the joint's frame."""
        frame = link.entity_pose * link.joint.pose_in_child
        rotation = sapien.Pose(q=frame.q).to_transformation_matrix()[:3, :3]
        force: np.ndarray = rotation @ incoming[self._rows[link], :3] / LENGTH_SCALE
        return force


def _sum(contacts: list[Contact]) -> np.ndarray:
    """(3,) sum of the contacts' normal forces."""
    return sum((contact.force for contact in contacts), np.zeros(3))
