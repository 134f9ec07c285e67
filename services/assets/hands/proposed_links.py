"""Links of an imported hand with capsules, joints, gains and tips, from its tree in a model."""

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import RESERVED_JOINTS
from congrasp.common.hands.spec import Capsule, Joint, Link, vector
from congrasp.common.io.inputs import distinct_names
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.actuators import MIN_LEVER, Drive
from congrasp.services.assets.hands.capsules import bare, far_end, fit_capsules, inertia_boxes
from congrasp.services.assets.hands.links import Tree, identifier, renamed
from congrasp.services.assets.hands.reading import listed

_MIN_MASS = 1e-3
"""Mass of a link without any, kg."""
_TIP_CONTACT_WEIGHT = 3.0


def proposed_links(
    tree: Tree,
    ends: tuple[int, ...],
    points: dict[int, list[np.ndarray]],
    notes: list[str],
) -> tuple[list[Link], Drive]:
    """Returns the links of a hand, and their drive.

    Args:
      tree: the hand in the model.
      ends: the last link of each finger.
      points: (3,) of each link's geometry, m.
      notes: proposals are appended.

    Raises:
      CongraspError: a joint is neither a hinge nor a slide, or has no limits.
    """
    anchors = {link: _anchor(tree, link) for link in tree.groups}
    geometry_notes: list[str] = []
    capsules = _capsules(tree, points, anchors, geometry_notes)
    tips = {link: far_end(capsules[link], anchors[link]) for link in ends}
    joints = _joint_names(tree, notes)
    drive = Drive(tree.model, tree.data, joints, _levers(tree, tips))
    links = []
    for link, bodies in tree.groups.items():
        mass = float(sum(tree.model.body_mass[body] for body in bodies))
        if mass <= 0:
            notes.append(f"'{tree.names[link]}' has no mass: 1 g ('mass' in the hand file)")
        is_tip = link in tips
        links.append(
            Link(
                name=tree.names[link],
                parent="" if link == tree.palm else tree.names[tree.above(link)],
                joints=tuple(_joint(tree, j, joints[j], drive) for j in tree.joints(link)),
                capsules=capsules[link],
                mass=max(mass, _MIN_MASS),
                contact_weight=_TIP_CONTACT_WEIGHT if is_tip else 1.0,
                tip=vector(tips[link].round(6)) if is_tip else None,
            )
        )
    notes += geometry_notes
    return links, drive


def _anchor(tree: Tree, link: int) -> np.ndarray:
    """Position (3,) of a link's first joint in the palm's frame, m; zeros for the palm."""
    joints = tree.joints(link)
    return tree.data.xanchor[joints[0]] if joints else np.zeros(3)


def _capsules(
    tree: Tree,
    points: dict[int, list[np.ndarray]],
    anchors: dict[int, np.ndarray],
    notes: list[str],
) -> dict[int, tuple[Capsule, ...]]:
    """Capsules of each link, from its geometry, else from its inertia, else around its joints."""
    capsules = {}
    from_inertia: list[str] = []
    empty: list[str] = []
    for link in tree.groups:
        link_points = points[link]
        if not link_points:
            link_points = inertia_boxes(tree, link)
            if link_points:
                from_inertia.append(tree.names[link])
        if not link_points:
            carried_anchors = [anchors[other] for other in tree.carried(link)]
            link_points = bare(anchors[link], *carried_anchors)
            empty.append(tree.names[link])
        capsules[link] = fit_capsules(np.array(link_points))
    notes += listed(
        "no geometry, capsules follow from inertias ('capsules' in the hand file)", from_inertia
    )
    notes += listed(
        "no geometry and no inertia, thin capsules ('capsules' in the hand file)", empty
    )
    return capsules


def _joint_names(tree: Tree, notes: list[str]) -> dict[int, str]:
    """Names of the hand's joints in its order, distinct from those of links."""
    joints: list[int] = []
    for link in tree.groups:
        joints += tree.joints(link)
    names = [identifier(tree.model.joint(j).name, f"joint_{j}") for j in joints]
    taken = {*tree.names.values()} | RESERVED_JOINTS
    free_names = [f"{name}_joint" if name in taken else name for name in names]
    numbered = distinct_names(free_names, str)
    notes += renamed("joints", names, numbered)
    return dict(zip(joints, numbered, strict=True))


def _levers(tree: Tree, tips: dict[int, np.ndarray]) -> dict[int, float]:
    """Distance of each joint that moves a tip from the farthest of them, m."""
    levers: dict[int, float] = {}
    for link, tip in tips.items():
        while link != tree.palm:
            for j in tree.joints(link):
                distance = float(np.linalg.norm(tree.data.xanchor[j] - tip))
                levers[j] = max(levers.get(j, MIN_LEVER), distance)
            link = tree.above(link)
    return levers


def _joint(tree: Tree, j: int, name: str, drive: Drive) -> Joint:
    """A hinge with its limits and gains."""
    if tree.model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
        raise CongraspError(
            f"The joint '{name}' is neither a hinge nor a slide with a range.",
            "Remove it or fix it: only hands with such joints can be imported.",
        )
    limits = drive.limits(j)
    if limits is None:
        raise CongraspError(f"The joint '{name}' has no limits.", "Add its range to the file.")
    lower, upper = limits
    without_gains = Joint(
        name,
        axis=vector(tree.data.xaxis[j]),
        anchor=vector(tree.data.xanchor[j]),
        lower=0.0,
        upper=0.0,
        kp=0.0,
        kv=0.0,
        torque_limit=0.0,
    )
    return drive.joint(j, lower, upper, without_gains)
