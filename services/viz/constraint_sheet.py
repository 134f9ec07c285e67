"""Pictures of a constraint set: headings, trajectories and reference poses around the object."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.task.sampling.headings import INWARD
from congrasp.common.wire.codec import Message
from congrasp.services.appearance.palette import HEADING, WAYPOINT
from congrasp.services.appearance.surface_colours import region_colours
from congrasp.services.viz.hand_shapes import posed_hand
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.shapes import Shape, arrow, beads, object_shape, table_shape
from congrasp.services.viz.sheets import contact_sheet

_MOST_HEADINGS = 14
_MOST_PATHS = 4
_ARROW_LENGTH_M = 0.07
_ARROW_RADIUS_M = 0.0016
_ARROW_GAP_M = 0.002
_BEAD_RADIUS_M = 0.003
_VIEW = (0.8, 0.6, 0.45)
"""Direction from the object to the camera."""
SIZE = (460, 360)
"""Width and height of a picture, pixels."""


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
        directions = self.rotation.apply(self.arrays["heading/direction"][region, chosen])
        positions = self.rotation.apply(self.arrays["heading/position"][region, chosen])
        shapes = []
        for direction, position in zip(directions, positions + self.position, strict=True):
            tip = position - (INWARD + _ARROW_GAP_M) * direction
            start = tip - _ARROW_LENGTH_M * direction
            shapes += arrow(start, tip, _ARROW_RADIUS_M, HEADING)
        return shapes

    def paths(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Strings of beads along trajectories."""
        strings = []
        for path in self.arrays["trajectory/position"][region][chosen]:
            points = self.rotation.apply(path) + self.position
            strings.append(beads(points, _BEAD_RADIUS_M, WAYPOINT))
        return strings

    def grasps(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Hands in reference poses."""
        shapes = []
        for index in chosen:
            q = self.arrays["pose/q"][region][index]
            quaternion = self.arrays["pose/quaternion"][region][index]
            wrist = self.rotation * Rotation.from_quat(quaternion, scalar_first=True)
            position = self.rotation.apply(self.arrays["pose/position"][region][index])
            shapes.append(posed_hand(self.hand, q, position + self.position, wrist))
        return shapes

    @property
    def body(self) -> Shape:
        """The object with its painted regions."""
        mesh = (self.arrays["visual/vertices"], self.arrays["visual/faces"])
        paint = region_colours(self.arrays["surface/points"], self.arrays["surface/avoid"])
        return object_shape(mesh, self.position, self.arrays["rest"][self.rest][3:], paint)


def constraint_sheet(constraints: Message, rest: int = 0, seed: int = 0) -> np.ndarray:
    """Six pictures of the object in one of its resting poses, with some of its constraints.

    Heading arrows end before the surface, two centimetres short of the heading positions. The
    graspable region is green, the avoid region red.

    Args:
      constraints: the constraint set.
      rest: index of the resting pose, from 0.
      seed: seed of the random sample of constraints.

    Returns:
      (H, W, 3) uint8.
    """
    arrays = constraints.arrays
    meta = constraints.meta
    rng = np.random.default_rng(seed)
    placed = _Placed(arrays, rest, get_hand(meta.get("hand_reference", meta["hand"])))

    def some(which: np.ndarray, count: int) -> np.ndarray:
        """Draws at most `count` indices of true entries."""
        return rng.permutation(np.flatnonzero(which))[:count]

    is_heading = arrays["heading/allowed"][:, rest]
    is_pose = arrays["pose/allowed"][:, rest]
    poses = some(is_pose[0], _MOST_PATHS)
    region_poses = some(is_pose[1], _MOST_PATHS)
    headings = some(is_heading[0], _MOST_HEADINGS)
    region_headings = some(is_heading[1], _MOST_HEADINGS)
    panels = {
        f"headings, {int(is_heading[0].sum())} allowed": placed.headings(0, headings),
        f"headings on the graspable region, {int(is_heading[1].sum())} allowed": placed.headings(
            1, region_headings
        ),
        f"wrist trajectories, {int(is_pose[0].sum())} allowed": placed.paths(0, poses),
        "reference pose and its trajectory": placed.grasps(0, poses[:1])
        + placed.paths(0, poses[:1]),
        "another reference pose": placed.grasps(0, poses[1:2]),
        "reference pose on the graspable region and its trajectory": placed.grasps(
            1, region_poses[:1]
        )
        + placed.paths(1, region_poses[:1]),
    }
    table = table_shape(placed.position)
    images = [
        render_fitted([*shapes, placed.body], _VIEW, SIZE, [table]) for shapes in panels.values()
    ]
    what = (
        f"{meta['object']}, {meta['hand']} hand, resting pose {rest + 1} of {len(arrays['rest'])}"
    )
    return contact_sheet(images, list(panels), columns=3, title=f"{what}; avoid region in dark red")
