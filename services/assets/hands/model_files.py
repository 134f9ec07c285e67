"""A hand from a URDF or MJCF file: its content is used, and missing values are proposed.

MuJoCo reads the file in a confined process (`reading`, `compile`). Links of the hand: `links`, with
their capsules and joints `proposed_links`. Motors, couplings and tendons: `actuators`. Open and
closed poses, from kinematics: `poses`.
"""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import hand_faults, hand_from_text, hand_text
from congrasp.common.hands.meshes import MAX_DISTANCE_M, Meshes, load_meshes, save_meshes
from congrasp.common.hands.motors import fitting_scale
from congrasp.common.hands.spec import Hand, Link, wrist_gains
from congrasp.services.assets.hands.actuators import Drive
from congrasp.services.assets.hands.compile import robot_spec
from congrasp.services.assets.hands.fingers import finger_ends
from congrasp.services.assets.hands.link_geometry import link_mesh, placed, solids_of
from congrasp.services.assets.hands.links import Tree, hand_tree, identifier
from congrasp.services.assets.hands.poses import opening, propose_poses, thumb_of
from congrasp.services.assets.hands.proposed_links import proposed_links
from congrasp.services.assets.hands.reading import confined, listed
from congrasp.services.assets.hands.slides import slides_of, with_hinges
from congrasp.services.assets.hands.units import MAX_LINK, check_size, check_units
from congrasp.services.assets.hands.urdf_inertias import LEAST_MASS

_MIN_RANGE = np.deg2rad(10)
"""Range of the hand's widest joint, rad; grasping is impossible below it."""
_MIN_OPENING = 0.03
"""Opening below which a hand is doubtful, m."""
_HAND = "hand.json"


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
    """Proposes a hand in the confined process: writes its meshes, and returns the rest."""
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
      CongraspError: the file cannot be read, is not a hand of hinges and slides with at least two
        fingers, or has sizes, ranges or masses of another unit.
    """
    notes: list[str] = []
    spec, model = robot_spec(path, notes)
    tree = hand_tree(model, choices.palm, notes)
    if slides_of(tree):
        model = with_hinges(path, spec, tree, notes)
        tree = hand_tree(model, choices.palm, notes)
    palm = model.body(tree.palm).name
    ends = finger_ends(tree, notes)
    _check_fingers(path, tree, ends)
    _note_large_inertias(tree, notes)
    links, drive = proposed_links(tree, ends, _points(path, tree), notes)
    check_units(path, links)
    if choices.own_collision:
        links = _with_file_collision(links, tree, notes)
    hand = _hand(_name(choices.name or path.stem), links, drive)
    notes += drive.remarks()
    _check_ranges(path, hand)
    _check(path, hand, ignored="pose")
    hand = dataclasses.replace(hand, thumb=thumb_of(hand, choices.thumb, notes))
    hand = propose_poses(hand, notes)
    width = opening(hand)
    if width < _MIN_OPENING:
        notes.append(
            f"thumb and fingers are only {100 * width:.1f} cm apart ('open_pose' in the hand file, "
            f"or --thumb)"
        )
    scale = choices.object_scale or fitting_scale(width)
    hand = dataclasses.replace(hand, object_scale=scale)
    _check(path, hand)
    hand = hand_from_text(hand_text(hand), str(path))
    meshes = _meshes(tree, notes)
    return Proposal(hand, palm, tuple(dict.fromkeys(notes)), meshes)


def _check_fingers(path: pathlib.Path, tree: Tree, ends: tuple[int, ...]) -> None:
    """Raises a CongraspError for a palm with fewer than two fingers, of these last links."""
    if len(ends) >= 2:
        return
    if not tree.model.njnt:
        raise CongraspError(
            f"{path} has no joints.",
            "If it is a part of a description, import the file that includes it.",
        )
    count = "one finger" if ends else "no finger"
    palm = tree.model.body(tree.palm).name
    raise CongraspError(
        f"{path} has {count} on its palm '{identifier(palm, f'body_{tree.palm}')}'.",
        "A hand has at least two fingers: import a file with all of them, or pass another --palm.",
    )


def _note_large_inertias(tree: Tree, notes: list[str]) -> None:
    """Appends a note on bodies whose inertia is that of a body larger than a link."""
    model = tree.model
    masses = np.maximum(model.body_mass, LEAST_MASS)
    widths = np.sqrt(model.body_inertia.max(1) / masses)
    suspicious = [model.body(body).name for body in tree.owner if widths[body] > MAX_LINK]
    notes += listed(
        f"inertias of bodies more than {MAX_LINK:g} m wide (in kg.mm²?), from which kv follows",
        suspicious,
    )


def _with_file_collision(links: list[Link], tree: Tree, notes: list[str]) -> list[Link]:
    """The links with the file's collision geometry; capsules of links with meshes stay."""
    with_solids = []
    for link, group in zip(links, tree.groups, strict=True):
        with_solids.append(dataclasses.replace(link, solids=solids_of(tree, group)))
    with_capsules = [link.name for link in with_solids if not link.solids]
    notes += listed("only meshes as collision geometry, capsules are used", with_capsules)
    return with_solids


