"""The palm of a hand in a model: the body with most branches."""

from collections import Counter

import numpy as np

from congrasp.common.runtime.physics_library import mujoco

_PALM_WORDS = ("palm", "hand")
_FREE_JOINTS = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)


def hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Returns indices of a body's joints."""
    start = int(model.body_jntadr[body])
    return list(range(start, start + int(model.body_jntnum[body])))


def find_palm(model: mujoco.MjModel, notes: list[str]) -> int:
    """Returns the body with most branches.

    Of several with as many branches, one named as a palm is preferred, and then the last from the
    root.

    Args:
      model: model with a hand.
      notes: other bodies that could be the palm are appended.
    """
    candidates = _candidates(model)
    links_named_palm = [
        link for link, bodies in candidates.items() if _is_named_palm(model, bodies[0])
    ]
    palm_link = max(links_named_palm or candidates)
    palm = candidates[palm_link][0]
    others = []
    for bodies in candidates.values():
        if bodies == [0]:  # the world alone, which is not the part of a hand
            continue
        others += [model.body(body).name for body in bodies if body != palm]
    if others:
        notes.append(f"the palm could also be {' or '.join(others)} (--palm)")
    return palm


def _candidates(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Bodies with most branches (`_forks`), by their link; the world if no link has two."""
    branches = _branches(model)
    most = max(branches.values(), default=0)
    if most < 2:
        return {0: [0]}
    return {link: _forks(model, link) for link, count in branches.items() if count == most}


def _branches(model: mujoco.MjModel) -> dict[int, int]:
    """Number of links that each link carries, by the body whose joints move it."""
    branches: dict[int, int] = {}
    for body in _jointed_bodies(model):
        carrier = int(model.body_weldid[model.body_parentid[body]])
        branches[carrier] = branches.get(carrier, 0) + 1
    return branches


def _jointed_bodies(model: mujoco.MjModel) -> list[int]:
    """Bodies with joints that neither float nor have a ball joint."""
    bodies = np.flatnonzero(model.body_jntnum).tolist()
    return [body for body in bodies if not _is_free(model, body)]


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    """True if a body floats or has a ball joint."""
    return any(mujoco.mjtJoint(model.jnt_type[j]) in _FREE_JOINTS for j in hinges(model, body))


def _is_named_palm(model: mujoco.MjModel, body: int) -> bool:
    """True if a body is named as a palm."""
    name = model.body(body).name.lower()
    return any(word in name for word in _PALM_WORDS)


def _forks(model: mujoco.MjModel, link: int) -> list[int]:
    """Body of a link whose bodies carry all of its branches; a link may include a fixed mount.

    If that is the world itself, and the bodies with several branches are named as palms, these are
    returned, as the palms of several hands, and the world.
    """
    carriers = []
    for body in _jointed_bodies(model):
        parent = int(model.body_parentid[body])
        if model.body_weldid[parent] == link:
            carriers.append(parent)
    if len(set(carriers)) == 1:
        return carriers[:1]
    paths = [_path_up(model, body, link) for body in carriers]
    common = set(paths[0]).intersection(*paths)
    fork = next(body for body in paths[0] if body in common)
    palms = [body for body, count in Counter(carriers).items() if count > 1 and body]
    are_hands = len(palms) > 1 and all(_is_named_palm(model, body) for body in palms)
    if not fork and are_hands:
        return [*palms, 0]
    return [fork]


def _path_up(model: mujoco.MjModel, body: int, end: int) -> list[int]:
    """Bodies from one to one that carries it."""
    path = [body]
    while path[-1] != end:
        path.append(int(model.body_parentid[path[-1]]))
    return path
