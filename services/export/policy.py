"""A policy as ONNX or StableHLO, with normalisation inside."""

import dataclasses
import io
import itertools
import json
import pathlib
import zipfile
from collections.abc import Mapping
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

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
from congrasp.common.io.files import write_atomically
from congrasp.common.policy.bundle import PolicyBundle, content_hash, mean_action
from congrasp.common.policy.network import CLOUD, POINT, TRUNK, gated, layer_count
from congrasp.common.policy.normalizer import LIMIT
from congrasp.common.task import observation
from congrasp.common.task.geometry import FORCE_SCALE
from congrasp.common.wire.codec import encode
from congrasp.services.client.limits import JointLimits

SUFFIXES = {"onnx": ".onnx", "stablehlo": ".stablehlo.zip"}
_PLATFORMS = ("cpu", "cuda", "tpu")
# Old ones, which every runtime in use supports; the graph needs no newer ones
_OPSET, _IR_VERSION = (
    17,
    8,
)


def describe(bundle: PolicyBundle) -> dict[str, Any]:
    """Description of the exported policy for its user, as JSON: every input and output number, in
    order.
    """
    hand, task = get_hand(bundle.spec.hand), bundle.task
    joints = [joint.name for joint in hand.joints]
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
        "joints": joints,
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
    return [
        {"block": block, "field": field.name, "size": field.size, "meaning": field.meaning}
        for block, _ in bundle.spec.layout
        for field in described[block]
    ]


def wrist_servos(hand: Hand) -> dict[str, dict[str, Any]]:
    """Gains and inertia of the wrist's slides (N/m, N.s/m, kg) and hinges (N.m/rad, N.m.s/rad,
    kg.m^2).
    """
    gains, (mass, inertia) = hand.wrist, hand.wrist_inertia.tolist()
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
    own = transmission(hand)
    return [
        {
            "name": motor.name,
            "pulls": motor.joints,
            "limits": own.limits[:, m].tolist(),
            "moves": {
                joint.name: {"ratio": float(own.ratio[j]), "rest": float(own.rest[j])}
                for j, joint in enumerate(hand.joints)
                if own.motor[j] == m
            },
        }
        for m, motor in enumerate(hand.motors)
    ]


def action_meaning(bundle: PolicyBundle) -> list[dict[str, Any]]:
    """The action's numbers in order: the motor or wrist joint, the scale, and the formula of its
    target.
    """
    control = bundle.task.control
    fingers = [
        {
            "joint": motor.name,
            "unit": "rad",
            "scale": control.finger_scale,
            "target": "clip(previous target + scale * action, limits)",
        }
        for motor in get_hand(bundle.spec.hand).motors
    ]
    wrist = [
        {
            "joint": name,
            "unit": "m" if i < 3 else "rad",
            "scale": control.wrist_position_scale if i < 3 else control.wrist_rotation_scale,
            "target": (
                "joint + lead; lead = steady + limit(limit(limit(guidance - joint, L) + scale * "
                "action, L) - steady, inertia / kp * A), steady = kv / kp * velocity, limit "
                "shortens the three slides or hinges together; L: guidance_..._limit, "
                "A: 'limit' of 'wrist' (0: none), both of the task's control"
            ),
        }
        for i, name in enumerate(WRIST_JOINTS)
    ]
    return fingers + wrist


def export_policy(bundle: PolicyBundle, kind: str, path: pathlib.Path) -> None:
    """Writes a policy.

    Args:
      bundle: the policy.
      kind: onnx or stablehlo.
      path: the file.

    Raises:
      CongraspError: the file cannot be written.
    """
    write_atomically(path, _onnx(bundle) if kind == "onnx" else _stablehlo(bundle))