def _name(text: str) -> str:
    """Name of a hand, which does not begin with a digit."""
    name = identifier(text, "hand").lower()
    return f"hand_{name}" if name[0].isdigit() else name


def _hand(name: str, links: list[Link], drive: Drive) -> Hand:
    """The hand of these links, without poses; its first finger counts as the thumb."""
    tips = [link.name for link in links if link.tip is not None]
    return Hand(
        name=name,
        links=tuple(links),
        thumb=tips[0],
        open_pose={},
        closed_pose={},
        wrist=wrist_gains(sum(link.mass for link in links)),
        couplings=drive.couplings(),
        tendons=drive.tendons(),
    )


def _check_ranges(path: pathlib.Path, hand: Hand) -> None:
    """Raises a CongraspError if no joint turns far enough to grasp."""
    if max(joint.upper - joint.lower for joint in hand.joints) < _MIN_RANGE:
        raise CongraspError(
            f"No joint of the hand in {path} has a range of 10 degrees.",
            'Check that its angles are in radians, or add <compiler angle="radian"/>.',
        )


def _check(path: pathlib.Path, hand: Hand, ignored: str = "") -> None:
    """Raises a CongraspError for an invalid hand; faults with the word `ignored` do not count."""
    for fault in hand_faults(hand):
        if ignored and ignored in fault:
            continue
        raise CongraspError(
            f"{path}: {fault}.",
            "Correct the file, or write the hand's JSON file yourself (docs/add-a-hand.md).",
        )


def _points(path: pathlib.Path, tree: Tree) -> dict[int, list[np.ndarray]]:
    """Points (3,) of each link's geometry, m.

    Raises:
      CongraspError: a link has a size that no hand has.
    """
    points: dict[int, list[np.ndarray]] = {}
    for link in tree.groups:
        points[link] = []
        for mesh in placed(tree, link, colliding=True):
            points[link] += list(mesh.vertices)
    for link, link_points in points.items():
        check_size(path, tree.names[link], link_points)
    return points


def _meshes(tree: Tree, notes: list[str]) -> Meshes:
    """Visual meshes of each link, unless larger than a hand."""
    meshes = {}
    too_far = []
    for link in tree.groups:
        mesh = link_mesh(tree, link)
        if mesh is None:
            continue
        vertices, _ = mesh
        if np.abs(vertices).max() > MAX_DISTANCE_M:
            too_far.append(tree.names[link])
        else:
            meshes[tree.names[link]] = mesh
    notes += listed(
        f"drawn more than {MAX_DISTANCE_M:g} m from the palm (in mm?), and dropped", too_far
    )
    return meshes
