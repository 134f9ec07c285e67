"""Reward terms (paper, section Reward Function): those of the grasp are here, those of constraints
in their files.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import center_fingers, known
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.geometry import FAR, square
from congrasp.common.task.grip import resistance
from congrasp.common.task.posture import finger_deviations
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, SceneState


class Earning(NamedTuple):
    """Contacts that may earn reward: those forbidden by an active constraint earn nothing."""

    touching: Array
    """(B, L) bool."""
    force: Array
    """(B, L, 3) net force on each link, N."""
    force_max: Array
    """() or (B, 1) f_max, N per link."""


class Term(NamedTuple):
    """One term of the grasp reward."""

    name: str
    """Name of the term, of its weight and of its option, `--task.reward.NAME`."""
    default: float
    """Default weight, in units of reward per control step."""
    meaning: str
    """Symbol in the paper, and unit."""
    value: Callable[[Scene, Earning], Array] | None
    """Value (B,) before the weight, signed and bounded; None for a parameter that other terms
    share.
    """


def keypoint_weights(hand: Hand, chosen: Array | None) -> Array:
    """Weights (P,) or (B, P) of the keypoints in the distance reward, for fingers of
    `center_fingers`.

    Keypoints of other fingers get no weight; those of the set and the palm share it.
    """
    weights = jnp.array(hand.keypoint_weights)
    if chosen is None:
        return weights
    owner = hand.link_fingers[hand.keypoint_links]
    kept = jnp.where((owner < 0) | chosen[:, owner], weights, 0.0)
    return kept * (jnp.sum(weights) / jnp.sum(kept, -1, keepdims=True))


def _distance(scene: Scene, earning: Earning) -> Array:
    """Weighted distance from the keypoints to the surface."""
    distances = jnp.linalg.norm(scene.features.nearest, axis=-1)
    weights = keypoint_weights(scene.hand, center_fingers(scene.task, scene.goal))
    return -jnp.sum(weights * jnp.minimum(distances, FAR), -1)


def _contact(scene: Scene, earning: Earning) -> Array:
    """Weighted links in contact."""
    return jnp.sum(jnp.array(scene.hand.contact_weights) * earning.touching, -1)


def _force(scene: Scene, earning: Earning) -> Array:
    """Weighted forces of the links in contact, as shares of f_max."""
    most, weights = earning.force_max, jnp.array(scene.hand.contact_weights)
    pressed = jnp.minimum(jnp.linalg.norm(earning.force, axis=-1), most)
    return jnp.sum(weights * earning.touching * pressed / most, -1)


def _force_excess(scene: Scene, earning: Earning) -> Array:
    """Newtons beyond f_max, summed over all links, also where a contact earns nothing."""
    total = jnp.linalg.norm(scene.features.force, axis=-1)
    return -jnp.sum(jnp.clip(total - earning.force_max, 0.0, 50.0), -1)


def _grip(scene: Scene, earning: Earning) -> Array:
    """Share of the wanted resistance to the object's weight; 0 where the weight is not recorded."""
    if scene.load is None:
        return jnp.zeros(scene.state.time.shape)
    return resistance(scene.state, scene.load, earning.touching)


def _posture(scene: Scene, earning: Earning) -> Array:
    """Mean squared deviation of the fingers from natural postures."""
    deviation = finger_deviations(scene.hand, scene.state.q, scene.features.touching)
    return -jnp.mean(deviation**2, -1)


def _object_position(scene: Scene, earning: Earning) -> Array:
    """Squared displacement of the object since the start."""
    return -jnp.minimum(
        square(scene.state.object_position - scene.state.object_position_initial), 0.04
    )


def _object_rotation(scene: Scene, earning: Earning) -> Array:
    """Squared rotation of the object since the start."""
    turned = rotations.angle(scene.state.object_quaternion, scene.state.object_quaternion_initial)
    return -jnp.minimum(turned**2, 1.0)


def _drop(scene: Scene, earning: Earning) -> Array:
    """I_drop."""
    return -fallen(scene.task, scene.state).astype(jnp.float32)


GRASP: tuple[Term, ...] = (
    Term(
        "distance",
        0.3,
        "w_dis: per metre of the weighted distance from the hand's keypoints to the object's "
        "surface (0.3 m at most).",
        _distance,
    ),
    Term(
        "contact",
        1.0,
        "w_c: for all links in contact (weighted by the links' contact weights, which sum to one).",
        _contact,
    ),
    Term("force", 0.5, "w_f: for all links pressing with `force_max` or more.", _force),
    Term("force_max", 5.0, "f_max, N per link: force beyond it earns nothing.", None),
    Term(
        "force_excess",
        0.01,
        "Penalty per newton above `force_max`, per link (ours: the paper only clamps, and hands "
        "then squeeze hard).",
        _force_excess,
    ),
    Term(
        "force_per_weight",
        0.0,
        "Growth of `force_max` with the object's weight, N per N: what is heavy may be pressed "
        "harder (ours).",
        None,
    ),
    Term(
        "grip",
        0.0,
        "For contacts that can resist twice the object's weight and twice its torque (ours, see "
        "`common.task.grip`).",
        _grip,
    ),
    Term(
        "posture",
        0.0,
        "Per square radian of the fingers' deviation from natural postures (ours, see "
        "`common.task.posture`).",
        _posture,
    ),
    Term(
        "object_position",
        20.0,
        "w_o: per square metre of the object's displacement (at most 0.04 m^2).",
        _object_position,
    ),
    Term(
        "object_rotation",
        0.1,
        "w_R: per square radian of the object's rotation (at most 1 rad^2).",
        _object_rotation,
    ),
    Term(
        "wrist_velocity",
        0.01,
        "w_u: per squared velocity of the six wrist joints (m/s and rad/s).",
        lambda scene, earning: -jnp.minimum(square(scene.state.u_velocity), 100.0),
    ),
    Term(
        "finger_deviation",
        0.002,
        "w_q of the regulariser: per squared radian from the initial finger pose.",
        lambda scene, earning: -square(scene.state.q - scene.state.q_initial),
    ),
    Term("drop", 1.0, "w_drop: per step with the object fallen.", _drop),
)
"""Terms of r^grasp; `RewardWeights` (`common.task.config`) and the names of all terms derive from
them.
"""


def terms(task: TaskSettings) -> tuple[str, ...]:
    """Names of the terms, which are those of their weights: the grasp's, then those of the
    constraints.
    """
    grasp = (term.name for term in GRASP if term.value is not None)
    return (*grasp, *(weight.name for constraint in known(task) for weight in constraint.weights))


def fallen(task: TaskSettings, state: SceneState) -> Array:
    """(B,) bool I_drop: the object is `drop_height` below its initial height."""
    return state.object_position[..., 2] < state.object_position_initial[..., 2] - task.drop_height


def reward_terms(scene: Scene, weights: Any) -> dict[str, Array]:
    """Weighted terms (B,) by the names in `terms`; the reward is their sum. `weights` are
    `RewardWeights`.
    """
    touching = scene.features.touching
    force = scene.features.force
    most = weights.force_max
    if scene.load is not None:
        most = most + weights.force_per_weight * scene.load.weight[:, None]
    for constraint in known(scene.task):
        touching, force = constraint.earning(scene, touching, force)
        most = constraint.force_max(scene, most)
    earning = Earning(touching, force, most)
    found = {term.name: term.value(scene, earning) for term in GRASP if term.value is not None}
    for constraint in known(scene.task):
        found |= constraint.reward(scene)
    return {name: getattr(weights, name) * value for name, value in found.items()}
