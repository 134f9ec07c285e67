"""A policy's network as an ONNX model."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.network import CLOUD, POINT, TRUNK, gated, layer_count
from congrasp.common.policy.normalizer import LIMIT
from congrasp.services.export.policy_description import describe

# Old versions, which every runtime in use supports; the graph needs no newer ones.
_OPSET = 17
_IR_VERSION = 8


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
        """Adds a dense layer of the network, applied to x (..., D)."""
        kernel = self.constant(f"{layer}.kernel", layers[layer]["kernel"])
        product = self.node("MatMul", [x, kernel], f"{output}.product")
        bias = self.constant(f"{layer}.bias", layers[layer]["bias"])
        return self.node("Add", [product, bias], output)

    def columns(self, x: str, start: int, end: int, output: str) -> str:
        """Adds the columns from `start` to `end`, exclusive, of x (batch, D)."""
        bounds = [
            self.constant(f"{output}.start", [start], np.int64),
            self.constant(f"{output}.end", [end], np.int64),
        ]
        axes = self.constant(f"{output}.axes", [1], np.int64)
        return self.node("Slice", [x, *bounds, axes], output)

    def stack(self, layers: Mapping[str, Any], kind: str, x: str) -> str:
        """Adds the layers of one kind, those of the trunk or of a cloud's points, applied to x."""
        for depth in range(layer_count(layers, kind)):
            name = f"{kind}_{depth}"
            x = self.dense(layers, name, x, f"{name}.dense")
            x = self.node("Elu", [x], f"{name}.elu")
        return x


def onnx_model(bundle: PolicyBundle) -> bytes:
    """Returns the policy's mean action as a model: `observation` (batch, D) to `action` (batch, A),
    float32.
    """
    size = sum(width for _, width in bundle.spec.layout)
    graph = _Graph()
    _add_policy(graph, bundle)
    onnx_graph = helper.make_graph(
        graph.nodes,
        "congrasp_policy",
        [_port("observation", size)],
        [_port("action", bundle.spec.action_size)],
        graph.constants,
    )
    model = helper.make_model(
        onnx_graph,
        producer_name="congrasp",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )
    properties = {name: json.dumps(value) for name, value in describe(bundle).items()}
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _add_policy(graph: _Graph, bundle: PolicyBundle) -> None:
    """Adds the network from `observation` to `action`."""
    layout = bundle.spec.layout
    layers = bundle.params["actor"]["network"]
    _add_blocks(graph, bundle)
    trunk_inputs = list(TRUNK)
    if CLOUD in dict(layout):
        shape = graph.constant("points.shape", [0, -1, POINT], np.int64)
        points = graph.node("Reshape", [CLOUD, shape], "points")
        codes = graph.stack(layers, CLOUD, points)
        pooled = graph.node("ReduceMax", [codes], "points.most", axes=[1], keepdims=0)
        trunk_inputs.append(pooled)
    for bit, name in enumerate(gated(layout)):
        code = graph.node("Elu", [graph.dense(layers, name, name, f"{name}.dense")], f"{name}.code")
        gate = graph.columns("mask", bit, bit + 1, f"{name}.bit")
        trunk_inputs.append(graph.node("Mul", [code, gate], f"{name}.gated"))
    x = graph.node("Concat", trunk_inputs, "trunk", axis=-1)
    graph.dense(layers, "output", graph.stack(layers, "trunk", x), "action")


def _add_blocks(graph: _Graph, bundle: PolicyBundle) -> None:
    """Adds the normalisation of the observation, and a node for each of its blocks, with the
    block's name.
    """
    shift, scale = bundle.inference_parameters.normalization
    centred = graph.node("Sub", ["observation", graph.constant("shift", shift)], "centred")
    scaled = graph.node("Mul", [centred, graph.constant("scale", scale)], "scaled")
    limits = [graph.constant("low", -LIMIT), graph.constant("high", LIMIT)]
    normalised = graph.node("Clip", [scaled, *limits], "normalised")
    end = 0
    for name, size in bundle.spec.layout:
        start = end
        end += size
        graph.columns(normalised, start, end, name)


def _port(name: str, size: int) -> Any:
    """An input or output (batch, size)."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
