"""Policy bundle: weights, critic and normalisers of one version, as one immutable unit.

The learner publishes bundles, actors and the policy server act with them, and the package ships
some, without their critics. Acting normalises with the bundle's statistics, so that a log
probability belongs to exactly one bundle.
"""

import dataclasses
import functools
import hashlib
import json
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.config import NetworkConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import check_reference, get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.common.io.records import record_of
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.network import Layout, Params
from congrasp.common.policy.normalizer import Affine, Statistics
from congrasp.common.ranges import network_faults, task_faults
from congrasp.common.task import observation as task_observation
from congrasp.common.task import privileged
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import Array
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

FORMAT = 2
_SCHEMA = 1
_CRITIC = "critic"
_MAX_COUNT = 1 << 53
"""Limit of versions and environment steps, which JSON keeps exactly."""
_MAX_WEIGHT = 1e4
_MAX_STATISTIC = 1e30
_MAX_LOG_STD = 10.0
"""Limits of the magnitude of weights, statistics, and logarithms of standard deviations: beyond
them, inference in float32 overflows."""
_MAX_PRIOR_SAMPLES = 1e5
"""Most samples that count when inputs are added: samples of these soon outweigh the unit variance
of their start.
"""
_MALFORMED = (LookupError, AttributeError, TypeError, ValueError, OverflowError)
_REMEDY = "Use a bundle from 'congrasp train' of this version."


@dataclasses.dataclass(frozen=True)
class PolicySpec:
    """Interface of a policy's arrays: hand, observation layout, and sizes of the networks."""

    hand: str
    """Reference of the hand: its name, or the text of its file for a custom hand."""
    layout: Layout
    """Names and sizes of the observation's blocks."""
    action_size: int
    """A."""
    network: NetworkConfig
    """Sizes of the networks."""
    privileged: Layout = ()
    """Names and sizes of the critic's privileged inputs (`common.task.privileged`); not part of the
    schema, because acting does not use them."""

    @property
    def privileged_size(self) -> int:
        """P, the number of the critic's privileged inputs."""
        return sum(size for _, size in self.privileged)

    @property
    def hand_name(self) -> str:
        """The hand's name."""
        return get_hand(self.hand).name if self.hand.startswith("{") else self.hand

    @functools.cached_property
    def schema(self) -> str:
        """Sixteen hex digits shared by policies that can replace each other."""
        sizes = [self.network.hidden, self.network.encoder]
        if network.CLOUD in dict(self.layout):
            sizes.append(self.network.points)
        text = json.dumps([_SCHEMA, self.hand, self.layout, self.action_size, sizes])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def inference_form(self) -> "InferenceParameters":
        """Shapes and types of the parameters with which policies of this spec act."""
        tree = network.shapes(self.layout, self.action_size, self.network)
        row = jax.ShapeDtypeStruct((sum(size for _, size in self.layout),), np.float32)
        return InferenceParameters({"actor": tree["actor"]}, Affine(row, row))

    def require(self, spec: "PolicySpec", source: str) -> None:
        """Raises a `CongraspError` unless another spec has the schema of this one.

        Args:
          spec: the other spec.
          source: words after "The policy" in the message, which identify the policy of `spec`.
        """
        if spec.schema != self.schema:
            raise CongraspError(
                f"The policy {source} is for hand '{spec.hand_name}' (schema {spec.schema}), not "
                f"for hand '{self.hand_name}' (schema {self.schema}).",
                "Use a policy with the same hand, task and network.",
            )


def policy_spec(task: TaskConfig, sizes: NetworkConfig) -> PolicySpec:
    """Returns the spec of a task's policy."""
    hand = get_hand(task.hand)
    return PolicySpec(
        hand=hand.reference,
        layout=task_observation.layout(hand, task),
        action_size=len(hand.motors) + 6,
        network=sizes,
        privileged=privileged.layout(hand, task) if sizes.privileged_critic else (),
    )


def full_layout(task: TaskConfig) -> Layout:
    """Layout of the full observation of the task, even if its policy observes less."""
    return task_observation.layout(
        get_hand(task.hand), dataclasses.replace(task, observation="full")
    )


