"""Reward terms (paper, section Reward Function): those of the grasp are here, those of constraints
in their files.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints import center_fingers, known, requested_fingers
from congrasp.common.task.geometry import NO_POINT_DISTANCE, square
from congrasp.common.task.grip import resistance
from congrasp.common.task.posture import finger_deviations
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, SceneState

_MAX_EXCESS = 50.0
"""Force above f_max at which the cost of a link saturates, N."""
_MAX_SQUARED_DISPLACEMENT = 0.04
"""Squared displacement of the object at which its cost saturates, m^2."""
_MAX_SQUARED_ROTATION = 1.0
"""Squared rotation of the object at which its cost saturates, rad^2."""
_MAX_SQUARED_VELOCITY = 100.0
"""Squared velocity of the wrist joints at which its cost saturates, m^2/s^2 and rad^2/s^2."""


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


def keypoint_weights(hand: Hand, fingers: Array | None) -> Array:
    """Weights (P,) or (B, P) of the keypoints in the distance reward, for fingers of
    `center_fingers`.

    Keypoints of other fingers get no weight; those of the set and the palm share it.
    """
    weights = jnp.array(hand.keypoint_weights)
    if fingers is None:
        return weights
    finger_of_keypoint = hand.link_fingers[hand.keypoint_links]
    counts = (finger_of_keypoint < 0) | fingers[:, finger_of_keypoint]
    selected = jnp.where(counts, weights, 0.0)
    return selected * (jnp.sum(weights) / jnp.sum(selected, -1, keepdims=True))


def _distance(scene: Scene, earning: Earning) -> Array:
    """Weighted distance from the keypoints to the surface."""
    distances = jnp.linalg.norm(scene.features.nearest, axis=-1)
    weights = keypoint_weights(scene.hand, center_fingers(scene.task, scene.goal))
    return -jnp.sum(weights * jnp.minimum(distances, NO_POINT_DISTANCE), -1)


def _contact(scene: Scene, earning: Earning) -> Array:
    """Weighted links in contact."""
    return jnp.sum(jnp.array(scene.hand.contact_weights) * earning.touching, -1)


def _force(scene: Scene, earning: Earning) -> Array:
    """Weighted forces of the links in contact, as shares of f_max."""
    force_max = earning.force_max
    weights = jnp.array(scene.hand.contact_weights)
    force = jnp.minimum(jnp.linalg.norm(earning.force, axis=-1), force_max)
    return jnp.sum(weights * earning.touching * force / force_max, -1)


def _force_excess(scene: Scene, earning: Earning) -> Array:
    """Force above f_max summed over links (N), including masked contacts."""
    force = jnp.linalg.norm(scene.features.force, axis=-1)
    excess = jnp.clip(force - earning.force_max, 0.0, _MAX_EXCESS)
    return -jnp.sum(excess, -1)


def _grip(scene: Scene, earning: Earning) -> Array:
    """Share of the wanted resistance to the object's weight; 0 where the weight is not recorded."""
    if scene.load is None:
        return jnp.zeros(scene.state.time.shape)
    return resistance(scene.state, scene.load, earning.touching)


def _posture(scene: Scene, earning: Earning) -> Array:
    """Mean squared deviation of the fingers from natural postures; 0 where a constraint requests
    the fingers' angles, which would otherwise be pulled to two postures at once.
    """
    deviation = finger_deviations(scene.hand, scene.state.q, scene.features.touching)
    cost = jnp.mean(deviation**2, -1)
    requested = requested_fingers(scene.task, scene.goal)
    if requested is None:
        return -cost
    return -jnp.where(requested, 0.0, cost)


def _object_position(scene: Scene, earning: Earning) -> Array:
    """Squared displacement of the object since the start."""
    displacement = scene.state.object_position - scene.state.object_position_initial
    return -jnp.minimum(square(displacement), _MAX_SQUARED_DISPLACEMENT)


def _object_rotation(scene: Scene, earning: Earning) -> Array:
    """Squared rotation of the object since the start."""
    angle = rotations.angle(scene.state.object_quaternion, scene.state.object_quaternion_initial)
    return -jnp.minimum(angle**2, _MAX_SQUARED_ROTATION)


def _wrist_velocity(scene: Scene, earning: Earning) -> Array:
    """Squared velocity of the six wrist joints."""
    return -jnp.minimum(square(scene.state.u_velocity), _MAX_SQUARED_VELOCITY)


def _finger_deviation(scene: Scene, earning: Earning) -> Array:
    """Squared deviation of the fingers from their initial pose."""
    return -square(scene.state.q - scene.state.q_initial)


def _drop(scene: Scene, earning: Earning) -> Array:
    """Indicator that the object has fallen (I_drop)."""
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
        _wrist_velocity,
    ),
    Term(
        "finger_deviation",
        0.002,
        "w_q of the regulariser: per squared radian from the initial finger pose.",
        _finger_deviation,
    ),
    Term("drop", 1.0, "w_drop: per step with the object fallen.", _drop),
)
"""Terms of r^grasp. `RewardWeights` (`common.task.config`) has a field for each."""


def terms(task: TaskSettings) -> tuple[str, ...]:
    """Names of the terms and of their weights: the grasp's terms, then the constraints' terms."""
    names = [term.name for term in GRASP if term.value is not None]
    for constraint in known(task):
        names += [weight.name for weight in constraint.weights]
    return tuple(names)


def fallen(task: TaskSettings, state: SceneState) -> Array:
    """(B,) bool I_drop: the object is `drop_height` below its initial height."""
    return state.object_position[..., 2] < state.object_position_initial[..., 2] - task.drop_height


def reward_terms(scene: Scene, weights: Any) -> dict[str, Array]:
    """Weighted terms (B,) by the names in `terms`; the reward is their sum. `weights` are
    `RewardWeights`.
    """
    earning = _earning_contacts(scene, weights)
    values = {term.name: term.value(scene, earning) for term in GRASP if term.value is not None}
    for constraint in known(scene.task):
        values |= constraint.reward(scene)
    return {name: getattr(weights, name) * value for name, value in values.items()}


def _earning_contacts(scene: Scene, weights: Any) -> Earning:
    """Contacts that the active constraints let earn reward, and the greatest force that earns."""
    touching = scene.features.touching
    force = scene.features.force
    force_max = weights.force_max
    if scene.load is not None:
        force_max = force_max + weights.force_per_weight * scene.load.weight[:, None]
    for constraint in known(scene.task):
        touching, force = constraint.earning(scene, touching, force)
        force_max = constraint.force_max(scene, force_max)
    return Earning(touching, force, force_max)
