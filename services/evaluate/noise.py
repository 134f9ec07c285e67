"""Noisy references: accuracy of a policy on captured poses and trajectories with errors (paper, noisy constraints).

Each kind of noise is added to the reference poses or trajectories of a constraint bank, and the same episodes are
evaluated as without noise; errors are relative to the request, including noise.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import coupled
from congrasp.common.hands.spec import Hand
from congrasp.common.task.sampling.bank import ConstraintBank


@dataclasses.dataclass(frozen=True)
class Noise:
    """One kind of noise at one level."""

    constraint: str
    """Row whose references get the noise: pose or trajectory."""
    kind: str
    """joints, depth or jitter; empty for no noise."""
    level: float
    """rad for joints, m otherwise."""

    @property
    def label(self) -> str:
        """Label such as "joints 0.2 rad"; empty without noise."""
        amount = f"{self.level:g} rad" if self.kind == "joints" else f"{100 * self.level:g} cm"
        return f"{self.kind} {amount}" if self.kind else ""


LEVELS = (
    Noise("pose", "", 0.0),
    *(Noise("pose", "joints", level) for level in (0.1, 0.2)),
    *(Noise("pose", "depth", level) for level in (0.005, 0.01)),
    Noise("trajectory", "", 0.0),
    *(Noise("trajectory", "jitter", level) for level in (0.005, 0.01)),
)
"""Rows of the table."""


def with_noise(hand: Hand, bank: ConstraintBank, noise: Noise, seed: int) -> ConstraintBank:
    """Returns the constraint bank with noisy references.

    * joints: an independent normal error of standard deviation `level` on every finger joint, clipped to its limits.
    * depth: a displacement of the wrist along the hand's heading axis, into the object, uniform up to `level`.
    * jitter: an independent normal error of standard deviation `level` on every coordinate of every waypoint.
    """
    rng = np.random.default_rng(seed)
    if noise.kind == "joints":
        q = np.asarray(bank.pose_q)
        noisy = np.clip(q + rng.normal(0.0, noise.level, q.shape), hand.lower, hand.upper)
        return bank._replace(pose_q=coupled(hand, noisy).astype(np.float32))
    if noise.kind == "depth":
        position, quaternion = np.asarray(bank.pose_position), np.asarray(bank.pose_quaternion)
        turn = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
        inward = turn.apply(grasp_frame(hand).heading).reshape(position.shape)
        depth = rng.uniform(0.0, noise.level, (*position.shape[:-1], 1))
        return bank._replace(pose_position=(position + depth * inward).astype(np.float32))
    if noise.kind == "jitter":
        path = np.asarray(bank.trajectory_position)
        noisy = path + rng.normal(0.0, noise.level, path.shape)
        return bank._replace(trajectory_position=noisy.astype(np.float32))
    return bank
