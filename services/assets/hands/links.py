"""Links of a hand in a model: its palm, and the branches from it.

A body without a hinge belongs to its parent, so that a model is a tree of links. Bodies before the
palm (an arm, a wrist) are dropped, since the wrist is a virtual mount.
"""

import dataclasses
import re
from collections.abc import Iterable

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import distinct_names
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.palm import find_palm, hinges
from congrasp.services.assets.hands.reading import listed


@dataclasses.dataclass(frozen=True)
class Tree:
    """A hand's links in a model, each named by the body that moves it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    """The file's pose, in the palm's frame."""
    palm: int
    groups: dict[int, list[int]]
    """Bodies of each link, the palm's first."""
    owner: dict[int, int]
    """Link of each body."""
    names: dict[int, str]
    """Name of each link for a hand file."""

    def above(self, link: int) -> int:
        """Returns the link that carries another one, which is not the palm."""
        return self.owner[int(self.model.body_parentid[link])]

    def carried(self, link: int) -> list[int]:
        """Returns the links directly on another one."""
        return [other for other in self.groups if other != self.palm and self.above(other) == link]

    def joints(self, link: int) -> list[int]:
        """Returns indices of the joints between a link and the one above."""
        return [] if link == self.palm else hinges(self.model, link)


def identifier(name: str, other: str) -> str:
    """Returns a valid name for a hand file, or another if the file has none."""
    return re.sub(r"\W+", "_", name).strip("_") or other


def renamed(kind: str, before: Iterable[str], after: Iterable[str]) -> list[str]:
    """Returns a note on names that changed because others have them, if there are any."""
    changed = [f"{old} -> {new}" for old, new in zip(before, after, strict=True) if old != new]
    return listed(f"{kind} renamed, as others have their names", changed)


def hand_tree(model: mujoco.MjModel, palm_name: str, notes: list[str]) -> Tree:
    """Returns the hand of a model.

    Args:
      model: model with a hand.
      palm_name: body of the palm; empty for the body with most branches.
      notes: doubts are appended.

    Raises:
      CongraspError: there is no body of that name.
    """
    names = [model.body(i).name for i in range(model.nbody)]
    if palm_name and palm_name not in names:
        existing = ", ".join(name for name in names if name)
        raise CongraspError(
            f"There is no body '{palm_name}'.", f"Pass one of these as --palm: {existing}."
        )
    palm = names.index(palm_name) if palm_name else find_palm(model, notes)
    owner = {palm: palm}
    groups = {palm: [palm]}
    loose: list[str] = []
    for body in range(palm + 1, model.nbody):
        if _floats_in_world(model, body):
            loose.append(names[body] or f"body {body}")
        elif int(model.body_parentid[body]) in owner:
            owner[body] = max(palm, int(model.body_weldid[body]))
            groups.setdefault(owner[body], []).append(body)
    notes += listed("not of the hand, and left out", loose)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    _to_palm(data, palm)
    named = ["palm"]
    named += [identifier(names[link], f"body_{link}") for link in groups if link != palm]
    numbered = distinct_names(named, str)
    notes += renamed("links", named, numbered)
    return Tree(
        model=model,
        data=data,
        palm=palm,
        groups=groups,
        owner=owner,
        names=dict(zip(groups, numbered, strict=True)),
    )


def _floats_in_world(model: mujoco.MjModel, body: int) -> bool:
    """True for a body on a free joint in the world."""
    is_in_world = not model.body_parentid[body]
    return is_in_world and mujoco.mjtJoint.mjJNT_FREE in model.jnt_type[hinges(model, body)]


def _to_palm(data: mujoco.MjData, palm: int) -> None:
    """Transforms positions and axes of the simulation from the world frame to the palm's frame."""
    rotation = data.xmat[palm].reshape(3, 3).copy()
    origin = data.xpos[palm].copy()
    for positions in (data.xpos, data.xipos, data.xanchor, data.geom_xpos):
        positions[:] = (positions - origin) @ rotation
    data.xaxis[:] = data.xaxis @ rotation
    for rotations in (data.ximat, data.geom_xmat):
        rotations[:] = (rotation.T @ rotations.reshape(-1, 3, 3)).reshape(-1, 9)
