"""A hand from a URDF or MJCF file: its content is used, and missing values are proposed.

MuJoCo reads the file in a confined process (`compile`). Links of the hand and their capsules:
`links`. Motors, couplings and tendons: `actuators`. Open and closed poses, from kinematics:
`poses`.
"""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import TAKEN_JOINTS, faults, hand_from_text, hand_text
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.meshes import MAX_DISTANCE, Meshes, load_meshes, save_meshes
from congrasp.common.hands.motors import fitting_scale, motor_limits
from congrasp.common.hands.spec import Hand, Joint, Link, chain_of, vector, wrist_gains
from congrasp.common.io.inputs import distinct_names
from congrasp.common.runtime.mujoco import mujoco
from congrasp.services.assets.hands.actuators import Drive
from congrasp.services.assets.hands.compile import LEAST, confined, listed, robot_spec
from congrasp.services.assets.hands.links import (
    Tree,
    bare,
    far_end,
    fit_capsules,
    hand_tree,
    identifier,
    inertia_boxes,
    link_mesh,
    placed,
    renamed,
    solids_of,
)
from congrasp.services.assets.hands.poses import opening, propose_poses, thumb_of
from congrasp.services.assets.objects.options import METRES, length

_TWO = "A hand has two or more: import a file with all of them, or pass another --palm."
_LEVER = 0.02  # least distance of a joint from the tip that it moves, m
_TURN = np.deg2rad(10)  # largest range of a joint below which grasping is impossible
_SMALL = 0.03  # opening below which a hand is doubtful, m
_LINK = 5e-4, 0.5  # m, sizes of a link
_FAR = 1.0  # m, distance of a joint from the palm's origin
_RANGE = 7.0  # rad, largest limit of a joint
_HEAVY = 5.0  # kg, mass of a link
_HAND = "hand.json"


_NO_HAND = ", which is no hand's."
_TWICE = "Has a scale such as 0.001 been applied twice? Lengths are in metres."
_DEGREES = (
    "Are its limits in degrees? A URDF has radians; an MJCF has degrees, unless <compiler "
    'angle="radian"/>.'
)
_GRAMS = "Is its mass in grams? Masses are in kg."


@dataclasses.dataclass(frozen=True)
class Proposal:
    """An imported hand, and the values missing in the file."""

    hand: Hand
    palm: str
    """Name of the palm in the file; the hand names it `palm`."""
    notes: tuple[str, ...]
    meshes: Meshes
    """Visual meshes of the file."""


@dataclasses.dataclass(frozen=True)
class Choices:
    """Choices of the user that override the file."""

    name: str = ""
    palm: str = ""
    thumb: str = ""
    object_scale: float = 0.0
    own_collision: bool = False
    """Uses the file's collision geometry instead of capsules."""


_GUESSED = Choices()


def import_hand(path: pathlib.Path, choices: Choices = _GUESSED) -> Proposal:
    """Imports the hand of a file, which a confined process reads; see `propose`."""
    with confined(write_proposal, path, dataclasses.asdict(choices)) as (answer, folder):
        hand = hand_from_text(answer["hand"], str(path))
        meshes = load_meshes(folder / _HAND, hand)
    return Proposal(hand, answer["palm"], tuple(answer["notes"]), meshes)


def write_proposal(folder: pathlib.Path, path: str, **choices: Any) -> dict[str, Any]:
    """Does the work of `import_hand` in the confined process: writes the meshes, returns the
    rest.
    """
    proposal = propose(pathlib.Path(path), Choices(**choices))
    save_meshes(folder / _HAND, proposal.meshes)
    return {"hand": hand_text(proposal.hand), "palm": proposal.palm, "notes": list(proposal.notes)}


