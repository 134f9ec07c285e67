"""Contact sheets of hands: poses with the grasp frame, the motion of every joint, and the grips of
a self-check.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import (
    joint_positions,
    motor_limits,
    motor_positions,
    transmission,
)
from congrasp.common.hands.skin import Skin
from congrasp.common.hands.spec import Hand, link_origin
from congrasp.services.appearance.palette import HEADING, OBJECT, WAYPOINT
from congrasp.services.viz.camera import fit
from congrasp.services.viz.hand_shapes import Look, posed_hand, upright
from congrasp.services.viz.raster import render_fitted, render_scene
from congrasp.services.viz.shapes import (
    Shape,
    arrow,
    beads,
    object_shape,
    points_of,
)
from congrasp.services.viz.sheets import contact_sheet, stacked

if TYPE_CHECKING:
    from congrasp.services.assets.hands.trials import Grip

_VIEW = np.array([0.75, 0.65, 0.35])
"""Direction from a hand to the camera: towards the palm, from the side of +y."""
_OTHER_SIDE = np.array([1.0, -1.0, 1.0])
"""Factors that mirror a direction."""
_ARROW_RADIUS_M = 0.0028
_BEAD_RADIUS_M = 0.005
_ARROW_LENGTH = 0.7
"""Length of the heading's arrow, in openings of the hand."""
_AZIMUTHS_DEG = {"palm": 0.0, "between": 50.0, "thumb's side": 95.0}
"""Rows of the sheet of one hand."""
_ABOVE = 0.25
"""Height of their cameras, as a slope."""
_JOINT_COLUMNS = 8
_GRIP_SIZE = (296, 296)
"""Width and height of the picture of a grip, pixels."""
_GRIP_VIEWS = {"": _VIEW, ", other side": _VIEW * _OTHER_SIDE}


def _placed(
    hand: Hand, q: np.ndarray, moved: Sequence[int] = (), skin: Skin | None = None
) -> list[Shape]:
    """The hand upright with finger angles (F,), some of its links in another colour."""
    look = Look(OBJECT, np.isin(np.arange(len(hand.links)), moved))
    return [posed_hand(hand, q, np.zeros(3), upright(hand), look, skin)]


def _poses(hand: Hand, skin: Skin | None = None) -> dict[str, list[Shape]]:
    """The hand upright in three poses."""
    poses = {
        "open": hand.q_open,
        "half closed": (hand.q_open + hand.q_closed) / 2,
        "closed": hand.q_closed,
    }
    return {name: _placed(hand, q, skin=skin) for name, q in poses.items()}


def _frame(hand: Hand) -> list[Shape]:
    """The open hand's grasp frame: the heading's arrow, and w as a string of two beads.

    The arrow ends at the hand centre; w leads from the thumb to the other fingers.
    """
    frame = grasp_frame(hand)
    turn = upright(hand)
    start = frame.center - _ARROW_LENGTH * frame.opening * frame.heading
    across = frame.center + np.outer([-0.5, 0.5], frame.opening * frame.cross)
    shaft_and_tip = arrow(turn.apply(start), turn.apply(frame.center), _ARROW_RADIUS_M, HEADING)
    return [*shaft_and_tip, beads(turn.apply(across), _BEAD_RADIUS_M, WAYPOINT)]


def _side(hand: Hand) -> np.ndarray:
    """(3,) view direction of a sheet: towards the palm, from the thumb's side."""
    thumb = np.sign(upright(hand).apply(hand.keypoints[len(hand.links)])[1]) or 1.0
    return _VIEW * [1.0, thumb, 1.0]


def _points(rows: Iterable[Sequence[Shape]]) -> np.ndarray:
    """(n, 3) points that a picture of each row must contain."""
    return np.concatenate([points_of(shapes) for shapes in rows])


def hand_sheet(hand: Hand, *, size: tuple[int, int] = (400, 400)) -> np.ndarray:
    """The hand open, half closed and closed (columns), from the palm, the thumb's side and in
    between (rows).
    """
    poses = _poses(hand)
    points = _points(poses.values())
    thumb = np.sign(_side(hand)[1])
    images = []
    labels = []
    for view, azimuth in _AZIMUTHS_DEG.items():
        angle = thumb * np.radians(azimuth)
        direction = np.array([np.cos(angle), np.sin(angle), _ABOVE])
        camera = fit(points, direction, size[0] / size[1])
        images += [render_scene(shapes, camera, size) for shapes in poses.values()]
        labels += [f"{name}, {view}" for name in poses]
    title = f"{hand.name} hand: {len(hand.joints)} finger joints, {len(hand.links)} links"
    return contact_sheet(images, labels, columns=len(poses), title=title)


