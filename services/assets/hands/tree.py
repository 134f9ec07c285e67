"""Finds the bodies of a hand in a model: its palm, and the branches from it.

A body without a hinge belongs to its parent, so that a model is a tree of links. The palm is the link with most
branches; bodies before it (an arm, a wrist) are dropped, since the wrist is a virtual mount.
"""

import dataclasses
import re

import mujoco

from congrasp.common.errors import CongraspError

_CALLED = ("palm", "hand")
_FREE = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)


@dataclasses.dataclass(frozen=True)
class Tree:
    """A hand's links, each named by the body that moves it."""

    palm: int
    groups: dict[int, list[int]]
    """Bodies of each link, the palm's first."""
    owner: dict[int, int]
    """Link of each body."""
    ends: tuple[int, ...]
    """Last link of each finger."""


def identifier(name: str, other: str) -> str:
    """Returns a valid name for a hand file, or another if the file has none."""
    return re.sub(r"\W+", "_", name).strip("_") or other


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Returns a body's name as an identifier."""
    return identifier(model.body(body).name, f"body_{body}")


def hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Indices of a body's joints."""
    start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return list(range(start, start + count))


def hand_tree(model: mujoco.MjModel, wanted: str, notes: list[str]) -> Tree:
    """Returns the hand of a model.

    Args:
      model: model with a hand.
      wanted: body of the palm, or empty.
      notes: doubts are appended.

    Raises:
      CongraspError: there is no body of that name.
    """
    names = [model.body(i).name for i in range(model.nbody)]
    if wanted and wanted not in names:
        raise CongraspError(f"There is no body '{wanted}'.", f"Pass one of: {', '.join(filter(None, names))}.")
    palm = names.index(wanted) if wanted else _palm(model, notes)
    owner, groups = {palm: palm}, {palm: [palm]}
    for body in range(palm + 1, model.nbody):
        parent = int(model.body_parentid[body])
        if parent in owner:
            owner[body] = body if model.body_jntnum[body] else owner[parent]
            groups.setdefault(owner[body], []).append(body)
    depth = {palm: 0}
    root = {palm: palm}
    for link in groups:
        if link != palm:
            above = owner[int(model.body_parentid[link])]
            depth[link], root[link] = depth[above] + 1, link if above == palm else root[above]
    last: dict[int, int] = {}  # where a finger branches again, the tip is on its longest branch
    for link in groups:
        if link != palm and depth[link] > depth.get(last.get(root[link], palm), 0):
            last[root[link]] = link
    return Tree(palm, groups, owner, tuple(last.values()))


def _palm(model: mujoco.MjModel, notes: list[str]) -> int:
    """Body with most branches; among several, one named as a palm, the last from the root."""
    carrier = list(range(model.nbody))  # for each body, the one whose joints move it
    branches: dict[int, int] = {}
    for body in range(1, model.nbody):
        parent = carrier[int(model.body_parentid[body])]
        carrier[body] = body if model.body_jntnum[body] else parent
        if any(mujoco.mjtJoint(model.jnt_type[j]) in _FREE for j in hinges(model, body)):
            continue
        if model.body_jntnum[body]:
            branches[parent] = branches.get(parent, 0) + 1
    found = {link: _fork(model, carrier, link) for link, count in branches.items() if count > 1} or {0: 0}
    most = max(branches.get(link, 0) for link in found)
    best = [link for link in found if branches.get(link, 0) == most]
    called = [link for link in best if any(word in model.body(found[link]).name.lower() for word in _CALLED)]
    chosen = max(called or best)
    others = [model.body(found[link]).name for link in best if link != chosen and link]
    if others:
        notes.append(f"the palm could also be {' or '.join(others)} (--palm)")
    return found[chosen]


def _fork(model: mujoco.MjModel, carrier: list[int], link: int) -> int:
    """Body of a link whose bodies carry all of its branches: the world body may be a fixed mount below."""
    carriers = [
        int(model.body_parentid[body])
        for body in range(1, model.nbody)
        if carrier[body] == body and carrier[int(model.body_parentid[body])] == link
    ]
    if len(set(carriers)) == 1:
        return carriers[0]
    paths = []
    for body in carriers:
        path = [body]
        while path[-1] != link:
            path.append(int(model.body_parentid[path[-1]]))
        paths.append(path)
    return next(body for body in paths[0] if all(body in path for path in paths))