def _stablehlo(bundle: PolicyBundle) -> bytes:
    """A ZIP with `policy.jax` (for `jax.export.deserialize`), `policy.mlirbc` (portable StableHLO)
    and `meta.json`.
    """
    layout, parameters = bundle.spec.layout, jax.device_get(bundle.inference_parameters)
    size = sum(width for _, width in layout)
    function = jax.jit(lambda observation: mean_action(layout, parameters, observation))
    batch = jax.export.symbolic_shape("batch")[0]
    argument = jax.ShapeDtypeStruct((batch, size), jnp.float32)
    exported = jax.export.export(function, platforms=_PLATFORMS)(argument)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.jax", exported.serialize())
        archive.writestr("policy.mlirbc", exported.mlir_module_serialized)
        archive.writestr("meta.json", json.dumps(describe(bundle), indent=1))
    return buffer.getvalue()


class _Graph:
    """Nodes and constants under construction; every method returns the name of its result."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant."""
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Adds a node."""
        self.nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def dense(self, layers: Mapping[str, Any], layer: str, x: str, output: str) -> str:
        """Adds a layer of the network."""
        kernel = self.constant(f"{layer}.kernel", layers[layer]["kernel"])
        product = self.node("MatMul", [x, kernel], f"{output}.product")
        return self.node(
            "Add", [product, self.constant(f"{layer}.bias", layers[layer]["bias"])], output
        )

    def stack(self, layers: Mapping[str, Any], kind: str, x: str) -> str:
        """Adds the layers of the trunk, or of a cloud's points."""
        for depth in range(layer_count(layers, kind)):
            name = f"{kind}_{depth}"
            x = self.node("Elu", [self.dense(layers, name, x, f"{name}.dense")], f"{name}.elu")
        return x


def _onnx(bundle: PolicyBundle) -> bytes:
    """The policy's mean action as a model: `observation` (batch, D) to `action` (batch, A),
    float32.
    """
    layout, layers = bundle.spec.layout, bundle.params["actor"]["network"]
    shift, scale = bundle.inference_parameters.normalization
    graph = _Graph()
    centred = graph.node("Sub", ["observation", graph.constant("shift", shift)], "centred")
    scaled = graph.node("Mul", [centred, graph.constant("scale", scale)], "scaled")
    limits = [graph.constant("low", -LIMIT), graph.constant("high", LIMIT)]
    graph.node("Clip", [scaled, *limits], "normalised")
    ends = list(itertools.accumulate(size for _, size in layout))
    for (name, size), end in zip(layout, ends, strict=True):
        _slice(graph, "normalised", end - size, end, name)
    parts = list(TRUNK)
    if CLOUD in dict(layout):
        points = graph.node(
            "Reshape", [CLOUD, graph.constant("points.shape", [0, -1, POINT], np.int64)], "points"
        )
        seen = graph.stack(layers, CLOUD, points)
        parts.append(graph.node("ReduceMax", [seen], "points.most", axes=[1], keepdims=0))
    for bit, name in enumerate(gated(layout)):
        code = graph.node("Elu", [graph.dense(layers, name, name, f"{name}.dense")], f"{name}.code")
        gate = _slice(graph, "mask", bit, bit + 1, f"{name}.bit")
        parts.append(graph.node("Mul", [code, gate], f"{name}.gated"))
    x = graph.node("Concat", parts, "trunk", axis=-1)
    graph.dense(layers, "output", graph.stack(layers, "trunk", x), "action")

    def port(name: str, size: int) -> Any:
        """An input or output (batch, size)."""
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "congrasp_policy",
            [port("observation", ends[-1])],
            [port("action", bundle.spec.action_size)],
            graph.constants,
        ),
        producer_name="congrasp",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )
    helper.set_model_props(
        model, {name: json.dumps(value) for name, value in describe(bundle).items()}
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _slice(graph: _Graph, x: str, start: int, end: int, output: str) -> str:
    """Columns `start` to `end` of x."""
    bounds = [
        graph.constant(f"{output}.{name}", [value], np.int64)
        for name, value in (("start", start), ("end", end))
    ]
    axes = graph.constant(f"{output}.axes", [1], np.int64)
    return graph.node("Slice", [x, *bounds, axes], output)