def propose(path: pathlib.Path, choices: Choices = _GUESSED) -> Proposal:
    """Reads the hand of a file in this process.

    Args:
      path: URDF, whose meshes are searched as ROS does, or MJCF; its root element determines which.
      choices: name, body of the palm, last body of the thumb and object scale, which are otherwise
        guessed; collision.

    Raises:
      CongraspError: the file cannot be read, is not a hand of hinges with at least two fingers, or
        has sizes, ranges or masses of another unit.
    """
    notes: list[str] = []
    _, model = robot_spec(path, notes)
    tree = hand_tree(model, choices.palm, notes)
    palm = model.body(tree.palm).name
    if len(tree.ends) < 2:
        if not model.njnt:
            raise CongraspError(
                f"{path} has no joints.", "If it is a part, import the file that includes it."
            )
        count, shown = (
            ("no finger", "one finger")[len(tree.ends)],
            identifier(palm, f"body_{tree.palm}"),
        )
        raise CongraspError(f"{path} has {count} on its palm '{shown}'.", _TWO)
    wide = np.sqrt(model.body_inertia.max(1) / np.maximum(model.body_mass, LEAST[0])) > _LINK[1]
    said = f"inertias of bodies more than {_LINK[1]:g} m wide (in kg.mm²?), from which kv follows"
    notes += listed(said, [model.body(body).name for body in tree.owner if wide[body]])
    links, drive = _links(tree, _points(path, tree), notes)
    _check_units(path, links)
    if choices.own_collision:
        links = [
            dataclasses.replace(x, solids=solids_of(tree, i))
            for x, i in zip(links, tree.groups, strict=True)
        ]
        kept = [link.name for link in links if not link.solids]
        notes += listed("only meshes as collision geometry, capsules are used", kept)
    name = identifier(choices.name or path.stem, "hand").lower()
    hand = Hand(
        name=f"hand_{name}" if name[0].isdigit() else name,
        links=tuple(links),
        thumb=next(link.name for link in links if link.tip is not None),
        open_pose={},
        closed_pose={},
        wrist=wrist_gains(sum(link.mass for link in links)),
        couplings=drive.couplings(),
        tendons=drive.tendons(),
    )
    notes += drive.remarks()
    if max(joint.upper - joint.lower for joint in hand.joints) < _TURN:
        raise CongraspError(
            f"No joint of the hand in {path} turns by 10 degrees.",
            'Check that its angles are in radians, or add <compiler angle="radian"/>.',
        )
    _check(path, hand, "pose")
    hand = dataclasses.replace(hand, thumb=thumb_of(hand, choices.thumb, notes))
    hand = propose_poses(hand, notes)
    wide = opening(hand)
    if wide < _SMALL:
        notes.append(
            f"thumb and fingers are only {100 * wide:.1f} cm apart ('open_pose' in the hand file, "
            f"or --thumb)"
        )
    scale = choices.object_scale or fitting_scale(wide)
    hand = dataclasses.replace(hand, object_scale=scale)
    _check(path, hand)
    hand = hand_from_text(hand_text(hand), str(path))
    meshes = _meshes(tree, notes)
    return Proposal(hand, palm, tuple(dict.fromkeys(notes)), meshes)


def _check(path: pathlib.Path, hand: Hand, but: str = "") -> None:
    """Raises a CongraspError for an invalid hand; faults that contain the word `but` are
    ignored.
    """
    for fault in faults(hand):
        if not but or but not in fault:
            raise CongraspError(
                f"{path}: {fault}.",
                "Correct the file, or write a hand file by hand (docs/add-a-hand.md).",
            )


def _points(path: pathlib.Path, tree: Tree) -> dict[int, list[np.ndarray]]:
    """Points of each link's geometry, m; raises a CongraspError for a link of a size that no hand
    has.
    """
    points = {
        x: [p for mesh in placed(tree, x, colliding=True) for p in mesh.vertices]
        for x in tree.groups
    }
    for link, some in points.items():
        size = float(np.ptp(some, axis=0).max()) if some else _LINK[1]
        if not _LINK[0] <= size <= _LINK[1]:
            remedy = _smaller_unit(size) if size > _LINK[1] else _TWICE
            raise CongraspError(
                f"{path}: the link '{tree.names[link]}' is {length(size)} long{_NO_HAND}", remedy
            )
    return points


