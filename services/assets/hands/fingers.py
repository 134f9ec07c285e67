"""Fingers of a hand in a model: one for each tip, wherever its branch begins.

A link that carries no further link ends a finger, with two exceptions: a rod of a linkage, which
the file ties to another link, and a side branch that is much shorter than the finger it is part of.
"""

import functools

import numpy as np

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.closed_loops import tied_bodies
from congrasp.services.assets.hands.links import Tree
from congrasp.services.assets.hands.reading import listed

_SIDE_BRANCH = 0.5
"""Share of the links and of the reach of the longest branch at a fork, up to which another one is a
side branch.
"""
_LOOPS = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


def finger_ends(tree: Tree, notes: list[str]) -> tuple[int, ...]:
    """Returns the last link of each finger.

    Args:
      tree: the hand.
      notes: other last links are appended.
    """
    ends = set(_ends_beyond(tree, tree.palm, _rods(tree)))
    other_ends = []
    for link in tree.groups:
        if link != tree.palm and link not in ends and not tree.carried(link):
            other_ends.append(tree.names[link])
    notes += listed("last links of no finger, as parts of a linkage", other_ends)
    return tuple(sorted(ends))


def _ends_beyond(tree: Tree, link: int, rods: set[int]) -> list[int]:
    """Last links of the fingers that a link carries, or is the last of.

    Every branch of the palm is a finger. Further away, side branches are not.

    Args:
      tree: the hand.
      link: the link.
      rods: links that end no finger.
    """
    branches = [carried for carried in tree.carried(link) if carried not in rods]
    if not branches:
        return [link] if link != tree.palm else []
    longest = max(_length(tree, branch) for branch in branches)
    farthest = max(_reach(tree, branch) for branch in branches)
    ends = []
    for branch in branches:
        is_long = _length(tree, branch) > _SIDE_BRANCH * longest
        reaches_far = _reach(tree, branch) > _SIDE_BRANCH * farthest
        if link == tree.palm or (is_long and reaches_far):
            ends += _ends_beyond(tree, branch, rods)
    return ends


def _length(tree: Tree, link: int) -> int:
    """Number of links of the longest chain that begins with a link."""
    lengths = [_length(tree, carried) for carried in tree.carried(link)]
    return 1 + max(lengths, default=0)


def _reach(tree: Tree, link: int) -> float:
    """Distance from a link's first joint to the end of its farthest geometry beyond it, m."""
    start = tree.data.xanchor[tree.joints(link)[0]]
    return max(_distance(tree, other, start) for other in _with_carried(tree, link))


def _with_carried(tree: Tree, link: int) -> list[int]:
    """A link, and all links beyond it."""
    links = [link]
    for carried in tree.carried(link):
        links += _with_carried(tree, carried)
    return links


def _distance(tree: Tree, link: int, start: np.ndarray) -> float:
    """Distance from a point (3,) to the farthest geometry of a link, else to its centre of mass."""
    model = tree.model
    data = tree.data
    farthest = 0.0
    for body in tree.groups[link]:
        geoms = np.flatnonzero(model.geom_bodyid == body)
        centers = data.geom_xpos[geoms]
        distances = np.linalg.norm(centers - start, axis=-1) + model.geom_rbound[geoms]
        to_mass = float(np.linalg.norm(data.xipos[body] - start))
        farthest = max(farthest, *distances.tolist(), to_mass)
    return farthest


def _rods(tree: Tree) -> set[int]:
    """Last links that an equality ties to another link which reaches at least as far.

    They close loops of links, such as the rods that turn the last link of a gripper's finger.
    """
    rods: set[int] = set()
    for first, second in _tied_links(tree):
        ends = [link for link in (first, second) if not tree.carried(link) and link not in rods]
        if ends:
            rods.add(min(ends, key=functools.partial(_distance_from_palm, tree)))
    return rods


def _tied_links(tree: Tree) -> list[tuple[int, int]]:
    """Pairs of links of the hand that an equality of the model ties to each other."""
    model = tree.model
    pairs = []
    for equality in np.flatnonzero(np.isin(model.eq_type, _LOOPS) & model.eq_active0):
        bodies = tied_bodies(model, int(equality))
        if not all(body in tree.owner for body in bodies):
            continue
        first, second = (tree.owner[body] for body in bodies)
        if tree.palm not in (first, second) and first != second:
            pairs.append((first, second))
    return pairs


def _distance_from_palm(tree: Tree, link: int) -> float:
    """Distance from the palm's origin to the farthest geometry of a link, m."""
    return _distance(tree, link, np.zeros(3))
