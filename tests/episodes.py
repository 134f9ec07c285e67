"""A fake episode: the hand approaches a cylinder, closes, and holds it after the removal of the
table.
"""

from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.wire.codec import Message

BLOCKS = ("affordance", "pose_finger", "pose_wrist", "trajectory")
"""Blocks of the observation that a policy of the paper's constraints gates."""
RADIUS = 0.03
HEIGHT = 0.12
CONTROL_DT = 0.01
FORCE = 1.5  # N on each fingertip while it touches


def episode_message(
    steps: int = 12, *, removal: int = 8, mask: tuple[int, ...] = (1, 1, 1, 1), success: bool = True
) -> Message:
    """`steps` control steps; the table goes at `removal`, the tips touch from two thirds of that
    on.

    Its errors are those of its way: the wrist comes straight along its path and ends, like the
    fingers, where the reference pose has it. `mask` says which of `BLOCKS` are active.
    """
    hand = get_hand("human")
    frame = grasp_frame(hand)
    direction = np.array([-1.0, 0.3, -0.35]) / np.linalg.norm([-1.0, 0.3, -0.35])
    cross = np.cross(direction, [0.0, 0.0, 1.0]) / np.linalg.norm(
        np.cross(direction, [0.0, 0.0, 1.0])
    )
    wrist_turn = Rotation.align_vectors([direction, cross], [frame.heading, frame.cross])[0]
    center = np.array([0.0, 0.0, HEIGHT / 2])
    tips = list(hand.tip_links)
    frames = []
    shares = []
    for step in range(steps):
        share = min(step / (2 * removal / 3), 1.0)
        shares.append(share)
        wrist = center - wrist_turn.apply(frame.center) - 0.12 * (1 - share) * direction
        q = hand.q_open + 0.4 * share * (hand.q_closed - hand.q_open)
        position, quaternion = mujoco_link_poses(hand, q)
        force = np.zeros((len(hand.links), 3))
        force[tips] = [0.0, 0.0, FORCE * (share == 1.0)]
        turned = wrist_turn * Rotation.from_quat(quaternion, scalar_first=True)
        frames.append(
            (wrist_turn.apply(position) + wrist, turned.as_quat(scalar_first=True), force, q)
        )
    positions, quaternions, forces, q = (np.array(a, np.float32) for a in zip(*frames, strict=True))
    mesh = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=24)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 128, seed=0)[0], np.float32)
    wrist_local = wrist - center
    turn = wrist_turn.as_quat(scalar_first=True).astype(np.float32)
    arrays = {
        "link_position": positions,
        "link_quaternion": quaternions,
        "object_position": np.tile(center.astype(np.float32), (steps, 1)),
        "object_quaternion": np.tile(np.array([1, 0, 0, 0], np.float32), (steps, 1)),
        "contact_force": forces,
        "q": q,
        "u": np.zeros((steps, 6), np.float32),
        "q_target": q,
        "u_target": np.zeros((steps, 6), np.float32),
        "action": np.zeros((steps, len(hand.joints) + 6), np.float32),
        "table": np.arange(steps) < removal,
        "reward/contact": np.linspace(0, 0.5, steps, dtype=np.float32),
        "reward/distance": np.linspace(-0.5, -0.1, steps, dtype=np.float32),
        "error/heading_rad": np.zeros(steps, np.float32),
        "error/heading_m": np.zeros(steps, np.float32),
        "error/affordance_ratio": np.zeros(steps, np.float32),
        "error/pose_rad": np.abs(q - q[-1]).mean(-1),
        "error/pose_m": 0.12 * (1 - np.array(shares, np.float32)),
        "error/trajectory_rad": np.zeros(steps, np.float32),
        "error/trajectory_m": np.zeros(steps, np.float32),
        "goal/heading_position": np.zeros(3, np.float32),
        "goal/heading_direction": direction.astype(np.float32),
        "goal/heading_cross": cross.astype(np.float32),
        "goal/pose_q": q[-1],
        "goal/pose_position": wrist_local.astype(np.float32),
        "goal/pose_quaternion": turn,
        "goal/trajectory_position": np.linspace(
            wrist_local - 0.12 * direction, wrist_local, 5
        ).astype(np.float32),
        "goal/trajectory_quaternion": np.tile(turn, (5, 1)),
        **{f"active/{name}": np.bool_(bit) for name, bit in zip(BLOCKS, mask, strict=True)},
        "piece_kind": np.array([1], np.int32),
        "piece_size": np.array([[RADIUS, HEIGHT / 2, 0]], np.float32),
        "piece_pos": np.zeros((1, 3), np.float32),
        "piece_quat": np.array([[1, 0, 0, 0]], np.float32),
        "piece_part": np.zeros(1, np.int32),
        "visual_vertices": np.asarray(mesh.vertices, np.float32),
        "visual_faces": np.asarray(mesh.faces, np.int32),
        "surface_points": points,
        "surface_avoid": points[:, 2] > HEIGHT / 4,
    }
    meta = {
        "hand": "human",
        "object": "cylinder-0",
        "control_dt": CONTROL_DT,
        "version": 3,
        "actor": "a0",
        "success": success,
        "metrics": {"return": 12.5, "links_at_removal": 5.0},
    }
    return Message(arrays, meta)


def episode(steps: int = 12, **changes: Any) -> Episode:
    """The episode of `episode_message`."""
    return Episode.from_message(episode_message(steps, **changes))


def moved_arm(steps: int) -> MovedArm:
    """An arm of a base and one link, each a triangle, that turns by 0.1 rad a step."""
    return MovedArm(
        name="two",
        joint_names=np.array(["turn"]),
        joint_position=0.1 * np.arange(steps)[:, None],
        joint_slides=np.array([False]),
        joint_link=np.array([1], np.int32),
        joint_axis=np.array([[0.0, 0.0, 1.0]]),
        joint_anchor=np.zeros((1, 3)),
        joint_limits=np.array([[-2.0, 2.0]]),
        joint_speed=np.array([3.0]),
        link_names=np.array(["base", "link"]),
        link_parent=np.array([-1, 0], np.int32),
        link_position=np.tile([[0.4, 0.0, 0.0], [0.4, 0.0, 0.1]], (steps, 1, 1)),
        link_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (steps, 2, 1)),
        hand_link=np.array(1, np.int32),
        hand_position=np.array([0.0, 0.0, 0.2]),
        hand_quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
        mesh_link=np.array([0, 1], np.int32),
        mesh_colour=np.array([[0.5, 0.5, 0.5], [1.0, 0.4, 0.0]]),
        mesh_vertices=np.concatenate([np.eye(3), 2 * np.eye(3)]),
        mesh_faces=np.array([[0, 1, 2], [3, 4, 5]], np.int32),
        face_mesh=np.array([0, 1], np.int32),
    )


def older(message: Message) -> Message:
    """The episode as recordings had it before they named blocks and kept errors."""
    arrays = {
        name: x for name, x in message.arrays.items() if not name.startswith(("active/", "error/"))
    }
    mask = np.array([message.arrays[f"active/{name}"] for name in BLOCKS], np.float32)
    return Message({**arrays, "goal/mask": mask}, message.meta)