class InferenceParameters(NamedTuple):
    """Part of a bundle that inference uses; an argument of `mean_action` and `sample_action`."""

    params: Params
    normalization: Affine


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyBundle:
    """One version of a policy with everything needed to act or to resume training."""

    spec: PolicySpec
    """Interface of the arrays."""
    task: TaskConfig
    """Task of the training."""
    params: Params
    """Parameters of actor and critic (`common.policy.network`); the critic may be absent."""
    observation: Statistics
    """Statistics of the observations."""
    value: Statistics
    """Statistics of the returns; empty without a critic."""
    version: int
    """Increases with every update of a run, also across restarts of its learner."""
    run_id: str
    """Identifier of the run's start: new when training restarts from scratch, unchanged by a
    resume.
    """
    transitions: int
    """Environment steps of the training."""
    privileged: Statistics | None = None
    """Statistics of the critic's privileged inputs; None without inputs or samples."""

    @property
    def has_critic(self) -> bool:
        """False for a policy that can act, but has only half of what training needs."""
        return _CRITIC in self.params

    @functools.cached_property
    def actor_sha256(self) -> str:
        """SHA-256 of all that determines the actions, in hex digits: it survives `without_critic`.

        It covers the hand, the schema, and name, type, shape and bytes of each array of the actor
        and of the observations' statistics.
        """
        tree = {"actor": self.params["actor"], "observation": self.observation._asdict()}
        arrays = flax.traverse_util.flatten_dict(tree, sep="/")
        digest = hashlib.sha256(json.dumps([self.spec.hand, self.spec.schema]).encode())
        for name in sorted(arrays):
            array = np.asarray(arrays[name])
            digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    @functools.cached_property
    def inference_parameters(self) -> InferenceParameters:
        """Actor and frozen normalisation, on the default device."""
        affine = normalizer.observation_affine(self.observation, self.spec.layout)
        return InferenceParameters(*jax.device_put(({"actor": self.params["actor"]}, affine)))

    def to_message(self) -> Message:
        """Returns the bundle as arrays and metadata; arrays are shared, not copied."""
        tree = {**self.params, "observation": self.observation._asdict()}
        if self.has_critic:
            tree["value"] = self.value._asdict()
        if self.has_critic and self.spec.privileged:
            privileged = self.privileged or normalizer.empty((self.spec.privileged_size,))
            tree["privileged"] = privileged._asdict()
        meta = {
            "format": FORMAT,
            "version": self.version,
            "run_id": self.run_id,
            "transitions": self.transitions,
            "schema": self.spec.schema,
            "hand": self.spec.hand,
            "layout": [[name, size] for name, size in self.spec.layout],
            "action_size": self.spec.action_size,
            "privileged": [[name, size] for name, size in self.spec.privileged],
            "network": dataclasses.asdict(self.spec.network),
            "task": dataclasses.asdict(self.task),
        }
        return Message(flax.traverse_util.flatten_dict(tree, sep="/"), meta)

    @staticmethod
    def from_message(message: Message, source: str = "bundle") -> "PolicyBundle":
        """Returns the bundle of a message; the inverse of `to_message`.

        Args:
          message: a bundle.
          source: name of the bundle in errors.

        Raises:
          CongraspError: an entry is missing, has the wrong shape, or is out of range; the message
            names the first.
        """
        meta = message.meta
        if meta.get("format") != FORMAT:
            raise CongraspError(
                f"The policy {source} has format {meta.get('format')}, not {FORMAT}.", _REMEDY
            )
        try:
            spec = _spec(meta)
            task = record_of(TaskConfig, meta["task"])
            version = _count(meta, "version")
            transitions = _count(meta, "transitions")
            run_id = str(meta["run_id"])
            _check_ranges(spec, task)
            has_critic = any(name.startswith(f"{_CRITIC}/") for name in message.arrays)
            shapes = _shapes(spec, has_critic)
        except (*_MALFORMED, CongraspError) as error:
            why = str(error).rstrip(".")[:200]
            raise CongraspError(
                f"The policy {source} has invalid metadata: {why}.", _REMEDY
            ) from None
        if meta.get("schema") != spec.schema:
            raise CongraspError(
                f"The policy {source} has a schema that does not match its content.", _REMEDY
            )
        _check_arrays(message.arrays, shapes, source)
        tree = flax.traverse_util.unflatten_dict(dict(message.arrays), sep="/")
        statistics = {"value": normalizer.empty()}
        for name in ("observation", "value", "privileged"):
            if name in tree:
                statistics[name] = Statistics(**tree.pop(name))
        return PolicyBundle(
            spec=spec,
            task=task,
            params=tree,
            version=version,
            run_id=run_id,
            transitions=transitions,
            **statistics,
        )


