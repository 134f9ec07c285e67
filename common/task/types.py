"""Arrays used in the formulas of the task.

Every array has a leading batch axis B. Quantities are in the world frame unless stated otherwise;
its z axis points up and the table's top is at z = 0. Quaternions are (w, x, y, z) and rotate from
the named body's frame into the world (or object) frame. F finger joints, L links, P keypoints, C
contacts kept per link, N surface points, K waypoints.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.runtime.lazy_jax import jax, jnp, register_pytree

Array = Any  # a jax.Array inside compiled functions, a numpy.ndarray outside

CONTACTS_PER_LINK = 3
"""C, strongest contacts kept for each link."""


class SceneState(NamedTuple):
    """Hand and object in one control step, and the initial state of the episode."""

    q: Array
    """(B, F) finger joint angles, rad."""
    u: Array
    """(B, 6) virtual wrist joints relative to the base: x, y, z (m), then intrinsic x-y-z angles
    (rad).
    """
    q_velocity: Array
    """(B, F) rad/s."""
    u_velocity: Array
    """(B, 6) m/s and rad/s."""
    q_target: Array
    """(B, F) finger targets of the previous control step."""
    u_target: Array
    """(B, 6) wrist targets of the previous control step."""
    object_position: Array
    """(B, 3) the object's centre of mass, m."""
    object_quaternion: Array
    """(B, 4)."""
    object_velocity: Array
    """(B, 3) linear velocity of the centre of mass, m/s."""
    object_angular_velocity: Array
    """(B, 3) rad/s, world frame."""
    contact_force: Array
    """(B, L, C, 3) force of the object on the link, N; zero where there is no contact."""
    contact_position: Array
    """(B, L, C, 3) m; meaningless where there is no contact."""
    contact_found: Array
    """(B, L, C) bool."""
    base_position: Array
    """(B, 3) origin of the wrist's base, where the six wrist joints are zero."""
    base_quaternion: Array
    """(B, 4)."""
    q_initial: Array
    """(B, F) finger angles at the start of the episode."""
    object_position_initial: Array
    """(B, 3) the object's position at the start of the episode."""
    object_quaternion_initial: Array
    """(B, 4)."""
    wrist_load: Array
    """(B, 6) acceleration of the wrist joints by the carried load, m/s^2 and rad/s^2
    (`common.task.control.wrist_load`)."""
    time: Array
    """(B,) float, control steps since the start of the episode."""
    table: Array
    """(B,) bool, True if the table is present."""


class Surface(NamedTuple):
    """Labelled surface points of the object."""

    points: Array
    """(B, N, 3) in the object frame, m."""
    avoid: Array
    """(B, N) bool, true in the avoid region."""
    normals: Array | None = None
    """(B, N, 3) outward unit normals at the points, same frame; None if the policy does not observe
    them.
    """


@dataclasses.dataclass(frozen=True)
class Goal:
    """Goal of an episode by constraint (`common.task.constraints`); object frame.

    A pytree of JAX.
    """

    values: dict[str, Any]
    """Goal arrays (B, ...) of each constraint, as the NamedTuple that the constraint names
    `goal`.
    """
    active: dict[str, Array]
    """(B,) bool for each optional block of the observation: True if its constraint is active after
    the priority rules. Values gated by an inactive block are ignored."""

    def __post_init__(self) -> None:
        """Registers the class with JAX, which a program needs only once it makes a goal."""
        register_pytree(Goal)

    def __getitem__(self, constraint: str) -> Any:
        """Returns the goal arrays of a constraint."""
        return self.values[constraint]

    def replace(self, constraint: str, **arrays: Array) -> "Goal":
        """Returns the goal with other arrays of one constraint."""
        values = {**self.values, constraint: self.values[constraint]._replace(**arrays)}
        return dataclasses.replace(self, values=values)

    def where(self, mask: Array, constraint: str, **arrays: Array) -> "Goal":
        """Returns the goal with other arrays of one constraint in the masked environments (B,)."""
        previous = self.values[constraint]
        chosen = {}
        for name, array in arrays.items():
            rows = mask.reshape(-1, *[1] * (array.ndim - 1))
            chosen[name] = jnp.where(rows, array, getattr(previous, name))
        return self.replace(constraint, **chosen)

    def flat(self) -> dict[str, Array]:
        """All goal arrays by their names in messages: `heading_direction`, `pose_q` and so on."""
        flat = {}
        for constraint, arrays in self.values.items():
            for name, array in arrays._asdict().items():
                flat[f"{constraint}_{name}"] = array
        return flat

    def row(self, index: int) -> "Goal":
        """Returns the goal of one environment, without the batch axis, as NumPy arrays."""
        return jax.tree.map(lambda array: np.asarray(array)[index], self)


class Action(NamedTuple):
    """Joint targets decoded from a policy's action."""

    q_target: Array
    """(B, F)."""
    u_target: Array
    """(B, 6)."""


class Features(NamedTuple):
    """Geometry of one control step, with leading batch axis B."""

    wrist_position: Array
    """(B, 3) world frame."""
    wrist_quaternion: Array
    """(B, 4) world frame."""
    object_position: Array
    """(B, 3) the object's centre of mass."""
    object_quaternion: Array
    """(B, 4) object frame to wrist frame."""
    keypoints: Array
    """(B, P, 3) link origins and fingertips."""
    center: Array
    """(B, 3) hand centre p of the current fingers (in the ablation, of the initial fingers),
    restricted to those that an active choice of fingers allows."""
    nearest: Array
    """(B, P, 3) d: from each keypoint to the nearest surface point."""
    normal: Array | None
    """(B, P, 3) n: outward unit normal at the nearest surface point; None if the surface has no
    normals.
    """
    height: Array | None
    """(B, P) -n . d: signed height of each keypoint above the tangent plane there, m; None without
    normals.
    """
    force: Array
    """(B, L, 3) f: net contact force on each link, N."""
    touching: Array
    """(B, L) bool b: the link touches the object."""
    by_constraint: dict[str, Any]
    """Features of the constraints, by their names (`Constraint.features`)."""


class Contacts(NamedTuple):
    """Intermediate results from which constraints compute their features."""

    surface: Surface
    """Labelled surface points, object frame."""
    keypoints: Array
    """(B, P, 3) object frame."""
    squared: Array
    """(B, N, P) squared distances between surface points and keypoints, m^2."""
    nearest: Array
    """(B, L, C) index of the surface point nearest to each contact."""
    found: Array
    """(B, L, C) bool."""
    force: Array
    """(B, L, C, 3) force of each contact, wrist frame, N."""
