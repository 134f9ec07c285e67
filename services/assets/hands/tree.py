"""Which bodies of a model are a hand: its palm, and what branches off it.

A body without a hinge belongs to what carries it, so that a model is a tree of links. The palm is the link off which
most branches go; what stands before it (an arm, a wrist) is left out, since the wrist is a virtual mount here.
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
    """The link that each body belongs to."""
    ends: tuple[int, ...]
    """The last link of each finger."""


def identifier(name: str, other: str) -> str:
    """A name that may stand in a hand file, or another where the file has none."""
    return re.sub(r"\W+", "_", name).strip("_") or other


def body_name(model: mujoco.MjModel, body: int) -> str:
    """A body's name as an identifier."""
    return identifier(model.body(body).name, f"body_{body}")


def hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Indices of a body's joints."""
    start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return list(range(start, start + count))


def hand_tree(model: mujoco.MjModel, wanted: str, notes: list[str]) -> Tree:
    """The hand of a model.

    Args:
      model: anything with a hand in it.
      wanted: the palm's body, or nothing.
      notes: what is doubtful is added to it.

    Raises:
      CongraspError: there is no body of that name.
    """
    names = [model.body(i).name for i in range(model.nbody)]
    if wanted and wanted not in names:
        raise CongraspError(f"There is no body '{wanted}'.", f"Name one of: {', '.join(filter(None, names))}.")
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
    last: dict[int, int] = {}  # where a finger branches again, its longest branch has the tip
    for link in groups:
        if link != palm and depth[link] > depth.get(last.get(root[link], palm), 0):
            last[root[link]] = link
    return Tree(palm, groups, owner, tuple(last.values()))


def _palm(model: mujoco.MjModel, notes: list[str]) -> int:
    """The body with most branches; of several, one that is called so, the last from the root."""
    carrier = list(range(model.nbody))  # of each body, the one whose joints move it
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
    """The body of a link whose bodies carry all of its branches: that of the world may be a fixed mount below."""
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
