"""A captured grasp whose answer is known: a box pinched by thumb and index finger, after an
approach along a curve.
"""

import dataclasses
import pathlib

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.mano import MANO_FINGERS
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.services.assets.captures.human import TO_HUMAN, joint_positions
from congrasp.services.assets.captures.references import separate_fingers

FRAMES = 90
GRASP = 60
"""Frames of a sequence, and the one in which the fingers have closed."""
ORIGIN = np.array([0.02, -0.01, 0.03])
"""Where the box's centre lies in its mesh file, m."""


def q_closed(rng: np.random.Generator) -> np.ndarray:
    """(20,) a pinch within the limits, a little different each time, with no finger in another or
    the box.
    """
    share = np.where(
        [joint.name.startswith(("thumb", "index")) for joint in HUMAN.joints], 0.35, 0.1
    )
    q = HUMAN.q_open + share * (HUMAN.q_closed - HUMAN.q_open) + rng.uniform(-0.05, 0.05, 20)
    return separate_fingers(HUMAN, np.clip(q, HUMAN.lower + 0.01, HUMAN.upper - 0.01)[None])[0]


@dataclasses.dataclass
class Known:
    """A sequence and its answer; the wrist frame is that of the human hand."""

    name: str
    object_name: str
    size: np.ndarray
    """(3,) edges of the box, m."""
    q: np.ndarray
    """(20,) the grasp's finger angles."""
    wrist_position: np.ndarray
    """(T, 3) world."""
    wrist_rotation: Rotation
    fingers: np.ndarray
    """(T, 20)."""
    object_position: np.ndarray
    """(T, 3) world, of the mesh file's origin."""
    object_rotation: Rotation
    path: np.ndarray
    """(n, 3) the wrist's path in the object frame, dense, whose far end is 20 cm from the box."""
    turns: Rotation
    """(n,) its orientations."""

    def mesh(self) -> trimesh.Trimesh:
        """The box as its file has it."""
        return trimesh.creation.box(self.size).apply_translation(ORIGIN)

    def waypoints(self, count: int = 15) -> tuple[np.ndarray, Rotation]:
        """The expected trajectory, at equal distances along the path."""
        length = np.concatenate([[0], np.linalg.norm(np.diff(self.path, axis=0), axis=-1).cumsum()])
        lengths = np.linspace(0, length[-1], count)
        position = np.stack([np.interp(lengths, length, axis) for axis in self.path.T], -1)
        return position, Slerp(length, self.turns)(lengths)


