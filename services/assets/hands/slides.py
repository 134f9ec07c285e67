"""Slides of a gripper's fingers, as pairs of hinges that move a link on a flat arc.

Hands have hinges alone. The first hinge of a pair turns the link about its base, the second about a
distant axis by as much in the other direction. The link therefore moves without turning, on a
circle whose radius is that distance. Its zero is the end of the slide at which it is farther from
the other links: the open hand.
"""

import contextlib
import pathlib
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.link_geometry import placed
from congrasp.services.assets.hands.links import Tree
from congrasp.services.assets.hands.reading import listed
from congrasp.services.assets.hands.units import MAX_LINK

_TURN = 0.25
"""Angle by which a hinge turns over the range of its slide, rad: the arc is 3 % as high as long."""


class _Slide(NamedTuple):
    """A slide of the hand, in the frame of its body."""

    name: str
    first: str
    """Name of the first hinge; the second has the slide's, and leads."""
    joint: int
    """Its index in the model with slides."""
    radius: float
    """m/rad, from the angle of its hinges to its place."""
    direction: np.ndarray
    """(3,) unit."""
    zero: float
    """Its place at the zero of its hinges, m."""
    axis: np.ndarray
    """(3,) of the second hinge."""
    near: np.ndarray
    """(3,) on the first hinge, m."""
    far: np.ndarray
    """(3,) on the second hinge, m."""


def slides_of(tree: Tree) -> list[int]:
    """Returns the slides of a hand that have a range."""
    model = tree.model
    slides = []
    for link in tree.groups:
        for joint in tree.joints(link):
            is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            if is_slide and np.ptp(model.jnt_range[joint]) > 0:
                slides.append(joint)
    return slides


def with_hinges(
    path: pathlib.Path, spec: mujoco.MjSpec, tree: Tree, notes: list[str]
) -> mujoco.MjModel:
    """Returns a hand's model with a pair of hinges for each slide.

    Motors, tendons and couplings of a slide act on its second hinge, with the same force and path.

    Args:
      path: file of the model.
      spec: the modifiable model, which is changed.
      tree: the hand in the compiled model.
      notes: the slides are appended.

    Raises:
      CongraspError: a slide is longer than any hand's.
    """
    _check_lengths(tree)
    data = mujoco.MjData(tree.model)
    mujoco.mj_kinematics(tree.model, data)
    slides = [_slide(tree, data, joint) for joint in slides_of(tree)]
    joints = {joint.id: joint for joint in spec.joints}
    for slide in slides:
        _replace(spec, joints[slide.joint], slide)
    with contextlib.chdir(path.parent):
        model = spec.compile()
    for slide in slides:
        _set_range(model, tree.model, slide)
        _set_dynamics(model, tree.model, slide)
    radii = np.ones(model.njnt)
    zeros = np.zeros(model.njnt)
    for slide in slides:
        place = tree.model.qpos0[tree.model.jnt_qposadr[slide.joint]]
        for name in (slide.first, slide.name):
            radii[model.joint(name).id] = slide.radius
            zeros[model.joint(name).id] = slide.zero - place
    _scale_transmissions(model, radii)
    _convert_couplings(model, radii, zeros)
    notes += listed(
        "slides are replaced by hinges, which move a link on a flat arc",
        [slide.name for slide in slides],
    )
    return model


def _check_lengths(tree: Tree) -> None:
    """Checks that slides are as long as those of hands.

    Raises:
      CongraspError: one is not.
    """
    for joint in slides_of(tree):
        length = float(np.ptp(tree.model.jnt_range[joint]))
        if length > MAX_LINK:
            name = tree.model.joint(joint).name or f"joint_{joint}"
            raise CongraspError(
                f"The joint '{name}' slides by {length:.3g} m, which is no hand's.",
                "Give its range in metres, or make it a hinge.",
            )


def _slide(tree: Tree, data: mujoco.MjData, joint: int) -> _Slide:
    """The slide of a joint, whose second hinge is on the side of the palm.

    Args:
      tree: the hand.
      data: its bodies in the file's pose, in the world frame.
      joint: the joint.
    """
    model = tree.model
    body = int(model.jnt_bodyid[joint])
    link = tree.owner[body]
    rotation = data.xmat[body].reshape(3, 3)
    center = _center(tree, data, [link])
    others = [other for other in tree.groups if other not in (link, tree.palm)]
    from_others = rotation.T @ (center - _center(tree, data, others or [tree.palm]))
    from_palm = rotation.T @ (center - data.xpos[tree.palm])
    direction = model.jnt_axis[joint]
    lower, upper = model.jnt_range[joint]
    radius = float(upper - lower) / _TURN
    zero = float(upper if from_others @ direction > 0 else lower)
    away = _perpendicular(from_palm, direction)
    middle = ((lower + upper) / 2 - zero) / radius
    arm = radius * (np.cos(middle) * away + np.sin(middle) * direction)
    near = rotation.T @ (center - data.xpos[body])
    near += _lowest(tree, data, link, center, rotation @ away) * away
    name = model.joint(joint).name or f"slide_{joint}"
    return _Slide(
        name=name,
        first=f"{name}_parallel",
        joint=joint,
        radius=radius,
        direction=direction.copy(),
        zero=zero,
        axis=np.cross(away, direction),
        near=near,
        far=near - arm,
    )


