"""The constraint bank: what the constraints of episodes are drawn from, stacked over a pool of objects."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from common.task.types import Array


class ConstraintBank(NamedTuple):
    """N objects; R resting poses, H headings and M reference poses each; object frame unless said otherwise.

    A compiled reset gathers from it by object index. The axis V has two regions: 0 for the whole surface, 1 for the
    graspable region of an affordance.
    """

    points: Array
    """(N, P, 3) surface points."""
    avoid: Array
    """(N, P) bool, the avoid region."""
    rest: Array
    """(N, R, 7) resting poses in the world; unused rows repeat earlier ones."""
    heading_position: Array
    """(N, V, H, 3)."""
    heading_direction: Array
    """(N, V, H, 3)."""
    heading_cross: Array
    """(N, V, H, 3)."""
    heading_index: Array
    """(N, V, R, H) feasible headings of each resting pose, repeated to fill the row."""
    heading_back: Array
    """(N, V, R, H) metres by which the position of `heading_index` moves back to stay clear of the table."""
    pose_q: Array
    """(N, V, M, F)."""
    pose_position: Array
    """(N, V, M, 3)."""
    pose_quaternion: Array
    """(N, V, M, 4)."""
    trajectory_position: Array
    """(N, V, M, K, 3); trajectory m ends at pose m."""
    trajectory_quaternion: Array
    """(N, V, M, K, 4)."""
    pose_valid: Array
    """(N, V, R, M) bool: pose and trajectory stay above the table in the resting pose."""
    has_affordance: Array
    """(N, R) bool: the object has an avoid region, and its graspable one can be approached in the resting pose."""


class Draw(NamedTuple):
    """What was drawn of a bank for B episodes before their constraints are."""

    bank: ConstraintBank
    objects: Array
    """(B,) int."""
    rests: Array
    """(B,) int, resting pose."""
    region: Array = 0
    """(B,) int, the axis V: that of the constraints which are asked for so far."""
    reference: Mapping[str, Array] = MappingProxyType({})
    """(B,) int by the name of each constraint that is drawn from references: one that it allows, if there is any."""

    @property
    def allowed(self) -> Array:
        """(B, M) bool: references that the table leaves room for."""
        return self.bank.pose_valid[self.objects, self.region, self.rests]