def without_critic(bundle: PolicyBundle) -> PolicyBundle:
    """Returns the bundle without its critic and the statistics that only the critic uses.

    It acts as before, since actor and statistics of the observations are the same arrays.
    """
    return dataclasses.replace(
        bundle,
        params={"actor": bundle.params["actor"]},
        value=normalizer.empty(),
        privileged=None,
    )


def with_new_critic(bundle: PolicyBundle, seed: int) -> PolicyBundle:
    """Returns the bundle with a critic of random weights and empty statistics, as at the start of a
    training.

    Args:
      bundle: a policy, with or without a critic.
      seed: seed of the weights.
    """
    spec = bundle.spec
    random = network.init(seed, spec.layout, spec.action_size, spec.network, spec.privileged_size)
    return dataclasses.replace(
        bundle,
        params={**bundle.params, _CRITIC: random[_CRITIC]},
        value=normalizer.empty(),
        privileged=None,
    )


def with_inputs_of(spec: PolicySpec, task: TaskConfig, bundle: PolicyBundle) -> PolicyBundle:
    """Returns the bundle with the inputs of another spec; new ones of state and critic get zero
    weight.

    Args:
      spec: spec of the result: that of the task.
      task: the task.
      bundle: a policy of the same hand and networks.

    Raises:
      CongraspError: the policy has another hand, other networks, or inputs that the spec lacks.
    """
    size = bundle.spec.layout[0][1]
    count = float(bundle.observation.count)
    state = np.arange(size)
    if spec.schema != bundle.spec.schema:
        hand = get_hand(spec.hand)
        new_inputs = _state_inputs(hand, task)
        old_inputs = _state_inputs(hand, bundle.task)
        extended_spec = bundle.spec
        if len(old_inputs) == size and set(old_inputs) <= set(new_inputs):
            layout = (("state", len(new_inputs)), *bundle.spec.layout[1:])
            extended_spec = dataclasses.replace(bundle.spec, layout=layout)
        spec.require(extended_spec, "that initialises the training")
        index = {name: i for i, name in enumerate(old_inputs)}
        state = np.array([index.get(name, -1) for name in new_inputs])
    same_critic = spec.privileged == bundle.spec.privileged
    if same_critic:
        privileged = np.arange(spec.privileged_size)
    else:
        privileged = np.full(spec.privileged_size, -1)
    rows = np.concatenate([state, np.arange(size, len(bundle.observation.mean))])
    fewer = min(count, _MAX_PRIOR_SAMPLES) if (state < 0).any() else count
    scale = fewer / count if count else 1.0
    mean = np.where(rows < 0, 0.0, bundle.observation.mean[rows])
    m2 = np.where(rows < 0, fewer, bundle.observation.m2[rows] * scale)
    return dataclasses.replace(
        bundle,
        spec=spec,
        task=task,
        params=network.with_inputs(bundle.params, state, privileged),
        observation=Statistics(np.float64(fewer), mean, m2),
        privileged=bundle.privileged if same_critic else None,
    )


def _state_inputs(hand: Hand, task: TaskConfig) -> list[tuple[str, int]]:
    """Field and index within the field of each input of the state."""
    inputs = []
    for field in task_observation.fields(hand, task)["state"]:
        inputs += [(field.name, i) for i in range(field.size)]
    return inputs


def content_hash(encoded: bytes) -> str:
    """Returns sixteen hex digits that identify an encoded bundle's content."""
    return hashlib.sha256(encoded).hexdigest()[:16]


def save(bundle: PolicyBundle, path: pathlib.Path) -> None:
    """Writes a bundle to a `.safetensors` file, atomically."""
    write_atomically(path, encode(bundle.to_message()))


def load(path: pathlib.Path) -> PolicyBundle:
    """Reads a bundle from a file; errors name it."""
    remedy = (
        "Pass a policy file (policy.safetensors in a run's folder), or a name "
        "('congrasp policies list')."
    )
    data = read_file(path, MAX_MESSAGE, remedy)
    try:
        message = decode(data)
    except CongraspError as error:
        raise CongraspError(
            f"The policy {path} is damaged, or is not a policy: {error}", remedy
        ) from None
    return PolicyBundle.from_message(message, str(path))


@functools.partial(jax.jit, static_argnums=0)
def mean_action(layout: Layout, parameters: InferenceParameters, observation: Array) -> Array:
    """Deterministic action (..., A) for raw observations (..., D)."""
    normalized = normalizer.apply(parameters.normalization, observation)
    mean, _ = network.policy(parameters.params, layout, normalized)
    return mean


