"""A policy as an ONNX graph: observation in, action out, normalisation inside, no dependency on JAX."""

import itertools
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.network import CLOUD, POINT, TRUNK, gated, layer_count
from congrasp.common.policy.normalizer import LIMIT

OPSET = 17
"""An old version, which every runtime in use supports; the graph needs no newer one."""
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
        """Adds a layer of the network."""
        kernel = self.constant(f"{layer}.kernel", layers[layer]["kernel"])
        product = self.node("MatMul", [x, kernel], f"{output}.product")
        return self.node("Add", [product, self.constant(f"{layer}.bias", layers[layer]["bias"])], output)

    def stack(self, layers: Mapping[str, Any], kind: str, x: str) -> str:
        """Adds the layers of the trunk, or of a cloud's points."""
        for depth in range(layer_count(layers, kind)):
            name = f"{kind}_{depth}"
            x = self.node("Elu", [self.dense(layers, name, x, f"{name}.dense")], f"{name}.elu")
        return x


def policy_model(bundle: PolicyBundle, meta: Mapping[str, Any]) -> onnx.ModelProto:
    """The policy's mean action as a model: `observation` (batch, D) to `action` (batch, A), float32.

    Args:
      bundle: the policy.
      meta: metadata of the file; each value is stored as JSON.
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
        points = graph.node("Reshape", [CLOUD, graph.constant("points.shape", [0, -1, POINT], np.int64)], "points")
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
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
    )
    helper.set_model_props(model, {name: json.dumps(value) for name, value in meta.items()})
    onnx.checker.check_model(model, full_check=True)
    return model


def _slice(graph: _Graph, x: str, start: int, end: int, output: str) -> str:
    """Columns `start` to `end` of x."""
    bounds = [graph.constant(f"{output}.{name}", [value], np.int64) for name, value in (("start", start), ("end", end))]
    axes = graph.constant(f"{output}.axes", [1], np.int64)
    return graph.node("Slice", [x, *bounds, axes], output)
