"""Contact sheets of hands: poses with the grasp frame, the motion of every joint, and the grips of
a self-check.
"""

import itertools
from collections.abc import Sequence
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
from congrasp.services.record.palette import HEADING, OBJECT, WAYPOINT
from congrasp.services.viz.camera import fit
from congrasp.services.viz.hand_shapes import Look, posed_hand, upright
from congrasp.services.viz.raster import render_fitted, render_scene
from congrasp.services.viz.shapes import (
    Shape,
    arrow,
    beads,
    object_shape,
    shape_points,
)
from congrasp.services.viz.sheets import contact_sheet, stacked

if TYPE_CHECKING:
    from congrasp.services.assets.hands.trials import Grip

_VIEW = np.array([0.75, 0.65, 0.35])


def _placed(
    hand: Hand, q: np.ndarray, moved: Sequence[int] = (), skin: Skin | None = None
) -> list[Shape]:
    """The hand upright with finger angles (F,), some of its links in another colour."""
    shares = np.isin(np.arange(len(hand.links)), moved)
    look = Look(OBJECT, shares)
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
    """The open hand's grasp frame: the heading axis up to the hand centre, and w from the thumb to
    the others.
    """
    frame, turn = grasp_frame(hand), upright(hand)
    reach = 0.7 * frame.opening
    ends = frame.center + np.outer([-0.5, 0.5], frame.opening * frame.cross)
    forward = turn.apply(np.array([frame.center - reach * frame.heading, frame.center]))
    return [
        *arrow(forward[0], forward[1], 0.0028, HEADING),
        beads(turn.apply(ends), 0.005, WAYPOINT),
    ]


def _side(hand: Hand) -> np.ndarray:
    """(3,) view direction of a sheet: towards the palm, from the thumb's side."""
    thumb = np.sign(upright(hand).apply(hand.keypoints[len(hand.links)])[1]) or 1.0
    return _VIEW * [1.0, thumb, 1.0]


def _points(shapes: Sequence[Shape]) -> np.ndarray:
    """(n, 3) points that a picture of the shapes must contain."""
    return np.concatenate([shape_points(shape) for shape in shapes])


def hand_sheet(hand: Hand, *, size: tuple[int, int] = (400, 400)) -> np.ndarray:
    """The hand open, half closed and closed (columns), from the palm, the thumb's side and in
    between (rows).
    """
    placed = _poses(hand)
    points = np.concatenate([_points(shapes) for shapes in placed.values()])
    thumb = np.sign(_side(hand)[1])
    images, labels = [], []
    for view, azimuth in {"palm": 0.0, "between": 50.0, "thumb's side": 95.0}.items():
        angle = thumb * np.radians(azimuth)
        camera = fit(points, np.array([np.cos(angle), np.sin(angle), 0.25]), size[0] / size[1])
        images += [render_scene(shapes, camera, size) for shapes in placed.values()]
        labels += [f"{name}, {view}" for name in placed]
    title = f"{hand.name} hand: {len(hand.joints)} finger joints, {len(hand.links)} links"
    return contact_sheet(images, labels, columns=len(placed), title=title)


def hands_sheet(
    hands: Sequence[Hand], skins: Sequence[Skin | None] = (), *, size: tuple[int, int] = (300, 300)
) -> np.ndarray:
    """A row for each hand: open with its grasp frame, half closed, closed; each row on one scale.

    `skins` replace the default surfaces of the hands (`common.hands.skin.skin_of`); None keeps the
    default.
    """
    images, labels = [], []
    for hand, skin in itertools.zip_longest(hands, skins):
        rows = _poses(hand, skin)
        rows["open"] += _frame(hand)
        camera = fit(
            np.concatenate([_points(shapes) for shapes in rows.values()]),
            _side(hand),
            size[0] / size[1],
        )
        images += [render_scene(shapes, camera, size) for shapes in rows.values()]
        labels += [f"{hand.name}, {name}" for name in rows]
    title = (
        "heading axis v (blue) into the hand centre, cross-finger axis w (violet) from the thumb "
        "to the fingers"
    )
    return contact_sheet(images, labels, columns=3, title=title)


def joints_sheet(hand: Hand, *, size: tuple[int, int] = (220, 220)) -> np.ndarray:
    """The hand's three poses, its zero position, and every motor at both limits with the links that
    it moves tinted.
    """
    rows = {**_poses(hand), "all at zero": _placed(hand, np.clip(0.0, hand.lower, hand.upper))}
    rows["open"] += _frame(hand)
    names = [link.name for link in hand.links]
    parents = [names.index(link.parent) if link.parent else -1 for link in hand.links]
    for m, motor in enumerate(hand.motors):
        moved = {int(i) for i in hand.joint_links[transmission(hand).motor == m]}
        for i, parent in enumerate(parents):
            if parent in moved:
                moved.add(i)
        for position in motor_limits(hand)[:, m]:
            motors = motor_positions(hand, hand.q_open).copy()
            motors[m] = position
            rows[f"{motor.name} {position:.2f}"] = _placed(
                hand, joint_positions(hand, motors), sorted(moved)
            )
    points = np.concatenate([_points(shapes) for shapes in rows.values()])
    camera = fit(points, _side(hand), size[0] / size[1])
    images = [render_scene(shapes, camera, size) for shapes in rows.values()]
    reach = max(float(np.linalg.norm(link_origin(link))) for link in hand.links)
    parts = f"{len(hand.joints)} joints, {len(hand.motors)} motors, {len(hand.links)} links"
    title = f"{hand.name}: {parts}, {100 * reach:.0f} cm to the last joint"
    return contact_sheet(images, list(rows), columns=8, title=title)


_SIZE = (296, 296)
_VIEWS = {"": np.array([0.75, 0.65, 0.35]), ", other side": np.array([0.75, -0.65, 0.35])}


def check_sheet(hand: Hand, grips: "Sequence[Grip]") -> np.ndarray:
    """The grips of a hand from two sides, with the links in contact in colour, above its joints
    (`joints_sheet`).
    """
    images, labels = [], []
    for grip in grips:
        shapes = _grip(hand, grip)
        # A lost object may be far away, so that the camera then fits the hand alone.
        near = len(shapes) if grip.held else -1
        for side, view in _VIEWS.items():
            images.append(render_fitted(shapes[:near], view, _SIZE, shapes[near:]))
            labels.append(f"{grip.obj.name} {'held' if grip.held else 'lost'}{side}")
    title = f"{hand.name}: self-check, links in contact in violet"
    return stacked(
        [contact_sheet(images, labels, columns=len(images), title=title), joints_sheet(hand)]
    )


def _grip(hand: Hand, grip: "Grip") -> list[Shape]:
    """The hand upright, followed by the object."""
    turn = upright(hand)
    placed = turn * Rotation.from_quat(grip.object_quaternion, scalar_first=True)
    mesh = grip.obj.visual_vertices, grip.obj.visual_faces
    obj = object_shape(mesh, turn.apply(grip.object_position), placed.as_quat(scalar_first=True))
    look = Look(WAYPOINT, grip.touching)
    return [posed_hand(hand, grip.q, np.zeros(3), turn, look), obj]
