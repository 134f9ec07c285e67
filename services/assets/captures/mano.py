"""MANO's pose parameters as joints of fingers, in the wrist frame of the `human` hand.

MANO's wrist frame has the fingers towards -x, the back of the hand +y and the thumb's side +z. Without the user's MANO
file the bones are those of the `human` hand; the thumb, whose rest directions differ, is then off by some degrees.
"""

import dataclasses
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.mano import MANO_FINGERS, TIP_VERTICES, ManoModel
from congrasp.services.assets.captures.fit import joint_positions
from congrasp.services.assets.captures.sequence import FINGERS
from congrasp.services.assets.objects.mesh_files import load_geometry

TO_HUMAN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Vectors of MANO's wrist frame in that of the human hand."""
MEAN_WRIST = np.array([0.0957, 0.0064, 0.0062])
"""(3,) wrist joint of the mean shape, to which MANO's translation is added, m."""
_ORDER = [MANO_FINGERS.index(finger) for finger in FINGERS]


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """A subject's hand at rest, in MANO's frame."""

    wrist: np.ndarray
    """(3,) m."""
    fingers: np.ndarray
    """(5, 4, 3) joints and tip of each of `MANO_FINGERS`."""

    def joints(self, rotations: np.ndarray) -> np.ndarray:
        """Joints and tips (T, 5, 4, 3) of `FINGERS` in the human hand's wrist frame.

        Args:
          rotations: (T, 15, 3, 3) rotation of each joint relative to its parent, in MANO's order.
        """
        local = rotations.reshape(-1, 5, 3, 3, 3)
        bones = np.diff(self.fingers, axis=1)
        placed = [np.broadcast_to(self.fingers[:, 0] - self.wrist, (len(local), 5, 3))]
        turn = np.broadcast_to(np.eye(3), (*local.shape[:2], 3, 3))
        for k in range(3):
            turn = turn @ local[:, :, k]
            placed.append(placed[-1] + np.einsum("tfij,fj->tfi", turn, bones[:, k]))
        return np.stack(placed, 2)[:, _ORDER] @ TO_HUMAN.T


def skeleton(
    model: ManoModel | None, betas: np.ndarray | None = None, template: pathlib.Path | None = None
) -> Skeleton:
    """Returns a subject's skeleton.

    Args:
      model: the user's MANO file; None uses the human hand's bones at MANO's mean wrist.
      betas: shape parameters.
      template: a subject's mesh at rest, instead of betas.
    """
    if model is None:
        order = [FINGERS.index(finger) for finger in MANO_FINGERS]
        rest = joint_positions(np.zeros(len(HUMAN.joints)))[order] @ TO_HUMAN
        return Skeleton(MEAN_WRIST, rest + MEAN_WRIST)
    joints, tips = model.skeleton(betas)
    if template is not None:
        vertices = read_vertices(template)
        joints, tips = model.regressor @ vertices, vertices[[TIP_VERTICES[finger] for finger in MANO_FINGERS]]
    fingers = np.concatenate([joints[1:].reshape(5, 3, 3), tips[:, None]], 1)
    return Skeleton(joints[0], fingers)


def read_vertices(path: pathlib.Path) -> np.ndarray:
    """Reads the vertices (n, 3) of a mesh or a point cloud, in the file's order.

    Raises:
      CongraspError: it cannot be read, or holds several.
    """
    found = load_geometry(path, "Download the file again.", maintain_order=True)
    if not hasattr(found, "vertices"):
        raise CongraspError(f"{path} does not hold a single mesh or point cloud.", "Download the file again.")
    return np.asarray(found.vertices, float)


def axis_angles(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, n, 3, 3) of axis-angle vectors (T, 3 n)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(len(vectors), -1, 3, 3)


def wrist_rotation(matrices: np.ndarray) -> np.ndarray:
    """Orientations (T, 3, 3) of the human hand's wrist frame, from MANO's root rotations (T, 3, 3)."""
    return matrices @ TO_HUMAN.T
