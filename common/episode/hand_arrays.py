"""A hand's joints, links and capsules as arrays."""

import numpy as np

from congrasp.common.hands.spec import Hand, capsule_ends


def hand_arrays(hand: Hand) -> dict[str, np.ndarray]:
    """Joints, links and capsules of a hand, by the names of an episode's fields."""
    names = [link.name for link in hand.links]
    parents = []
    capsule_links = []
    radii = []
    for index, link in enumerate(hand.links):
        parents.append(names.index(link.parent) if link.parent in names else -1)
        for capsule in link.capsules:
            capsule_links.append(index)
            radii.append(capsule.radius)
    return {
        "joint_names": np.array([joint.name for joint in hand.joints]),
        "joint_link": hand.joint_links.astype(np.int32),
        "joint_axis": np.array([joint.axis for joint in hand.joints]),
        "joint_anchor": np.array([joint.anchor for joint in hand.joints]),
        "joint_limits": np.array([(joint.lower, joint.upper) for joint in hand.joints]),
        "link_names": np.array(names),
        "link_parent": np.array(parents, np.int32),
        "capsule_link": np.array(capsule_links, np.int32),
        "capsule_ends": np.concatenate([capsule_ends(link) for link in hand.links]),
        "capsule_radius": np.array(radii),
    }