@functools.partial(jax.jit, static_argnums=0)
def sample_action(
    layout: Layout, parameters: InferenceParameters, observation: Array, key: Array
) -> tuple[Array, Array]:
    """Sampled action (..., A) for raw observations (..., D), and its log probability (...,)."""
    normalized = normalizer.apply(parameters.normalization, observation)
    mean, log_std = network.policy(parameters.params, layout, normalized)
    action = network.sample(key, mean, log_std)
    return action, network.log_probability(mean, log_std, action)


def _act_by_mean(
    layout: Layout, parameters: InferenceParameters, observation: Array, key: Array
) -> tuple[Array, Array]:
    """`mean_action` with the signature of `sample_action`: the key is ignored, and the log
    probability is 0.
    """
    return mean_action(layout, parameters, observation), jnp.zeros(observation.shape[:-1])


@functools.cache
def acting(layout: Layout, *, mean: bool) -> Any:
    """The action of policies with this layout, by their mean or sampled, as a function for
    rollouts.

    The same layout gives the same object, so that rollouts of different policies share compiled
    programs.
    """
    return functools.partial(_act_by_mean if mean else sample_action, layout)


def _spec(meta: Mapping[str, Any]) -> PolicySpec:
    """Returns the spec in a bundle's metadata."""
    fields = {field.name: meta[field.name] for field in dataclasses.fields(PolicySpec)}
    spec = record_of(PolicySpec, fields)
    check_reference(spec.hand)
    return spec


def _count(meta: Mapping[str, Any], name: str) -> int:
    """Returns a counter in a bundle's metadata; raises a ValueError outside its range."""
    number = meta[name]
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= _MAX_COUNT:
        raise ValueError(f"its {name} is {number!r:.20}")
    return number


def _check_ranges(spec: PolicySpec, task: TaskConfig) -> None:
    """Raises a ValueError that names the first setting out of its range."""
    inputs = (*spec.layout, *spec.privileged)
    for fault in network_faults(spec.network, inputs, spec.action_size):
        raise ValueError(fault)
    for fault in task_faults(task):
        raise ValueError(fault)


@functools.lru_cache(maxsize=8)
def _shapes(spec: PolicySpec, has_critic: bool) -> dict[str, tuple[int, ...]]:
    """Shapes of a bundle's arrays by name."""
    tree = network.shapes(spec.layout, spec.action_size, spec.network, spec.privileged_size)
    size = sum(width for _, width in spec.layout)
    tree["observation"] = normalizer.empty((size,))._asdict()
    if has_critic:
        tree["value"] = normalizer.empty()._asdict()
    else:
        del tree[_CRITIC]
    if has_critic and spec.privileged:
        tree["privileged"] = normalizer.empty((spec.privileged_size,))._asdict()
    flat = flax.traverse_util.flatten_dict(tree, sep="/")
    return {name: tuple(leaf.shape) for name, leaf in flat.items()}


def _check_arrays(
    arrays: Mapping[str, Array], expected: Mapping[str, tuple[int, ...]], source: str
) -> None:
    """Raises a `CongraspError` unless the arrays have these names and shapes, and values with which
    one can act.
    """
    differing = sorted(expected.keys() ^ arrays.keys())
    if differing:
        raise CongraspError(
            f"The policy {source} lacks '{differing[0]}', or should not have it.", _REMEDY
        )
    for name, shape in expected.items():
        array = arrays[name]
        if tuple(array.shape) != shape:
            raise CongraspError(
                f"The policy {source} has '{name}' of shape {array.shape}, not {shape}.", _REMEDY
            )
        # Arrays on a device never left this process; those from a file or the wire are NumPy
        # arrays.
        if not isinstance(array, np.ndarray):
            continue
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise CongraspError(
                f"The policy {source} has values in '{name}' that are not finite numbers.", _REMEDY
            )
        low, high = _limits(name)
        if array.min(initial=0) < low or array.max(initial=0) > high:
            raise CongraspError(
                f"The policy {source} has values in '{name}' out of range.", _REMEDY
            )


def _limits(name: str) -> tuple[float, float]:
    """Smallest and largest value of the array of this name."""
    leaf = name.rpartition("/")[2]
    if leaf == "log_std":
        return -_MAX_LOG_STD, _MAX_LOG_STD
    if leaf in ("count", "m2"):
        return 0.0, _MAX_STATISTIC
    if leaf in Statistics._fields:
        return -_MAX_STATISTIC, _MAX_STATISTIC
    return -_MAX_WEIGHT, _MAX_WEIGHT