def hands_sheet(
    hands: Sequence[Hand], skins: Sequence[Skin | None] = (), *, size: tuple[int, int] = (300, 300)
) -> np.ndarray:
    """A row for each hand: open with its grasp frame, half closed, closed; each row on one scale.

    `skins` replace the default surfaces of the hands (`common.hands.skin.skin_of`); None keeps the
    default.
    """
    images = []
    labels = []
    for hand, skin in itertools.zip_longest(hands, skins):
        poses = _poses(hand, skin)
        poses["open"] += _frame(hand)
        camera = fit(_points(poses.values()), _side(hand), size[0] / size[1])
        images += [render_scene(shapes, camera, size) for shapes in poses.values()]
        labels += [f"{hand.name}, {name}" for name in poses]
    title = (
        "heading axis v (blue) into the hand centre, cross-finger axis w (violet) from the thumb "
        "to the fingers"
    )
    return contact_sheet(images, labels, columns=3, title=title)


def joints_sheet(hand: Hand, *, size: tuple[int, int] = (220, 220)) -> np.ndarray:
    """The hand's three poses, its zero position, and every motor at both limits.

    The links that a motor moves are tinted.
    """
    panels = _poses(hand)
    panels["open"] += _frame(hand)
    panels["all at zero"] = _placed(hand, np.clip(0.0, hand.lower, hand.upper))
    limits = motor_limits(hand)
    for number, motor in enumerate(hand.motors):
        moved = _moved_links(hand, number)
        for position in limits[:, number]:
            motors = motor_positions(hand, hand.q_open).copy()
            motors[number] = position
            label = f"{motor.name} {position:.2f}"
            panels[label] = _placed(hand, joint_positions(hand, motors), moved)
    camera = fit(_points(panels.values()), _side(hand), size[0] / size[1])
    images = [render_scene(shapes, camera, size) for shapes in panels.values()]
    reach = max(float(np.linalg.norm(link_origin(link))) for link in hand.links)
    parts = f"{len(hand.joints)} joints, {len(hand.motors)} motors, {len(hand.links)} links"
    title = f"{hand.name}: {parts}, {100 * reach:.0f} cm to the last joint"
    return contact_sheet(images, list(panels), columns=_JOINT_COLUMNS, title=title)


def _moved_links(hand: Hand, motor: int) -> list[int]:
    """Indices of the links that a motor moves, and of those that they carry."""
    names = [link.name for link in hand.links]
    moved = {int(i) for i in hand.joint_links[transmission(hand).motor == motor]}
    for i, link in enumerate(hand.links):
        if link.parent and names.index(link.parent) in moved:
            moved.add(i)
    return sorted(moved)


def check_sheet(hand: Hand, grips: "Sequence[Grip]") -> np.ndarray:
    """The grips of a hand from two sides, above its joints (`joints_sheet`).

    Links in contact are in colour.
    """
    images = []
    labels = []
    for grip in grips:
        placed_hand, placed_object = _grip(hand, grip)
        contained = [placed_hand]
        # A lost object may be far away, so that the camera then fits the hand alone.
        around = [placed_object]
        if grip.held:
            contained.append(placed_object)
            around = []
        outcome = "held" if grip.held else "lost"
        for side, view in _GRIP_VIEWS.items():
            images.append(render_fitted(contained, view, _GRIP_SIZE, around))
            labels.append(f"{grip.obj.name} {outcome}{side}")
    title = f"{hand.name}: self-check, links in contact in violet"
    sheet = contact_sheet(images, labels, columns=len(images), title=title)
    return stacked([sheet, joints_sheet(hand)])


def _grip(hand: Hand, grip: "Grip") -> tuple[Shape, Shape]:
    """The hand upright, and the object."""
    turn = upright(hand)
    placed = turn * Rotation.from_quat(grip.object_quaternion, scalar_first=True)
    mesh = (grip.obj.visual_vertices, grip.obj.visual_faces)
    position = turn.apply(grip.object_position)
    body = object_shape(mesh, position, placed.as_quat(scalar_first=True))
    look = Look(WAYPOINT, grip.touching)
    return posed_hand(hand, grip.q, np.zeros(3), turn, look), body
