"""A picture of a constraint set: headings, affordance, trajectories and reference poses on the table."""

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.task.sampling.headings import INWARD
from congrasp.common.wire.codec import Message
from congrasp.services.record.palette import AVOID, GRASPABLE, HEADING, OBJECT, WAYPOINT
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import arrow, beads, fit, posed_hand, shape_points, table_shape
from congrasp.services.viz.sheets import contact_sheet

_ARROWS, _PATHS = 14, 4
_ARROW_LENGTH, _GAP = 0.07, 0.002  # m
_VIEW = (0.8, 0.6, 0.45)
_SIZE = (460, 360)


def constraint_sheet(constraints: Message, rest: int = 0, seed: int = 0) -> np.ndarray:
    """Six pictures of the object in one of its resting poses, with some of its constraints drawn by the seed.

    Approach arrows end before the surface, two centimetres short of the heading positions;
    the graspable region is green, and the avoid region red.

    Returns:
      (H, W, 3) uint8.
    """
    arrays, meta = constraints.arrays, constraints.meta
    rng = np.random.default_rng(seed)
    place = arrays["rest"][rest]
    turn = Rotation.from_quat(place[3:], scalar_first=True)
    hand = get_hand(meta.get("hand_reference", meta["hand"]))

    def some(which: np.ndarray, count: int) -> np.ndarray:
        """At most `count` of those that are true, drawn."""
        found = np.flatnonzero(which)
        return rng.permutation(found)[:count]

    def headings(v: int) -> list[Shape]:
        """Arrows of a region's headings."""
        shapes = []
        for h in some(arrays["heading/allowed"][v, rest], _ARROWS):
            direction = turn.apply(arrays["heading/direction"][v, h])
            tip = turn.apply(arrays["heading/position"][v, h]) + place[:3] - (INWARD + _GAP) * direction
            shapes += arrow(tip - _ARROW_LENGTH * direction, tip, 0.0016, HEADING)
        return shapes

    def paths(v: int, chosen: np.ndarray) -> list[Shape]:
        """Strings of a region's trajectories."""
        return [beads(turn.apply(arrays["trajectory/position"][v, m]) + place[:3], 0.003, WAYPOINT) for m in chosen]

    def grasp(v: int, chosen: np.ndarray) -> list[Shape]:
        """Hands of a region's reference poses."""
        shapes: list[Shape] = []
        for m in chosen:
            wrist = turn * Rotation.from_quat(arrays["pose/quaternion"][v, m], scalar_first=True)
            position = turn.apply(arrays["pose/position"][v, m]) + place[:3]
            shapes.append(posed_hand(hand, arrays["pose/q"][v, m], position, wrist))
        return shapes

    avoid = arrays["surface/avoid"]
    body = Shape(
        "mesh",
        (0, 0),
        OBJECT,
        np.asarray(place[:3], float),
        np.asarray(place[3:], float),
        vertices=arrays["visual/vertices"],
        faces=arrays["visual/faces"],
        paint_points=arrays["surface/points"],
        paint_colours=np.where(avoid[:, None], AVOID, GRASPABLE),
    )
    clear = arrays["pose/allowed"][:, rest]
    whole, region = some(clear[0], _PATHS), some(clear[1], _PATHS)
    panels = {
        f"headings, {int(arrays['heading/allowed'][0, rest].sum())} allowed": headings(0),
        f"headings on the graspable region, {int(arrays['heading/allowed'][1, rest].sum())} allowed": headings(1),
        f"wrist trajectories, {int(clear[0].sum())} allowed": paths(0, whole),
        "reference pose and its trajectory": grasp(0, whole[:1]) + paths(0, whole[:1]),
        "another reference pose": grasp(0, whole[1:2]),
        "reference pose on the graspable region and its trajectory": grasp(1, region[:1]) + paths(1, region[:1]),
    }
    images = []
    for shapes in panels.values():
        extent = np.concatenate([shape_points(shape) for shape in [*shapes, body]])
        camera = fit(extent, np.array(_VIEW), _SIZE[0] / _SIZE[1])
        images.append(render_scene([*shapes, body, table_shape(place[:3])], camera, _SIZE))
    title = f"{meta['object']}, {meta['hand']} hand, resting pose {rest + 1} of {len(arrays['rest'])}"
    return contact_sheet(images, list(panels), columns=3, title=f"{title}; avoid region in dark red")
