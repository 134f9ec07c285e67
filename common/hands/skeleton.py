"""Input of a hand's surface: links, joints and capsules with every joint at zero, as arrays."""

from typing import NamedTuple

import numpy as np

from congrasp.common.hands.spec import Hand, link_origin


class Skeleton(NamedTuple):
    """L links, C capsules and F joints in the wrist frame with every joint at zero, metres."""

    hand: str
    """Name of the hand."""
    names: tuple[str, ...]
    """L names; the first is the palm."""
    parents: np.ndarray
    """(L,) index of each link's parent, -1 for the palm."""
    origins: np.ndarray
    """(L, 3) origins of the links' frames, whose axes are parallel to the wrist's."""
    capsules: np.ndarray
    """(C, 2, 3)."""
    radii: np.ndarray
    """(C,)."""
    capsule_link: np.ndarray
    """(C,) index of the link of each capsule."""
    anchors: np.ndarray
    """(F, 3)."""
    axes: np.ndarray
    """(F, 3) unit."""
    joint_link: np.ndarray
    """(F,) index of the link that each joint moves."""

    def chains(self) -> list[list[int]]:
        """Links from the palm (excluded) to each last link with a capsule, a thumb first."""
        found = []
        for tip in np.unique(self.capsule_link):
            if tip and not (self.parents == tip).any():
                chain = [int(tip)]
                while self.parents[chain[0]] > 0:
                    chain.insert(0, int(self.parents[chain[0]]))
                found.append([link for link in chain if (self.capsule_link == link).any()])
        return sorted(found, key=lambda chain: not self.names[chain[-1]].startswith("thumb"))


def skeleton_of(hand: Hand) -> Skeleton:
    """Returns the skeleton of a hand."""
    names = tuple(link.name for link in hand.links)
    return Skeleton(
        hand.name,
        names,
        np.array([names.index(link.parent) if link.parent else -1 for link in hand.links]),
        np.array([link_origin(link) for link in hand.links], float),
        hand.capsules.astype(float),
        hand.capsule_radii.astype(float),
        hand.capsule_links,
        np.array([joint.anchor for joint in hand.joints], float),
        np.array([joint.axis for joint in hand.joints], float),
        hand.joint_links,
    )
