"""Description of an exported policy, as JSON."""

import dataclasses
from typing import Any

import numpy as np

from congrasp.actors.physics.scene import (
    HAND_CONTYPE,
    OBJECT_CONTYPE,
    TABLE_AWAY,
    object_contact,
    scene_spec,
)
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import WRIST_JOINTS
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand, link_origin
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.policy.network import gated
from congrasp.common.task import observation
from congrasp.common.task.geometry import FORCE_SCALE
from congrasp.common.wire.codec import encode
from congrasp.services.client.limits import JointLimits

_FINGER_TARGET = "clip(previous target + scale * action, limits)"
_WRIST_TARGET = (
    "joint + lead; lead = steady + limit(limit(limit(guidance - joint, L) + scale * "
    "action, L) - steady, inertia / kp * A), steady = kv / kp * velocity, limit "
    "shortens the three slides or hinges together; L: guidance_..._limit, "
    "A: 'limit' of 'wrist' (0: none), both of the task's control"
)


def describe(bundle: PolicyBundle) -> dict[str, Any]:
    """Description of the exported policy for its user, as JSON: every input and output number, in
    order.
    """
    hand = get_hand(bundle.spec.hand)
    task = bundle.task
    frame = grasp_frame(hand)
    return {
        "format": 1,
        "hand": hand.name,
        "version": bundle.version,
        "bundle": content_hash(encode(bundle.to_message())),
        "units": (
            "m, rad, s, N; quaternions (w, x, y, z); the world's z axis points up, the table's top "
            "is at z = 0"
        ),
        "control_dt": task.control_dt,
        "rate_hz": 1.0 / task.control_dt,
        "layout": [[name, size] for name, size in bundle.spec.layout],
        "observation": observation_fields(bundle),
        "masks": list(gated(bundle.spec.layout)),
        "action": action_meaning(bundle),
        "action_std": np.exp(np.asarray(bundle.params["actor"]["log_std"])).tolist(),
        "joints": [joint.name for joint in hand.joints],
        "joint_limits": [[joint.lower, joint.upper] for joint in hand.joints],
        "robot_limits": JointLimits.of_hand(hand, bundle.task.control).as_lists(),
        "open_pose": hand.q_open.tolist(),
        "motors": motors(hand),
        "wrist_joints": list(WRIST_JOINTS),
        "wrist": wrist_servos(hand),
        "links": [link.name for link in hand.links],
        "link_origins": [list(link_origin(link)) for link in hand.links],
        "keypoint_links": hand.keypoint_links.tolist(),
        "keypoints": hand.keypoints.tolist(),
        "grasp_frame": {"heading": frame.heading.tolist(), "cross": frame.cross.tolist()},
        "force_scale": FORCE_SCALE,
        "task": dataclasses.asdict(task),
        "scene": {
            "mjcf": scene_spec(hand, task.evaluated()).to_xml(),
            "hand_contype": HAND_CONTYPE,
            "object_contype": OBJECT_CONTYPE,
            "object_contact": dataclasses.asdict(object_contact(task)),
            "table_away": list(TABLE_AWAY),
        },
    }


def observation_fields(bundle: PolicyBundle) -> list[dict[str, Any]]:
    """Fields of the observation in order: block, field, size and meaning.

    Vectors are in the wrist frame ("wrist") unless the meaning names another.
    """
    described = observation.fields(get_hand(bundle.spec.hand), bundle.task)
    fields = []
    for block, _ in bundle.spec.layout:
        for field in described[block]:
            description = {
                "block": block,
                "field": field.name,
                "size": field.size,
                "meaning": field.meaning,
            }
            fields.append(description)
    return fields


def wrist_servos(hand: Hand) -> dict[str, dict[str, Any]]:
    """Gains and inertia of the wrist's slides (N/m, N.s/m, kg) and hinges (N.m/rad, N.m.s/rad,
    kg.m^2).
    """
    gains = hand.wrist
    mass, inertia = hand.wrist_inertia.tolist()
    return {
        "position": {
            "kp": gains.slide_kp,
            "kv": gains.slide_kv,
            "inertia": mass,
            "limit": "wrist_acceleration",
        },
        "rotation": {
            "kp": gains.hinge_kp,
            "kv": gains.hinge_kv,
            "inertia": inertia,
            "limit": "wrist_angular_acceleration",
        },
    }


def motors(hand: Hand) -> list[dict[str, Any]]:
    """The fingers' motors in the order of their actions, with coefficients, limits and the joints
    that they move.

    A motor's position is the sum of `pulls` times its joints' angles; a joint's target is `ratio`
    times that of its motor, and `rest`. Most hands have a motor for each joint, with ones and
    zeros.
    """
    drive = transmission(hand)
    descriptions = []
    for m, motor in enumerate(hand.motors):
        moves = {}
        for j in np.flatnonzero(drive.motor == m):
            moves[hand.joints[j].name] = {
                "ratio": float(drive.ratio[j]),
                "rest": float(drive.rest[j]),
            }
        description = {
            "name": motor.name,
            "pulls": motor.joints,
            "limits": drive.limits[:, m].tolist(),
            "moves": moves,
        }
        descriptions.append(description)
    return descriptions


def action_meaning(bundle: PolicyBundle) -> list[dict[str, Any]]:
    """The action's numbers in order: the motor or wrist joint, the scale, and the formula of its
    target.
    """
    control = bundle.task.control
    actions: list[dict[str, Any]] = []
    for motor in get_hand(bundle.spec.hand).motors:
        finger = {
            "joint": motor.name,
            "unit": "rad",
            "scale": control.finger_scale,
            "target": _FINGER_TARGET,
        }
        actions.append(finger)
    for i, name in enumerate(WRIST_JOINTS):
        is_slide = i < 3
        scale = control.wrist_position_scale if is_slide else control.wrist_rotation_scale
        wrist = {
            "joint": name,
            "unit": "m" if is_slide else "rad",
            "scale": scale,
            "target": _WRIST_TARGET,
        }
        actions.append(wrist)
    return actions