def _check_units(path: pathlib.Path, links: list[Link]) -> None:
    """Raises a CongraspError for distances, angles and masses that no hand has; the remedy is the
    likely unit.
    """
    for link in links:
        away = max((float(np.linalg.norm(joint.anchor)) for joint in link.joints), default=0.0)
        turn = max(
            ((max(-joint.lower, joint.upper), joint.name) for joint in link.joints),
            default=(0.0, ""),
        )
        for wrong, what, remedy in (
            (
                away > _FAR,
                f"the link '{link.name}' turns {length(away)} from the palm",
                _smaller_unit(away),
            ),
            (turn[0] > _RANGE, f"the joint '{turn[1]}' turns to {turn[0]:.4g} rad", _DEGREES),
            (link.mass > _HEAVY, f"the link '{link.name}' weighs {link.mass:.4g} kg", _GRAMS),
        ):
            if wrong:
                raise CongraspError(f"{path}: {what}{_NO_HAND}", remedy)


def _smaller_unit(size: float) -> str:
    """Remedy for a length of a hand, in what should be m, that is too large."""
    units = [
        f"{unit} ({length(size * factor)})"
        for unit, factor in METRES.items()
        if size * factor < _LINK[1]
    ]
    question = f"Are its lengths in {' or '.join(units)}? " if units else ""
    return (
        f'{question}Give meshes a scale such as "0.001 0.001 0.001", and offsets in metres; or '
        f"pass another --palm."
    )


def describe(proposal: Proposal) -> list[str]:
    """Describes the import and its proposals, as lines of text."""
    hand = proposal.hand
    frame = grasp_frame(hand)
    tips = [chain_of(hand, hand.links[i].name) for i in hand.tip_links]
    mass = sum(link.mass for link in hand.links)
    lines = [
        f"hand         {hand.name}: {len(hand.joints)} joints, {len(hand.motors)} motors, "
        f"{len(hand.links)} links, "
        f"{mass:.3f} kg",
        f"palm         {proposal.palm}",
        f"thumb        {' - '.join(tips[0])}",
        *(f"finger       {' - '.join(tip)}" for tip in tips[1:]),
        f"heading v    {_text(frame.heading)} in the palm's frame, cross-finger axis w "
        f"{_text(frame.cross)}",
        f"hand centre  {_text(frame.center)} m, opening {100 * frame.opening:.1f} cm: objects x "
        f"{hand.object_scale:g}",
        "",
        "joint                     from      to    open  closed      kp      kv   limit",
    ]
    for joint, opened, closed in zip(hand.joints, hand.q_open, hand.q_closed, strict=True):
        figures = (joint.lower, joint.upper, opened, closed, joint.kp, joint.kv, joint.torque_limit)
        lines.append(f"{joint.name:22s}" + "".join(f"{x:8.3f}" for x in figures))
    lines += [f"{x.joint:22s} = {x.offset:.3f} + {x.ratio:.3f} {x.leader}" for x in hand.couplings]
    lower, upper = motor_limits(hand)
    for motor, low, high in zip(hand.motors, lower, upper, strict=True):
        if len(motor.joints) > 1:
            pulls = " + ".join(f"{c:g} {name}" for name, c in motor.joints.items())
            gains = f"kp {motor.kp:.3f}, kv {motor.kv:.3f}, limit {motor.torque_limit:.3f}"
            lines.append(f"one motor for {pulls}, from {low:.3f} to {high:.3f}: {gains}")
    return [*lines, "rad, N.m/rad, N.m.s/rad, N.m", *(f"note: {note}" for note in proposal.notes)]


def _text(vector: np.ndarray) -> str:
    """Formats a vector (3,) with three digits."""
    return "(" + ", ".join(f"{x:.3f}" for x in vector) + ")"