def _center(tree: Tree, data: mujoco.MjData, links: list[int]) -> np.ndarray:
    """Mean position (3,) of the geometry of links, else of their masses, in the world frame, m."""
    bodies: list[int] = []
    for link in links:
        bodies += tree.groups[link]
    geoms = np.flatnonzero(np.isin(tree.model.geom_bodyid, bodies))
    positions = data.geom_xpos[geoms] if len(geoms) else data.xipos[bodies]
    return np.asarray(positions.mean(0))


def _lowest(
    tree: Tree, data: mujoco.MjData, link: int, center: np.ndarray, away: np.ndarray
) -> float:
    """Height of a link's base above its center (3,) along a unit direction (3,), m; at most 0."""
    palm_rotation = data.xmat[tree.palm].reshape(3, 3)
    heights = [0.0]
    for mesh in placed(tree, link, colliding=True):
        vertices = data.xpos[tree.palm] + mesh.vertices @ palm_rotation.T
        heights.append(float(((vertices - center) @ away).min()))
    return min(heights)


def _perpendicular(vector: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The unit vector (3,) perpendicular to a unit axis (3,) that is closest to a vector (3,)."""
    candidates = (vector, *np.eye(3))
    perpendiculars = [candidate - (candidate @ axis) * axis for candidate in candidates]
    lengths = [float(np.linalg.norm(perpendicular)) for perpendicular in perpendiculars]
    best = 0 if lengths[0] > 1e-3 else int(np.argmax(lengths))
    return perpendiculars[best] / lengths[best]


def _replace(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, slide: _Slide) -> None:
    """Makes a slide the first hinge of its pair, and adds the second, which gets its name."""
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    limited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.name = slide.first
    joint.type = hinge
    joint.axis = -slide.axis
    joint.pos = slide.near
    joint.limited = limited
    second = joint.parent.add_joint(
        name=slide.name,
        type=hinge,
        axis=slide.axis,
        pos=slide.far,
        limited=limited,
        range=(-_TURN, _TURN),
    )
    second.actfrclimited = joint.actfrclimited
    second.actfrcrange = joint.actfrcrange
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=slide.first,
        name2=slide.name,
        data=[0.0, 1.0, *[0.0] * 10],
    )


def _set_range(model: mujoco.MjModel, before: mujoco.MjModel, slide: _Slide) -> None:
    """Sets the limits of both hinges, and their zero, to which the body is moved."""
    limits = (before.jnt_range[slide.joint] - slide.zero) / slide.radius
    for name in (slide.first, slide.name):
        joint = model.joint(name).id
        model.jnt_range[joint] = limits
        model.qpos0[model.jnt_qposadr[joint]] = 0.0
    body = int(model.jnt_bodyid[model.joint(slide.name).id])
    place = before.qpos0[before.jnt_qposadr[slide.joint]]
    shift = np.zeros(3)
    mujoco.mju_rotVecQuat(shift, (slide.zero - place) * slide.direction, model.body_quat[body])
    model.body_pos[body] += shift


def _set_dynamics(model: mujoco.MjModel, before: mujoco.MjModel, slide: _Slide) -> None:
    """Sets damping and armature of the second hinge, and clears those of the first."""
    slide_dof = before.jnt_dofadr[slide.joint]
    first_dof = model.joint(slide.first).dofadr[0]
    second_dof = model.joint(slide.name).dofadr[0]
    model.dof_damping[first_dof] = 0.0
    model.dof_armature[first_dof] = 0.0
    model.dof_damping[second_dof] = before.dof_damping[slide_dof] * slide.radius**2
    model.dof_armature[second_dof] = before.dof_armature[slide_dof] * slide.radius**2
    model.jnt_actfrcrange[model.joint(slide.name).id] *= slide.radius


def _scale_transmissions(model: mujoco.MjModel, radii: np.ndarray) -> None:
    """Scales motors and fixed tendons.

    Args:
      model: the model.
      radii: (njnt,) unit of each joint in the file per unit of it in the model.
    """
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            model.actuator_gear[actuator, 0] *= radii[model.actuator_trnid[actuator, 0]]
    for wrap in np.flatnonzero(model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT):
        model.wrap_prm[wrap] *= radii[model.wrap_objid[wrap]]


def _convert_couplings(model: mujoco.MjModel, radii: np.ndarray, zeros: np.ndarray) -> None:
    """Converts the polynomials of joints that follow others.

    Args:
      model: the model.
      radii: see `_scale_transmissions`.
      zeros: (njnt,) place of each joint's zero, relative to the file's pose.
    """
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        follower = int(model.eq_obj1id[equality])
        leader = int(model.eq_obj2id[equality])
        if leader < 0:
            continue
        place = np.polynomial.Polynomial([zeros[leader], radii[leader]])
        curve = np.polynomial.Polynomial(model.eq_data[equality, :5])
        converted = (curve(place) - zeros[follower]) / radii[follower]
        model.eq_data[equality, :5] = 0.0
        model.eq_data[equality, : len(converted.coef)] = converted.coef
