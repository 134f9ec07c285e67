"""Policy and critic networks, which have the same structure but share no weights, and the policy's
diagonal Gaussian.

State and heading are always active and feed the trunk directly. Each optional constraint has an
encoder whose output is multiplied by the constraint's mask bit, so that the trunk receives zeros
for an inactive constraint. All points of a camera's cloud pass through the same layers, and the
trunk receives the maxima over the points, which do not depend on their order (Qi et al. 2017, arXiv
1612.00593).

All functions are pure. `params` is a nested dict with the entries `actor` and `critic`;
observations are already normalised (`common.policy.normalizer`) and have any leading axes.

Where an actor process and the learner must agree on a log probability, the policy's matrix products
are true float32 on every backend: an error of the mean is amplified by 1/std and then
exponentiated. The critic, which is only regressed, and the ratios inside an update, whose two
policies are computed in the same way, use the backend's default (TF32 on NVIDIA GPUs) at half the
cost.
"""

import math
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.config import NetworkConfig
from congrasp.common.errors import CongraspError
from congrasp.common.task.types import Array

Layout = tuple[tuple[str, int], ...]
"""Names and sizes of an observation's blocks, in order (`common.task.observation.layout`)."""
Params = dict[str, Any]
"""Flax parameters: nested dicts of arrays."""

TRUNK = ("state", "heading", "mask")
"""Blocks that feed the trunk directly, in this order; the codes of the gated blocks follow."""
PRIVILEGED = "privileged"
"""Block of the critic's privileged inputs, which follow the codes in its trunk."""
CLOUD = "cloud"
"""Block of a camera's cloud, always active."""
POINT = 4
"""Numbers of each point of a cloud."""
_HIDDEN_GAIN = math.sqrt(2.0)
_ACTION_GAIN = 0.01  # initial actions are noise around zero, independent of the observation
_LOG_2PI = math.log(2.0 * math.pi)


def gated(layout: Layout) -> tuple[str, ...]:
    """Names of the optional blocks gated by the mask, in the order of its bits."""
    return tuple(name for name, _ in layout if name not in (*TRUNK, CLOUD, PRIVILEGED))


def check_layout(layout: Layout) -> None:
    """Raises a `CongraspError` unless the layout has exactly the blocks of the networks."""
    names = [name for name, _ in layout]
    has_duplicates = len(set(names)) < len(names)
    lacks_trunk = not set(TRUNK) <= set(names)
    if has_duplicates or lacks_trunk or dict(layout)["mask"] != len(gated(layout)):
        raise CongraspError(
            f"The observation layout {names} does not match the network.",
            "Use this version's layout.",
        )


def split(layout: Layout, observation: Array) -> dict[str, Array]:
    """Splits observations (..., D) into blocks by name."""
    blocks = {}
    start = 0
    for name, size in layout:
        blocks[name] = observation[..., start : start + size]
        start += size
    return blocks


class GatedNetwork(nn.Module):
    """A multi-layer perceptron on the trunk's blocks and the gated codes of the optional blocks.

    Attributes:
      layout: names and sizes of the observation's blocks.
      hidden: units of the trunk's layers.
      points: units of the layers of a cloud's points.
      encoder: units of each optional block's encoder.
      outputs: units of the linear output layer.
      precision: precision of the matrix products.
    """

    layout: Layout
    hidden: tuple[int, ...]
    points: tuple[int, ...]
    encoder: int
    outputs: int
    precision: jax.lax.Precision | None

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        """Maps normalised observations (..., D) to (..., outputs)."""
        blocks = split(self.layout, observation)
        inputs = [blocks[name] for name in TRUNK]
        if CLOUD in blocks:
            x = blocks[CLOUD].reshape(*observation.shape[:-1], -1, POINT)
            for depth, units in enumerate(self.points):
                x = nn.elu(self._dense(units, f"{CLOUD}_{depth}")(x))
            inputs.append(jnp.max(x, -2))
        for bit, name in enumerate(gated(self.layout)):
            code = nn.elu(self._dense(self.encoder, name)(blocks[name]))
            inputs.append(code * blocks["mask"][..., bit : bit + 1])
        if PRIVILEGED in blocks:
            inputs.append(blocks[PRIVILEGED])
        x = jnp.concatenate(inputs, -1)
        for depth, units in enumerate(self.hidden):
            x = nn.elu(self._dense(units, f"trunk_{depth}")(x))
        return self._dense(self.outputs, "output")(x)

    def _dense(self, units: int, name: str) -> nn.Dense:
        """Returns a layer in the network's precision."""
        return nn.Dense(units, precision=self.precision, name=name)