def _links(
    tree: Tree, points: dict[int, list[np.ndarray]], notes: list[str]
) -> tuple[list[Link], Drive]:
    """Returns the links and their drive from points of their geometry (m); proposals are appended
    to `notes`.
    """
    at = {
        x: tree.data.xanchor[tree.joints(x)[0]] if tree.joints(x) else np.zeros(3)
        for x in tree.groups
    }
    shapes = {}
    boxed: list[str] = []
    empty: list[str] = []
    for link in tree.groups:
        found = points[link] or inertia_boxes(tree, link)
        if not points[link]:
            (boxed if found else empty).append(tree.names[link])
        carried = [at[x] for x in tree.groups if x != tree.palm and tree.above(x) == link]
        shapes[link] = fit_capsules(np.array(found or bare(at[link], *carried)))
    tips = {link: far_end(shapes[link], at[link]) for link in tree.ends}
    joints = _joint_names(tree, notes)
    drive = Drive(tree.model, tree.data, joints, _levers(tree, tips))
    links = []
    for link, bodies in tree.groups.items():
        mass = float(sum(tree.model.body_mass[body] for body in bodies))
        if mass <= 0:
            notes.append(f"'{tree.names[link]}' has no mass: 1 g ('mass' in the hand file)")
        links.append(
            Link(
                name=tree.names[link],
                parent="" if link == tree.palm else tree.names[tree.above(link)],
                joints=tuple(_joint(tree, j, joints[j], drive) for j in tree.joints(link)),
                capsules=shapes[link],
                mass=max(mass, 1e-3),
                contact_weight=3.0 if link in tips else 1.0,
                tip=vector(tips[link].round(6)) if link in tips else None,
            )
        )
    notes += listed(
        "no geometry, capsules follow from inertias ('capsules' in the hand file)", boxed
    )
    notes += listed(
        "no geometry and no inertia, thin capsules ('capsules' in the hand file)", empty
    )
    return links, drive


def _meshes(tree: Tree, notes: list[str]) -> Meshes:
    """Visual meshes of each link, unless larger than a hand."""
    found = {tree.names[link]: link_mesh(tree, link) for link in tree.groups}
    drawn = {name: mesh for name, mesh in found.items() if mesh is not None}
    large = [name for name, (vertices, _) in drawn.items() if np.abs(vertices).max() > MAX_DISTANCE]
    notes += listed(
        f"drawn more than {MAX_DISTANCE:g} m from the palm (in mm?), and dropped", large
    )
    return {name: mesh for name, mesh in drawn.items() if name not in large}


def _joint_names(tree: Tree, notes: list[str]) -> dict[int, str]:
    """Names of the hand's joints in its order, distinct from those of links."""
    names = {
        j: identifier(tree.model.joint(j).name, f"joint_{j}")
        for link in tree.groups
        for j in tree.joints(link)
    }
    taken = {*tree.names.values()} | TAKEN_JOINTS
    named = distinct_names(
        (f"{name}_joint" if name in taken else name for name in names.values()), str
    )
    notes += renamed("joints", names.values(), named)
    return dict(zip(names, named, strict=True))


def _levers(tree: Tree, tips: dict[int, np.ndarray]) -> dict[int, float]:
    """Distance of each joint of the hand from the farthest tip that it moves, m."""
    levers = {j: _LEVER for link in tree.groups for j in tree.joints(link)}
    for link, tip in tips.items():
        while link != tree.palm:
            for j in tree.joints(link):
                levers[j] = max(levers[j], float(np.linalg.norm(tree.data.xanchor[j] - tip)))
            link = tree.above(link)
    return levers


def _joint(tree: Tree, j: int, name: str, drive: Drive) -> Joint:
    """Returns a hinge."""
    if tree.model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
        raise CongraspError(
            f"The joint '{name}' is not a hinge.", "Only hands of hinges can be imported."
        )
    limits = drive.limits(j)
    if limits is None:
        raise CongraspError(f"The joint '{name}' has no limits.", "Give it a range.")
    lower, upper = limits
    axis, anchor = vector(tree.data.xaxis[j]), vector(tree.data.xanchor[j])
    return drive.joint(j, lower, upper, Joint(name, axis, anchor, 0.0, 0.0, 0.0, 0.0, 0.0))
