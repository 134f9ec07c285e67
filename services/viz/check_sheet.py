"""Contact sheet of a hand's self-check: its grips, and below them its joints."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Hand
from congrasp.services.record.palette import WAYPOINT
from congrasp.services.viz.hand_sheets import joints_sheet
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import object_shape, posed_hand, upright
from congrasp.services.viz.sheets import contact_sheet, stacked

if TYPE_CHECKING:
    from congrasp.services.assets.hands.grips import Grip

_SIZE = (296, 296)
_VIEWS = {"": np.array([0.75, 0.65, 0.35]), ", other side": np.array([0.75, -0.65, 0.35])}


def check_sheet(hand: Hand, grips: "Sequence[Grip]") -> np.ndarray:
    """The grips of a hand from two sides, with the links in contact in colour, above its joints (`joints_sheet`)."""
    images, labels = [], []
    for grip in grips:
        shapes = _grip(hand, grip)
        # A lost object may be far away, so that the camera then fits the hand alone.
        near = len(shapes) if grip.held else -1
        for side, view in _VIEWS.items():
            images.append(render_fitted(shapes[:near], view, _SIZE, shapes[near:]))
            labels.append(f"{grip.obj.name} {'held' if grip.held else 'lost'}{side}")
    title = f"{hand.name}: self-check, links in contact in violet"
    return stacked([contact_sheet(images, labels, columns=len(images), title=title), joints_sheet(hand)])


def _grip(hand: Hand, grip: "Grip") -> list[Shape]:
    """The hand upright, followed by the object."""
    turn = upright(hand)
    placed = turn * Rotation.from_quat(grip.object_quaternion, scalar_first=True)
    mesh = grip.obj.visual_vertices, grip.obj.visual_faces
    obj = object_shape(mesh, turn.apply(grip.object_position), placed.as_quat(scalar_first=True))
    return [posed_hand(hand, grip.q, np.zeros(3), turn, WAYPOINT, grip.touching), obj]
