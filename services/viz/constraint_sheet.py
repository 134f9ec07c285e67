"""A picture of a constraint set: headings, affordance, trajectories and reference poses on the table."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.task.sampling.headings import INWARD
from congrasp.common.wire.codec import Message
from congrasp.services.record.palette import AVOID, GRASPABLE, HEADING, WAYPOINT
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import arrow, beads, object_shape, posed_hand, table_shape
from congrasp.services.viz.sheets import contact_sheet

_ARROWS, _PATHS = 14, 4
_ARROW_LENGTH, _GAP = 0.07, 0.002  # m
_VIEW = (0.8, 0.6, 0.45)
_SIZE = (460, 360)


@dataclasses.dataclass(frozen=True)
class _Placed:
    """Constraints of an object in one of its resting poses, as shapes in the world frame."""

    arrays: Mapping[str, np.ndarray]
    """Arrays of the constraint set."""
    rest: int
    """Index of the resting pose."""
    hand: Hand

    @property
    def position(self) -> np.ndarray:
        """Position (3,) of the object, m."""
        return np.asarray(self.arrays["rest"][self.rest][:3], float)

    @property
    def rotation(self) -> Rotation:
        """Rotation of the object."""
        return Rotation.from_quat(self.arrays["rest"][self.rest][3:], scalar_first=True)

    def headings(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Arrows of headings, which end two centimetres before the heading positions."""
        shapes = []
        for h in chosen:
            direction = self.rotation.apply(self.arrays["heading/direction"][region, h])
            target = self.rotation.apply(self.arrays["heading/position"][region, h]) + self.position
            tip = target - (INWARD + _GAP) * direction
            shapes += arrow(tip - _ARROW_LENGTH * direction, tip, 0.0016, HEADING)
        return shapes

    def paths(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Strings of beads along trajectories."""
        points = self.arrays["trajectory/position"][region]
        return [beads(self.rotation.apply(points[m]) + self.position, 0.003, WAYPOINT) for m in chosen]

    def grasps(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Hands in reference poses."""
        q, position, quaternion = (self.arrays[f"pose/{name}"][region] for name in ("q", "position", "quaternion"))
        shapes: list[Shape] = []
        for m in chosen:
            wrist = self.rotation * Rotation.from_quat(quaternion[m], scalar_first=True)
            shapes.append(posed_hand(self.hand, q[m], self.rotation.apply(position[m]) + self.position, wrist))
        return shapes

    @property
    def body(self) -> Shape:
        """The object with its painted regions."""
        mesh = self.arrays["visual/vertices"], self.arrays["visual/faces"]
        paint = self.arrays["surface/points"], np.where(self.arrays["surface/avoid"][:, None], AVOID, GRASPABLE)
        return object_shape(mesh, self.position, self.arrays["rest"][self.rest][3:], paint)


def constraint_sheet(constraints: Message, rest: int = 0, seed: int = 0) -> np.ndarray:
    """Six pictures of the object in one of its resting poses, with some of its constraints drawn by the seed.

    Approach arrows end before the surface, two centimetres short of the heading positions;
    the graspable region is green, and the avoid region red.

    Returns:
      (H, W, 3) uint8.
    """
    arrays, meta = constraints.arrays, constraints.meta
    rng = np.random.default_rng(seed)
    placed = _Placed(arrays, rest, get_hand(meta.get("hand_reference", meta["hand"])))

    def some(which: np.ndarray, count: int) -> np.ndarray:
        """Draws at most `count` indices of true entries."""
        return rng.permutation(np.flatnonzero(which))[:count]

    allowed, clear = arrays["heading/allowed"][:, rest], arrays["pose/allowed"][:, rest]
    whole, region = some(clear[0], _PATHS), some(clear[1], _PATHS)
    reference = placed.grasps(1, region[:1]) + placed.paths(1, region[:1])
    panels = {
        f"headings, {int(allowed[0].sum())} allowed": placed.headings(0, some(allowed[0], _ARROWS)),
        f"headings on the graspable region, {int(allowed[1].sum())} allowed": placed.headings(
            1, some(allowed[1], _ARROWS)
        ),
        f"wrist trajectories, {int(clear[0].sum())} allowed": placed.paths(0, whole),
        "reference pose and its trajectory": placed.grasps(0, whole[:1]) + placed.paths(0, whole[:1]),
        "another reference pose": placed.grasps(0, whole[1:2]),
        "reference pose on the graspable region and its trajectory": reference,
    }
    body, images = placed.body, []
    for shapes in panels.values():
        images.append(render_fitted([*shapes, body], _VIEW, _SIZE, [table_shape(placed.position)]))
    title = f"{meta['object']}, {meta['hand']} hand, resting pose {rest + 1} of {len(arrays['rest'])}"
    return contact_sheet(images, list(panels), columns=3, title=f"{title}; avoid region in dark red")