def _exact(
    layout: Layout, hidden: tuple[int, ...], points: tuple[int, ...], encoder: int, outputs: int
) -> GatedNetwork:
    """Returns the actor network of `_sizes`, with the same results on every device."""
    return GatedNetwork(layout, hidden, points, encoder, outputs, jax.lax.Precision.HIGHEST)


def _fast(
    layout: Layout, hidden: tuple[int, ...], points: tuple[int, ...], encoder: int, outputs: int
) -> GatedNetwork:
    """Returns the critic network of `_sizes`, in the device's default precision."""
    return GatedNetwork(layout, hidden, points, encoder, outputs, None)


def _sizes(tree: Params) -> tuple[tuple[int, ...], tuple[int, ...], int, int]:
    """Units of a network's trunk, points, encoders and output, from its kernels' shapes."""
    units = {name: layer["kernel"].shape[-1] for name, layer in tree.items()}
    hidden = tuple(units.pop(f"trunk_{i}") for i in range(layer_count(tree, "trunk")))
    points = tuple(units.pop(f"{CLOUD}_{i}") for i in range(layer_count(tree, CLOUD)))
    outputs = units.pop("output")
    encoder = next(iter(units.values()), 0)
    return hidden, points, encoder, outputs


def layer_count(tree: Mapping[str, Any], kind: str) -> int:
    """Number of layers of the trunk, or of a cloud's points, in a network's parameters."""
    return sum(name.startswith(f"{kind}_") for name in tree)


def _critic_layout(layout: Layout, privileged: int) -> Layout:
    """Blocks of the critic's input: those of the observation, and one of `privileged` inputs."""
    return (*layout, (PRIVILEGED, privileged)) if privileged else layout


def shapes(layout: Layout, action_size: int, config: NetworkConfig, privileged: int = 0) -> Params:
    """Shapes of `init`'s result, with `jax.ShapeDtypeStruct` leaves; nothing is computed."""
    check_layout(layout)
    size = sum(size for _, size in layout)
    observation = jax.ShapeDtypeStruct((1, size), jnp.float32)
    critic_input = jax.ShapeDtypeStruct((1, size + privileged), jnp.float32)
    sizes = (config.hidden, config.points, config.encoder)
    actor = _exact(layout, *sizes, action_size)
    critic = _fast(_critic_layout(layout, privileged), *sizes, 1)
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    return {
        "actor": {
            "network": jax.eval_shape(actor.init, key, observation)["params"],
            "log_std": jax.ShapeDtypeStruct((action_size,), jnp.float32),
        },
        "critic": jax.eval_shape(critic.init, key, critic_input)["params"],
    }


def init(
    seed: int, layout: Layout, action_size: int, config: NetworkConfig, privileged: int = 0
) -> Params:
    """Initial parameters with orthogonal weights and zero biases: `{"actor": {"network",
    "log_std"}, "critic": {...}}`.

    Weights are drawn with NumPy, since compiling a QR decomposition for each kernel's shape would
    take seconds.

    Args:
      seed: seed of the weights; the actor's do not depend on `privileged`.
      layout: layout of the observation.
      action_size: size A of the action.
      config: sizes of the networks.
      privileged: number P of the critic's privileged inputs.
    """
    rng = np.random.default_rng(seed)
    tree = shapes(layout, action_size, config, privileged)

    def fill(layers: Params, output_gain: float) -> Params:
        """Initialises the layers of one network, the last with a separate gain."""
        filled = {}
        for name, layer in layers.items():
            gain = output_gain if name == "output" else _HIDDEN_GAIN
            kernel = gain * _orthogonal(rng, layer["kernel"].shape)
            bias = np.zeros(layer["bias"].shape, np.float32)
            filled[name] = {"kernel": kernel.astype(np.float32), "bias": bias}
        return filled

    log_std = np.full(action_size, math.log(config.initial_std), np.float32)
    actor = {"network": fill(tree["actor"]["network"], _ACTION_GAIN), "log_std": log_std}
    return jax.device_put({"actor": actor, "critic": fill(tree["critic"], 1.0)})


