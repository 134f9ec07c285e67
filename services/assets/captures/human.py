"""The joints of a captured human hand, by finger angles or by MANO's parameters; and finger angles
fitted to joints.

Joints are in the wrist frame of the `human` hand. MANO's wrist frame has the fingers towards -x,
the back of the hand +y and the thumb's side +z. Without the user's MANO file the bones are those of
the `human` hand; the thumb, whose rest directions differ, is then off by some degrees.
"""

import dataclasses
import functools
import pathlib
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.mano import MANO_FINGERS, TIP_VERTICES, ManoModel
from congrasp.common.hands.mjcf import posed
from congrasp.common.hands.spec import link_origin
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.captures.sequence import FINGERS
from congrasp.services.assets.objects.mesh_files import load_geometry

TO_HUMAN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Vectors of MANO's wrist frame in that of the human hand."""
MEAN_WRIST = np.array([0.0957, 0.0064, 0.0062])
"""(3,) wrist joint of the mean shape, to which MANO's translation is added, m."""
_ORDER = [MANO_FINGERS.index(finger) for finger in FINGERS]


class Fit(NamedTuple):
    """Finger angles and residuals."""

    q: np.ndarray
    """(20,) rad; may lie outside the hand's limits."""
    angle: float
    """Root mean square angle between the fifteen bones and those of the capture, rad."""
    tip: float
    """Mean distance of the fingertips from those of the capture, m; mostly the hands' different
    sizes.
    """


def joint_positions(q: np.ndarray) -> np.ndarray:
    """Joints and tips (..., 5, 4, 3) of `FINGERS` of the `human` hand at angles q (..., 20), in its
    wrist frame, m.
    """
    data = posed(HUMAN, HUMAN.q_open)
    rows = q.reshape(-1, q.shape[-1])
    joints = [_joints(data, row) for row in rows]
    return np.reshape(joints, (*q.shape[:-1], 5, 4, 3))


def fit(joints: np.ndarray) -> Fit:
    """Fits the `human` hand's finger angles to the directions of a capture's bones.

    The two hands have bones of different lengths. Four joints of a finger cannot follow three bones
    exactly.

    Args:
      joints: (5, 4, 3) joints and tips of the captured hand, in the wrist frame, m.
    """
    data = posed(HUMAN, HUMAN.q_open)
    bones = _directions(joints)

    def residuals(q: np.ndarray) -> np.ndarray:
        """Differences (45,) of the bones' directions from those of the capture at angles (20,)."""
        return (_directions(_joints(data, q)) - bones).ravel()

    solution = least_squares(residuals, np.zeros(len(HUMAN.joints)), method="lm")
    q = (solution.x + np.pi) % (2 * np.pi) - np.pi
    reached = _joints(data, q)
    cosines = (_directions(reached) * bones).sum(-1).clip(-1, 1)
    angles = np.arccos(cosines)
    tip_distances = np.linalg.norm(reached[:, 3] - joints[:, 3], axis=-1)
    return Fit(q, float(np.sqrt((angles**2).mean())), float(tip_distances.mean()))


def _joints(data: mujoco.MjData, q: np.ndarray) -> np.ndarray:
    """Joints and tips (5, 4, 3) of a model of the `human` hand that is moved to angles (20,)."""
    data.qpos[-len(q) :] = q  # after the wrist's six
    mujoco.mj_kinematics(data.model, data)
    bodies, tips = _fingers()
    last = bodies[:, -1]
    ends = data.xpos[last] + (data.xmat[last].reshape(-1, 3, 3) @ tips[..., None])[..., 0]
    return np.concatenate([data.xpos[bodies], ends[:, None]], 1)


@functools.cache
def _fingers() -> tuple[np.ndarray, np.ndarray]:
    """Bodies (5, 3) of `FINGERS`, from the palm outwards, and the tip (5, 3) of each in its last
    body's frame, m.
    """
    model = posed(HUMAN, HUMAN.q_open).model
    bodies = []
    tips = []
    for finger in FINGERS:
        chain = [link for link in HUMAN.links if link.name.startswith(finger)]
        last = chain[-1]
        assert last.tip is not None
        bodies.append([model.body(link.name).id for link in chain])
        tips.append(np.subtract(last.tip, link_origin(last)))
    return np.array(bodies), np.array(tips)


def _directions(points: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3, 3) along the bones between points (..., 4, 3)."""
    bones = np.diff(points, axis=-2)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True).clip(1e-9)


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """A subject's hand at rest, in MANO's frame."""

    wrist: np.ndarray
    """(3,) m."""
    fingers: np.ndarray
    """(5, 4, 3) joints and tip of each of `MANO_FINGERS`."""

    def posed(self, root: Rotation, fingers: Rotation) -> tuple[np.ndarray, np.ndarray]:
        """Orientations (T, 3, 3) of the human hand's wrist frame, and joints (T, 5, 4, 3) in it, as
        in a `Sequence`.

        Args:
          root: (T,) orientations of MANO's root.
          fingers: (T, 15) rotations of the finger joints relative to their parents, in MANO's
            order.
        """
        local = fingers.as_matrix().reshape(-1, 5, 3, 3, 3)
        bones = np.diff(self.fingers, axis=1)
        placed = [np.broadcast_to(self.fingers[:, 0] - self.wrist, (len(local), 5, 3))]
        turn = np.broadcast_to(np.eye(3), (*local.shape[:2], 3, 3))
        for k in range(3):
            turn = turn @ local[:, :, k]
            placed.append(placed[-1] + np.einsum("tfij,fj->tfi", turn, bones[:, k]))
        return root.as_matrix() @ TO_HUMAN.T, np.stack(placed, 2)[:, _ORDER] @ TO_HUMAN.T


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
        joints = model.regressor @ vertices
        tips = vertices[[TIP_VERTICES[finger] for finger in MANO_FINGERS]]
    fingers = np.concatenate([joints[1:].reshape(5, 3, 3), tips[:, None]], 1)
    return Skeleton(joints[0], fingers)


def read_vertices(path: pathlib.Path) -> np.ndarray:
    """Reads the vertices (n, 3) of a mesh or a point cloud, in the file's order.

    Raises:
      CongraspError: it cannot be read, or holds several.
    """
    geometry = load_geometry(path, "Download the file again.", maintain_order=True)
    if not hasattr(geometry, "vertices"):
        raise CongraspError(
            f"{path} does not contain a single mesh or point cloud.", "Download the file again."
        )
    return np.asarray(geometry.vertices, float)