def make(
    name: str, object_name: str, seed: int = 0, *, farthest: float = 0.27, tail: float = 0.0
) -> Known:
    """A grasp of a box.

    Args:
      name: of the sequence.
      object_name: of the box.
      seed: of poses, path and world.
      farthest: metres from which the wrist comes, along its approach.
      tail: metres by which the box is longer than its pinched end, away from the wrist along its -z
        axis.
    """
    q = q_closed(np.random.default_rng(0))
    rng = np.random.default_rng(seed)
    tips = joint_positions(q)[:2, 3]
    middle = tips.mean(0)
    across = tips[1] - tips[0]
    width = float(np.linalg.norm(across))
    # The box's x axis is the pinch; its other edges are shorter than a hand, and any roll about the
    # pinch will do.
    x = across / width
    y = np.cross(x, [0, -1.0, 0])
    y /= np.linalg.norm(y)
    box = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], -1))  # object frame to wrist frame
    size = np.array([width - 0.016, 0.03, 0.03 + tail])
    grasp_turn = box.inv()
    grasp_at = -box.inv().apply(middle) + [0, 0, tail / 2]

    outward = grasp_turn.apply([0, 1.0, 0.3]) / np.linalg.norm([0, 1.0, 0.3])
    side = np.cross(outward, rng.normal(size=3))
    side /= np.linalg.norm(side)
    axis = rng.normal(size=3)
    axis *= 0.4 / np.linalg.norm(axis)

    def wrist(s: np.ndarray) -> tuple[np.ndarray, Rotation]:
        away = (1 - s)[:, None]
        swing = 0.02 * np.sin(np.pi * s)[:, None]
        return grasp_at + farthest * away * outward + swing * side, Rotation.from_rotvec(
            away * axis
        ) * grasp_turn

    s = np.concatenate([np.linspace(0, 1, GRASP + 1), np.ones(FRAMES - GRASP - 1)])
    position, rotation = wrist(s)
    lifted = np.concatenate([np.zeros(GRASP + 1), np.linspace(0, 0.2, FRAMES - GRASP - 1)])
    world_turn = Rotation.random(rng=rng)
    world_turns = Rotation.concatenate(
        [Rotation.from_rotvec([0, 0, 2 * lift]) * world_turn for lift in lifted]
    )
    center = rng.uniform(-0.2, 0.2, 3) + np.outer(lifted, [0.3, 0, 1])

    dense_s = np.linspace(0, 1, 4001)
    path, turns = wrist(dense_s)
    outside = np.linalg.norm(np.maximum(np.abs(path) - size / 2, 0), axis=-1)
    first = int(np.flatnonzero(outside > 0.20)[-1] + 1) if (outside > 0.20).any() else 0
    return Known(
        name=name,
        object_name=object_name,
        size=size,
        q=q,
        wrist_position=world_turns.apply(position) + center,
        wrist_rotation=world_turns * rotation,
        fingers=np.where(np.arange(FRAMES)[:, None] < GRASP, HUMAN.q_open - 0.1, q),
        object_position=center - world_turns.apply(ORIGIN),
        object_rotation=world_turns,
        path=path[first:],
        turns=turns[first:],
    )


def write_mesh(scene: Known, path: pathlib.Path) -> None:
    """The box's mesh in metres."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.mesh().export(path)


def check(arrays: dict[str, np.ndarray], m: int, scene: Known) -> None:
    """Pose and trajectory m of a set are the known ones within 1 mm and 0.01 rad."""
    position, turns = scene.waypoints(arrays["trajectory/position"].shape[2])
    rotation = Rotation.from_quat(arrays["trajectory/quaternion"][0, m], scalar_first=True)
    np.testing.assert_allclose(arrays["trajectory/position"][0, m], position, atol=1e-3)
    assert (rotation * turns.inv()).magnitude().max() < 0.01
    np.testing.assert_allclose(arrays["pose/q"][0, m], scene.q, atol=0.01)
    np.testing.assert_allclose(arrays["pose/position"][0, m], position[-1], atol=1e-3)
    last = Rotation.from_quat(arrays["pose/quaternion"][0, m], scalar_first=True)
    assert (last * turns[-1].inv()).magnitude() < 0.01


def mano_rotations(fingers: np.ndarray) -> np.ndarray:
    """(T, 15, 3, 3) rotations of MANO's joints against their parents that pose the human hand like
    angles (T, 20).
    """
    names = [link.name for link in HUMAN.links]
    rows = []
    different, which = np.unique(fingers, axis=0, return_inverse=True)
    for q in different:
        turns = Rotation.from_quat(mujoco_link_poses(HUMAN, q)[1], scalar_first=True).as_matrix()
        turns = TO_HUMAN.T @ turns @ TO_HUMAN
        for finger in MANO_FINGERS:
            links = (
                ("metacarpal", "proximal", "distal")
                if finger == "thumb"
                else ("proximal", "middle", "distal")
            )
            parent = np.eye(3)
            for link in links:
                turn = turns[names.index(f"{finger}_{link}")]
                rows.append(parent.T @ turn)
                parent = turn
    return np.array(rows).reshape(-1, 15, 3, 3)[which]


def mano_root(rotation: Rotation) -> Rotation:
    """MANO's root rotations from those of the human hand's wrist frame."""
    return rotation * Rotation.from_matrix(TO_HUMAN)