def _orthogonal(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """A random matrix with orthonormal rows or columns, whichever are fewer (Saxe et al. 2014,
    arXiv 1312.6120).
    """
    tall = rng.normal(size=(max(shape), min(shape)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))
    return q if q.shape == shape else q.T


def policy(
    params: Params, layout: Layout, observation: Array, *, exact: bool = True
) -> tuple[Array, Array]:
    """Mean (..., A) and log standard deviation (A,) of the action; the latter does not depend on
    the observation.

    Without `exact`, matrix products have the backend's default precision, for means that are only
    compared with each other.
    """
    actor = params["actor"]
    build = _exact if exact else _fast
    module = build(layout, *_sizes(actor["network"]))
    mean = module.apply({"params": actor["network"]}, observation)
    return mean, actor["log_std"]


def value(
    params: Params, layout: Layout, observation: Array, privileged: Array | None = None
) -> Array:
    """Estimate (...,) of the normalised return by the critic, from observations and its privileged
    inputs (..., P).
    """
    critic = params["critic"]
    if privileged is not None:
        layout = _critic_layout(layout, privileged.shape[-1])
        observation = jnp.concatenate([observation, privileged], -1)
    module = _fast(layout, *_sizes(critic))
    output: Array = module.apply({"params": critic}, observation)
    return output[..., 0]


def with_inputs(params: Params, state: np.ndarray, privileged: np.ndarray) -> Params:
    """Returns the parameters of networks with more inputs, which get zero weight: results do not
    change yet.

    Args:
      params: parameters of actor and critic, if there is one.
      state: for each input of the new state its index in the old one, all of which must occur, or
        -1 if it is new.
      privileged: the same for the critic's privileged inputs, of which some may be dropped.
    """
    actor = params["actor"]
    old_size = len(actor["network"]["trunk_0"]["kernel"])
    old_state_size = np.count_nonzero(state >= 0)
    actor_rows = np.concatenate([state, np.arange(old_state_size, old_size)])
    widened = {**params, "actor": {**actor, "network": _with_rows(actor["network"], actor_rows)}}
    if "critic" in params:
        privileged_rows = np.where(privileged < 0, -1, old_size + privileged)
        critic_rows = np.concatenate([actor_rows, privileged_rows])
        widened["critic"] = _with_rows(params["critic"], critic_rows)
    return widened


def _with_rows(layers: Params, rows: np.ndarray) -> Params:
    """Returns a network whose first layer has these rows of its kernel; -1 is a row of zeros."""
    first = layers["trunk_0"]
    kernel = np.where(rows[:, None] < 0, np.float32(0), np.asarray(first["kernel"])[rows])
    return {**layers, "trunk_0": {**first, "kernel": kernel}}


def log_probability(mean: Array, log_std: Array, action: Array) -> Array:
    """Log density (...,) of actions (..., A) under the Gaussian, in nats."""
    scaled = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(scaled * scaled + 2.0 * log_std + _LOG_2PI, -1)


def sample(key: Array, mean: Array, log_std: Array) -> Array:
    """An action (..., A) drawn from the Gaussian."""
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def entropy(log_std: Array) -> Array:
    """Differential entropy of the Gaussian, in nats."""
    return jnp.sum(log_std + 0.5 * (1.0 + _LOG_2PI), -1)


def kl_divergence(mean: Array, log_std: Array, mean_other: Array, log_std_other: Array) -> Array:
    """KL(p || other) (...,) between two diagonal Gaussians, in nats."""
    variance_ratio = jnp.exp(2.0 * (log_std - log_std_other))
    shift = (mean - mean_other) * jnp.exp(-log_std_other)
    return 0.5 * jnp.sum(variance_ratio + shift * shift - 1.0 - 2.0 * (log_std - log_std_other), -1)
